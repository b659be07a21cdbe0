"""An exported retriever computes the embeddings of the trained one, also without this project."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from huggingface_hub import ModelCard
from safetensors.torch import load_file

from dynapix.conf.entry import Run
from dynapix.conf.runs import open_run
from dynapix.conf.schema import (
    ContrastiveCommand,
    ExportModelCommand,
    LateConfig,
    LoraConfig,
)
from dynapix.models import compat, loading
from dynapix.models.resolved_settings import resolve_run
from dynapix.models.retriever.embedder import load_retriever, load_trained
from dynapix.models.retriever.inputs import frame_input, query_input
from dynapix.train import export
from dynapix.train.common.model_card import write_run_card
from tests.children import run_cards, run_child
from tests.tiny_models import randomize_adapters

METRICS = {"recall@10_at_start": 0.25, "recall@10": 0.5}


@pytest.fixture(
    scope="module", params=[None, LateConfig(width=24)], ids=["one vector", "many vectors"]
)
def settings(request, contrastive_settings, saved_base) -> ContrastiveCommand:
    cfg = replace(
        contrastive_settings.retriever, architecture=None, model=saved_base, quantization="nf4",
        lora=LoraConfig(rank=4), late=request.param,
    )  # fmt: skip
    return replace(contrastive_settings, retriever=cfg)


@pytest.fixture(scope="module")
def runs(settings, tmp_path_factory) -> Path:
    """A finished run of train.contrastive whose adapters change the outputs considerably."""
    root = tmp_path_factory.mktemp("checkpoints")
    folder = root / "contrastive" / "run"
    open_run(Run("run", folder), asdict(settings), "train.contrastive")
    resolve_run(folder, "fp32", settings.retriever, data="0")
    torch.manual_seed(0)
    model = load_retriever(settings.retriever, "fp32", [], folder)
    randomize_adapters(model, 0.05)
    model.save_pretrained(str(folder / "retriever"), create_model_card=False)
    (folder / "metrics.json").write_text(json.dumps(METRICS))
    return root


def exported(runs: Path, format: str, into: Path) -> Path:
    cfg = ExportModelCommand(product="retriever", run="run", format=format, checkpoints=str(runs))
    into.mkdir()
    export.main.__wrapped__(cfg, Run(f"run/{format}", into))
    return into / "retriever"


@pytest.fixture(scope="module")
def forms(runs, tmp_path_factory) -> dict[str, Path]:
    """The folder of each format."""
    root = tmp_path_factory.mktemp("exports")
    return {f: exported(runs, f, root / f) for f in ("bf16", "fp32", "adapter")}


@pytest.mark.parametrize("format", ["bf16", "fp32"])
def test_merged_weights_have_the_format_and_are_not_quantised(forms, format) -> None:
    folder = forms[format]
    weights = load_file(folder / "model.safetensors").values()
    assert {w.dtype for w in weights} == {loading.DTYPES[format]}
    assert "quantization" not in (folder / "config.json").read_text()
    assert not (folder / "adapter_config.json").exists()


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
assert "dynapix" not in sys.modules
torch.save([[torch.as_tensor(one) for one in some] for some in embedded], outputs)
"""


@pytest.mark.slow
def test_the_library_alone_computes_the_same_embeddings(
    settings, runs, forms, micro_store, frames, tmp_path
) -> None:
    """They equal those of the trained retriever, the adapters over their 4-bit base."""
    queries, preset = micro_store.standard_test()[:2], settings.retriever
    data = {
        "queries": [query_input(q, frames, preset) for q in queries],
        "frames": [frame_input(q.target, frames) for q in queries],
    }
    torch.save(data, tmp_path / "inputs.pt")
    kind = "one" if preset.late is None else "many"
    arguments = [forms["fp32"], tmp_path / "inputs.pt", tmp_path / "outputs.pt", kind]
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


def test_the_card_describes_the_run(forms) -> None:
    card = ModelCard.load(forms["adapter"] / "README.md")
    assert card.data.pipeline_tag == "sentence-similarity"
    assert "  widths:\n  - 64\n  - 32\n" in card.text
    assert "| recall@10 | 0.25 | 0.5 |" in card.text


@pytest.mark.slow
def test_the_code_of_the_card_runs_from_another_directory(settings, runs, forms, tmp_path) -> None:
    folder = runs / "contrastive" / "run" / "retriever"
    write_run_card(Run("run", folder.parent), settings, METRICS)
    printed = run_cards([folder, forms["fp32"], forms["adapter"]], tmp_path)
    assert printed.count("tensor([[") == 3
