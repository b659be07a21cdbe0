"""An exported retriever embeds as the trained one does, wherever it is loaded."""

from __future__ import annotations

import json
import os
import shutil
import sys
from dataclasses import asdict, replace
from pathlib import Path

import bitsandbytes
import pytest
import torch
from huggingface_hub import ModelCard
from safetensors.torch import load_file

from conf.entry import Run
from conf.errors import UserError
from conf.runs import open_run
from conf.schema import (
    ContrastiveCommand,
    ExportModelCommand,
    LateConfig,
    LoraConfig,
    RetrieveCommand,
    RetrieverConfig,
)
from evaluation import retrieve
from models import compat, loading
from models.resolved import resolve_run
from models.retriever.embedder import frame_input, load_retriever, load_trained, query_input
from tests.children import run_child
from tests.user_errors import raises_user_error
from train import export

METRICS = {"recall@10_at_start": 0.25, "recall@10": 0.5}


@pytest.fixture(scope="module", params=[None, LateConfig(width=24)], ids=["one", "late"])
def settings(request, contrastive_settings, saved_base) -> ContrastiveCommand:
    cfg = replace(
        contrastive_settings.retriever, architecture=None, model=saved_base, quantization="nf4",
        lora=LoraConfig(rank=4), late=request.param,
    )  # fmt: skip
    return replace(contrastive_settings, retriever=cfg)


@pytest.fixture(scope="module")
def runs(settings, tmp_path_factory) -> Path:
    """A finished run of train.contrastive whose adapters weigh as much as their base."""
    root = tmp_path_factory.mktemp("checkpoints")
    folder = root / "contrastive" / "run"
    open_run(Run("run", folder), asdict(settings), "train.contrastive", [])
    resolve_run(folder, "fp32", settings.retriever, data="0")
    torch.manual_seed(0)
    model = load_retriever(settings.retriever, "fp32", [], folder)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if "lora_B" in name:
                weight.normal_(std=0.05)
    model.save_pretrained(str(folder / "retriever"), create_model_card=False)
    (folder / "metrics.json").write_text(json.dumps(METRICS))
    return root


def exported(
    settings: ContrastiveCommand, runs: Path, format: str, into: Path, verify: bool = True
):
    cfg = ExportModelCommand(
        product="retriever", run="run", format=format, store=settings.store,
        checkpoints=str(runs), workers=1, verify=verify,
    )  # fmt: skip
    into.mkdir(parents=True, exist_ok=True)
    return export.main.__wrapped__(cfg, Run(f"run/{format}", into)), into / "retriever"


@pytest.fixture(scope="module")
def forms(settings, runs, tmp_path_factory) -> dict[str, tuple[dict, Path]]:
    """The metrics and the folder of each format."""
    root = tmp_path_factory.mktemp("exports")
    return {f: exported(settings, runs, f, root / f) for f in ("bf16", "fp32", "adapter")}


def test_a_merged_weight_is_the_dequantised_one_and_its_adapters_product(
    settings, runs, forms
) -> None:
    merged = load_file(forms["fp32"][1] / "model.safetensors")
    adapters = load_file(runs / "contrastive" / "run" / "retriever" / "adapter_model.safetensors")
    scale = settings.retriever.lora.alpha / settings.retriever.lora.rank
    base = load_file(Path(settings.retriever.model) / "model.safetensors")
    changed = 0
    for place in {name.partition("lora_")[0] for name in adapters}:
        name = f"{place.removeprefix('base_model.model.')}weight"
        weight = next(w for key, w in base.items() if key.endswith(name))
        packed, state = bitsandbytes.functional.quantize_4bit(weight, quant_type="nf4")
        dequantised = bitsandbytes.functional.dequantize_4bit(packed, state)
        added = scale * adapters[f"{place}lora_B.weight"] @ adapters[f"{place}lora_A.weight"]
        assert added.norm() > 0.1 * weight.norm()
        torch.testing.assert_close(merged[name], dequantised + added, atol=1e-6, rtol=1e-5)
        changed += 1
    assert changed == 2 * 7


def test_the_measured_difference_is_recorded_and_small(forms) -> None:
    for format, most in (("fp32", 1e-4), ("bf16", 0.1)):
        measured, folder = forms[format]
        assert json.loads((folder / "export.json").read_text())["measured"] == measured
        assert 0 < measured["query_difference"] < most
        assert 0 < measured["score_difference"] < most
        assert 0 <= measured["best_frame_agreement"] <= 1
        weights = load_file(folder / "model.safetensors").values()
        assert {w.dtype for w in weights} == {loading.DTYPES[format]}
        assert "quantization" not in (folder / "config.json").read_text()
        assert not (folder / "adapter_config.json").exists()
    assert forms["adapter"][0] == {}


