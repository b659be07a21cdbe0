"""An exported retriever embeds as the trained one does, wherever it is loaded."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import bitsandbytes
import numpy as np
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
from models import loading
from models.resolved import resolve_run
from models.retriever.embedder import frame_input, load_retriever, load_trained, query_input
from train import export
from train.retriever.merge import RetrieverOutputs, compare, rows_of

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
    """A run of train.contrastive as it ends, with adapters that weigh as much as their base."""
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


def exported(settings: ContrastiveCommand, runs: Path, format: str, into: Path):
    cfg = ExportModelCommand(
        product="retriever", run="run", format=format, store=settings.store,
        checkpoints=str(runs), workers=1,
    )  # fmt: skip
    into.mkdir(parents=True, exist_ok=True)
    return export.main.__wrapped__(cfg, Run(f"run/{format}", into)), into / "retriever"


@pytest.fixture(scope="module")
def forms(settings, runs, tmp_path_factory) -> dict[str, tuple[dict, Path]]:
    """What the command says of each format, and its folder."""
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


def test_the_measured_difference_is_told_and_small(forms) -> None:
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

folder, asked, said, kind = sys.argv[1:]
given = torch.load(asked, weights_only=False)
if kind == "one":
    model = SentenceTransformer(folder, device="cpu")
else:
    model = MultiVectorEncoder(folder, device="cpu", trust_remote_code=True)
made = model.encode_query(given["queries"]), model.encode_document(given["frames"])
assert not {"train", "conf", "data"} & set(sys.modules)
torch.save([[torch.as_tensor(one) for one in some] for some in made], said)
"""


@pytest.mark.slow
def test_it_embeds_the_same_where_only_the_library_is(
    settings, runs, forms, micro_store, frames, tmp_path
) -> None:
    """Against the trained retriever itself, the adapters over their 4-bit base."""
    queries, preset = micro_store.standard_test()[:2], settings.retriever
    given = {
        "queries": [query_input(q, frames, preset) for q in queries],
        "frames": [frame_input(q.target, frames) for q in queries],
    }
    torch.save(given, tmp_path / "asked.pt")
    kind = "one" if preset.late is None else "many"
    arguments = [forms["fp32"][1], tmp_path / "asked.pt", tmp_path / "said.pt", kind]
    subprocess.run(
        [sys.executable, "-c", ELSEWHERE, *map(str, arguments)],
        cwd=tmp_path, check=True, env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
    )  # fmt: skip
    model = load_trained(preset, "fp32", runs / "contrastive" / "run" / "retriever")
    loading.keep_differentiable(model)
    wanted = model.encode_query(given["queries"]), model.encode_document(given["frames"])
    for said, own in zip(torch.load(tmp_path / "said.pt"), wanted, strict=True):
        torch.testing.assert_close(rows_of(said), rows_of(own), atol=1e-4, rtol=0)


@pytest.mark.slow
def test_every_form_is_measured_like_the_run(settings, runs, forms, tmp_path) -> None:
    found = {}
    models = {f: forms[f][1] for f in ("fp32", "adapter")} | {"run": runs / "contrastive" / "run"}
    for name, model in models.items():
        cfg = RetrieveCommand(
            benchmark=settings.benchmark, retriever=RetrieverConfig(name="unused", model="unused"),
            store=settings.store, model=str(model), batch=16,
        )  # fmt: skip
        (tmp_path / name).mkdir()
        retrieve.main.__wrapped__(cfg, Run(name, tmp_path / name))
        rows = json.loads((tmp_path / name / "report.json").read_text())["rows"]
        found[name] = {r["width"]: r["mrr"]["value"] for r in reversed(rows[: len(rows) // 2])}
    assert found["adapter"] == found["run"]
    assert found["fp32"] == pytest.approx(found["run"], abs=0.05)


def test_a_card_says_what_the_run_says(settings, forms) -> None:
    card = ModelCard.load(forms["adapter"][1] / "README.md")
    assert card.data.library_name == "peft"
    assert card.data.pipeline_tag == "sentence-similarity"
    late = settings.retriever.late
    for told in (
        f"| base | {settings.retriever.model} |",
        "| adapters | LoRA of rank 4, alpha 32, dropout 0.0 |",
        "| widths | 64, 32 |" if late is None else "| vectors | one a token, 24 wide, for late",
        "| hard negatives | 1 a query |",
        "| recall@10 | 0.25 | 0.5 |",
    ):
        assert told in card.text
    assert "| query difference |" in ModelCard.load(forms["fp32"][1] / "README.md").text


def test_differences_are_shares_and_a_nan_is_not_small() -> None:
    queries, scores = [[3.0, 0.0], [0.0, 4.0]], [[1.0, 0.0], [0.6, 0.8]]
    before = RetrieverOutputs(torch.tensor(queries), torch.tensor(scores), torch.tensor([2.0, 2.0]))
    moved = before.queries + torch.tensor([[0.0, 1.0], [0.0, 0.0]])
    after = replace(before, queries=moved, scores=before.scores.flip(1))
    assert compare(before, before) == {
        "query_difference": 0, "score_difference": 0, "best_frame_agreement": 1,
    }  # fmt: skip
    assert compare(before, after) == pytest.approx(
        {"query_difference": 0.2, "score_difference": 0.52**0.5 / 2, "best_frame_agreement": 0}
    )
    broken = replace(before, queries=before.queries * float("nan"))
    assert np.isnan(compare(before, broken)["query_difference"])


@pytest.mark.slow
def test_an_export_that_embeds_otherwise_is_not_kept(settings, runs, tmp_path, monkeypatch) -> None:
    """The adapters left out stand for anything that goes wrong in merging."""
    monkeypatch.setattr(loading, "merged", lambda base, *_: base.dequantize(torch.float32))
    with pytest.raises(UserError, match=r"query difference .* of its size.* nothing was export"):
        exported(settings, runs, "fp32", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_retriever_trained_whole_is_one_already(settings, runs, tmp_path) -> None:
    shutil.copytree(runs, tmp_path / "runs")
    config = tmp_path / "runs" / "contrastive" / "run" / "config.yaml"
    config.write_text(config.read_text().replace("rank: 4", "rank: 0").replace("nf4", "none"))
    with pytest.raises(UserError, match=r"trained the whole model .*retriever\.lora\.rank=0.*Sent"):
        exported(settings, tmp_path / "runs", "fp32", tmp_path / "into")


def test_a_student_is_no_retriever(settings, runs, tmp_path) -> None:
    cfg = ExportModelCommand(run="run", checkpoints=str(runs))
    with pytest.raises(UserError, match=r"run=.*sft/run is no run folder of a trained student"):
        export.main.__wrapped__(cfg, Run("run", tmp_path))
    (problem,) = ExportModelCommand(run="checkpoints/contrastive/x").check()
    assert problem == "run=checkpoints/contrastive/x trained a retriever: give product=retriever"