ELSEWHERE = """
import sys
import torch
from sentence_transformers import MultiVectorEncoder, SentenceTransformer

folder, inputs, outputs, kind = sys.argv[1:]
data = torch.load(inputs, weights_only=False)
if kind == "one":
    model = SentenceTransformer(folder, device="cpu")
else:
    model = MultiVectorEncoder(folder, device="cpu", trust_remote_code=True)
embedded = model.encode_query(data["queries"]), model.encode_document(data["frames"])
assert not {"train", "conf", "data"} & set(sys.modules)
torch.save([[torch.as_tensor(one) for one in some] for some in embedded], outputs)
"""


@pytest.mark.slow
def test_the_library_alone_computes_the_same_embeddings(
    settings, runs, forms, micro_store, frames, tmp_path
) -> None:
    """As the trained retriever, the adapters over their 4-bit base."""
    queries, preset = micro_store.standard_test()[:2], settings.retriever
    data = {
        "queries": [query_input(q, frames, preset) for q in queries],
        "frames": [frame_input(q.target, frames) for q in queries],
    }
    torch.save(data, tmp_path / "inputs.pt")
    kind = "one" if preset.late is None else "many"
    arguments = [forms["fp32"][1], tmp_path / "inputs.pt", tmp_path / "outputs.pt", kind]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    run_child(
        [sys.executable, "-c", ELSEWHERE, *arguments], check=True, cwd=tmp_path, env=environment
    )
    model = load_trained(preset, "fp32", runs / "contrastive" / "run" / "retriever")
    compat.keep_differentiable(model)
    wanted = model.encode_query(data["queries"]), model.encode_document(data["frames"])
    for results, expected in zip(torch.load(tmp_path / "outputs.pt"), wanted, strict=True):
        for one, two in zip(results, expected, strict=True):
            torch.testing.assert_close(one.cpu(), torch.as_tensor(two).cpu(), atol=1e-4, rtol=0)


@pytest.mark.slow
def test_every_format_evaluates_like_the_run(settings, runs, forms, tmp_path) -> None:
    results = {}
    models = {f: forms[f][1] for f in ("fp32", "adapter")} | {"run": runs / "contrastive" / "run"}
    for name, model in models.items():
        cfg = RetrieveCommand(
            benchmark=settings.benchmark, retriever=RetrieverConfig(name="unused", model="unused"),
            store=settings.store, model=str(model), batch=16,
        )  # fmt: skip
        (tmp_path / name).mkdir()
        retrieve.main.__wrapped__(cfg, Run(name, tmp_path / name))
        rows = json.loads((tmp_path / name / "report.json").read_text())["rows"]
        results[name] = {r["width"]: r["mrr"]["value"] for r in reversed(rows[: len(rows) // 2])}
    assert results["adapter"] == results["run"]
    assert results["fp32"] == pytest.approx(results["run"], abs=0.05)


def test_the_card_describes_the_run(settings, forms) -> None:
    card = ModelCard.load(forms["adapter"][1] / "README.md")
    assert card.data.library_name == "peft"
    assert card.data.pipeline_tag == "sentence-similarity"
    for row in (
        f"| base | {settings.retriever.model} |",
        "  widths:\n  - 64\n  - 32\n",
        "  hard_negatives: 1\n",
        "| recall@10 | 0.25 | 0.5 |",
    ):
        assert row in card.text
    assert "| query difference |" in ModelCard.load(forms["fp32"][1] / "README.md").text


@pytest.mark.slow
def test_an_export_that_embeds_otherwise_is_not_kept(settings, runs, tmp_path, monkeypatch) -> None:
    """Here merging leaves out the adapters."""
    monkeypatch.setattr(loading, "merge_adapters", lambda base, *_: base.dequantize(torch.float32))
    with raises_user_error("merge-difference"):
        exported(settings, runs, "fp32", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_retriever_trained_whole_has_nothing_to_merge(settings, runs, tmp_path) -> None:
    shutil.copytree(runs, tmp_path / "runs")
    config = tmp_path / "runs" / "contrastive" / "run" / "config.yaml"
    config.write_text(config.read_text().replace("rank: 4", "rank: 0").replace("nf4", "none"))
    with raises_user_error("nothing-to-merge", "retriever.lora.rank=0"):
        exported(settings, tmp_path / "runs", "fp32", tmp_path / "into")


def test_a_run_of_another_product_is_refused(settings, runs, tmp_path) -> None:
    cfg = ExportModelCommand(run="run", checkpoints=str(runs))
    with pytest.raises(UserError, match="sft/run"):
        export.main.__wrapped__(cfg, Run("run", tmp_path))
    (problem,) = ExportModelCommand(run="checkpoints/contrastive/x").check()
    assert "product=retriever" in problem


def test_a_missing_benchmark_is_not_built(settings, runs, tmp_path) -> None:
    elsewhere = replace(settings, store=str(tmp_path / "store"))
    with raises_user_error("missing-benchmark", ("micro", "verify=false")):
        exported(elsewhere, runs, "fp32", tmp_path / "into")
    assert list((tmp_path / "into").iterdir()) == []
    assert not (tmp_path / "store").exists()
    measured, folder = exported(elsewhere, runs, "fp32", tmp_path / "into", verify=False)
    assert measured == {}
    assert (folder / "model.safetensors").exists()
