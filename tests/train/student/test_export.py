"""An exported student computes the outputs of the trained one, also with transformers alone."""

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
from safetensors.torch import load_file, save_file

from dynapix.conf.entry import Run
from dynapix.conf.files import write_json
from dynapix.conf.runs import open_run
from dynapix.conf.schema import (
    ExportModelCommand,
    SelectCommand,
    SftCommand,
    SftTrainConfig,
    TeacherConfig,
    TwoStageCommand,
)
from dynapix.models import compat, loading
from dynapix.models.resolved_settings import resolve_run
from dynapix.models.student.collator import encode
from dynapix.models.student.prompts import selection_sample
from dynapix.models.trained_runs import read_trained_settings, run_title
from dynapix.teacher.narrate import ensure_rationales
from dynapix.train import export
from dynapix.train.common.model_card import build_model_card, write_run_card
from tests.children import run_cards, run_child
from tests.tiny_models import randomize_adapters
from tests.user_errors import raises_user_error

METRICS = {"answer_loss_at_start": 2.5, "answer_loss": 0.375}


@pytest.fixture(scope="module")
def settings(micro, micro_store, nf4_cfg) -> SftCommand:
    return SftCommand(
        benchmark=micro,
        teacher=TeacherConfig(name="template"),
        student=replace(nf4_cfg, max_new_tokens=4),
        train=SftTrainConfig(precision="fp32", validation_items=2),
        store=str(micro_store.folder.parent),
    )


def finished_run(settings: SftCommand, root: Path) -> Path:
    """Write a finished run of train.sft whose adapters change the outputs considerably."""
    folder = root / "sft" / "run"
    open_run(Run("run", folder), asdict(settings), "train.sft")
    resolve_run(folder, "fp32", settings.student, data="0")
    torch.manual_seed(0)
    model, processor = loading.load_student(settings.student, settings.train.precision, list)
    randomize_adapters(model, 0.05)
    loading.save_student(model, processor, folder / "student", settings.train.precision)
    (folder / "metrics.json").write_text(json.dumps(METRICS))
    for name, limit in (("whole", None), ("part", 4)):
        evaluated = root / "select" / name
        cfg = SelectCommand(benchmark=settings.benchmark, model=str(folder), limit=limit)
        open_run(Run(name, evaluated), asdict(cfg), "evaluation.select")
        write_json(evaluated / "metrics.json", {"answer_macro": 0.625 if limit is None else 0.125})
    # The runs have been moved since this evaluation.
    evaluated = root / "two_stage" / "moved"
    cfg = TwoStageCommand(benchmark=settings.benchmark, model="/before/checkpoints/sft/run")
    open_run(Run("moved", evaluated), asdict(cfg), "evaluation.two_stage")
    write_json(evaluated / "metrics.json", {"cot_text_mrr": 0.375})
    return root


@pytest.fixture(scope="module")
def runs(settings, micro_store, tmp_path_factory) -> Path:
    ensure_rationales(micro_store, settings.teacher)
    return finished_run(settings, tmp_path_factory.mktemp("checkpoints"))


def exported(settings: SftCommand, runs: Path, format: str, into: Path) -> Path:
    cfg = ExportModelCommand(run="run", format=format, checkpoints=str(runs))
    into.mkdir(parents=True, exist_ok=True)
    export.main.__wrapped__(cfg, Run(f"run/{format}", into))
    return into / "student"


@pytest.fixture(scope="module")
def exports(settings, runs, tmp_path_factory) -> dict[str, Path]:
    """The folder of each format."""
    root = tmp_path_factory.mktemp("exports")
    return {f: exported(settings, runs, f, root / f) for f in ("bf16", "fp32", "adapter")}


def test_a_merged_weight_is_the_dequantised_one_and_its_adapters_product(
    settings, runs, exports
) -> None:
    merged = load_file(exports["fp32"] / "model.safetensors")
    adapters = load_file(runs / "sft" / "run" / "student" / "adapter_model.safetensors")
    scale = settings.student.lora.alpha / settings.student.lora.rank
    base = load_file(Path(settings.student.model) / "model.safetensors")
    assert merged.keys() == base.keys()
    changed = 0
    for name, weight in base.items():
        place = f"base_model.model.{name.removesuffix('weight')}"
        if f"{place}lora_A.weight" not in adapters:
            assert torch.equal(merged[name], weight), name
            continue
        packed, state = bitsandbytes.functional.quantize_4bit(weight, quant_type="nf4")
        dequantised = bitsandbytes.functional.dequantize_4bit(packed, state)
        added = scale * adapters[f"{place}lora_B.weight"] @ adapters[f"{place}lora_A.weight"]
        assert added.norm() > 0.1 * weight.norm()
        torch.testing.assert_close(merged[name], dequantised + added, atol=1e-6, rtol=1e-5)
        changed += 1
    assert changed == 2 * 7


@pytest.mark.parametrize("format", ["bf16", "fp32"])
def test_merged_weights_have_the_format_and_are_not_quantised(exports, format) -> None:
    weights = load_file(exports[format] / "model.safetensors").values()
    assert {w.dtype for w in weights} == {loading.DTYPES[format]}
    assert "quantization" not in (exports[format] / "config.json").read_text()


SCRIPT = """
import sys
import torch
from transformers import AutoModelForImageTextToText, AutoProcessor
from transformers.video_utils import VideoMetadata

folder, inputs, outputs = sys.argv[1:]
data = torch.load(inputs, weights_only=False)
processor = AutoProcessor.from_pretrained(folder)
model = AutoModelForImageTextToText.from_pretrained(folder).eval()
text = processor.apply_chat_template(
    [{"role": "user", "content": data["content"]}], tokenize=False, add_generation_prompt=True
)
batch = processor(
    text=[text], images=data["images"], videos=[data["video"]],
    video_metadata=[VideoMetadata(**data["metadata"])], return_tensors="pt",
)
with torch.no_grad():
    logits = model(**batch).logits
assert not {"dynapix", "peft", "bitsandbytes"} & set(sys.modules)
torch.save((batch["input_ids"], logits), outputs)
"""


@pytest.mark.slow
def test_transformers_alone_computes_the_same_logits(
    settings, runs, exports, micro_store, frames, tmp_path
) -> None:
    """They equal those of the trained student, the adapters over their 4-bit base."""
    item = micro_store.selection("test")[0]
    sample = selection_sample(item, "answer", "cot", frames, settings.student.frames)
    data = {"content": sample.content, "images": sample.images}
    data |= {"video": sample.clip.pixels, "metadata": sample.clip.metadata}
    torch.save(data, tmp_path / "inputs.pt")
    arguments = [exports["fp32"], tmp_path / "inputs.pt", tmp_path / "outputs.pt"]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    run_child([sys.executable, "-c", SCRIPT, *arguments], check=True, cwd=tmp_path, env=environment)
    ids, logits = torch.load(tmp_path / "outputs.pt")
    student = runs / "sft" / "run" / "student"
    model, processor = loading.load_trained(settings.student, "fp32", student)
    # Some CPUs round 4-bit products differently once the weights are packed for inference.
    compat.keep_differentiable(model)
    encoded = encode(sample, processor, 1500)
    assert ids[0].tolist() == encoded.input_ids
    types = {name: torch.tensor([values]) for name, values in encoded.token_types.items()}
    with torch.no_grad():
        expected = model(input_ids=ids, **types, **encoded.media).logits
    torch.testing.assert_close(logits, expected, atol=1e-4, rtol=1e-4)


def test_an_export_is_kept_and_refused_for_other_adapters(
    settings, runs, exports, tmp_path
) -> None:
    shutil.copytree(runs, tmp_path / "runs")
    folder = exports["fp32"]
    before = (folder / "model.safetensors").stat()
    exported(settings, tmp_path / "runs", "fp32", folder.parent)
    assert run_title(folder) == "run fp32"
    assert (folder / "model.safetensors").stat() == before
    path = tmp_path / "runs" / "sft" / "run" / "student" / "adapter_model.safetensors"
    save_file({k: v + 1 for k, v in load_file(path).items()}, path, metadata={"format": "pt"})
    with raises_user_error("other-adapters"):
        exported(settings, tmp_path / "runs", "fp32", folder.parent)


def test_leftovers_of_a_killed_export_are_deleted(settings, runs, exports, tmp_path) -> None:
    (tmp_path / ".student.partial").mkdir()
    (tmp_path / ".student.partial" / "model.safetensors").write_bytes(b"half")
    folder = exported(settings, runs, "adapter", tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {".student.lock", "student"}
    names = {p.name for p in folder.iterdir()}
    assert "model.safetensors" not in names
    assert names == {p.name for p in exports["adapter"].iterdir()}
    for name in ("adapter_model.safetensors", "adapter_config.json", "processor_config.json"):
        trained = runs / "sft" / "run" / "student" / name
        assert (folder / name).read_bytes() == trained.read_bytes()


def test_the_card_describes_the_run(settings, runs, exports) -> None:
    card = ModelCard.load(exports["adapter"] / "README.md")
    assert card.data.library_name == "peft"
    assert card.data.tags == ["dynapix", "cot"]
    for row in (
        f"| base | {settings.student.model} |",
        "  quantization: nf4\n  lora:\n    rank: 4\n    alpha: 32\n",
        "| benchmark | micro, 10 scenes by bullet, seed 0 |",
        "| teacher | template |",
        "| answer loss | 2.5 | 0.375 |",
        "| answer macro | micro | `evaluation.select` | 0.625 |",
        # The warning about servers, which load adapters over the released base.
        "unquantised base",
    ):
        assert row in card.text
    # The hub shows the results of whole evaluations.
    found = [(result.metric_type, result.metric_value) for result in card.data.eval_results]
    assert found == [("answer_macro", 0.625), ("cot_text_mrr", 0.375)]
    hub = replace(settings, student=replace(settings.student, model="Qwen/Qwen3-VL-2B-Instruct"))
    run = runs / "sft" / "run"
    card = build_model_card("run", hub, run, run / "student", "bf16", METRICS)
    assert card.data.base_model == "Qwen/Qwen3-VL-2B-Instruct"
    assert "unquantised base" not in card.text


@pytest.mark.slow
def test_the_code_of_the_card_runs_from_another_directory(
    settings, runs, exports, tmp_path
) -> None:
    folder = runs / "sft" / "run" / "student"
    write_run_card(Run("run", folder.parent), settings, METRICS)
    printed = run_cards([folder, exports["fp32"], exports["adapter"]], tmp_path)
    assert len(printed.splitlines()) >= 3


def set_rank_to_zero(config: Path) -> None:
    text = config.read_text()
    assert "rank: 4" in text
    config.write_text(text.replace("rank: 4", "rank: 0").replace("nf4", "none"))


@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (lambda run: (run / "metrics.json").unlink(), "unfinished-run"),
        (lambda run: shutil.rmtree(run), "missing-run"),
        (lambda run: set_rank_to_zero(run / "config.yaml"), "nothing-to-merge"),
        (lambda run: (run / "student" / "adapter_model.safetensors").unlink(), "missing-adapters"),
        (
            lambda run: (run / "resolved.yaml").write_text("{precision: fp32, base: x, data: x}"),
            "other-base",
        ),
    ],
)
def test_a_run_that_cannot_be_exported_is_refused(settings, runs, tmp_path, damage, code) -> None:
    shutil.copytree(runs, tmp_path / "runs")
    damage(tmp_path / "runs" / "sft" / "run")
    with raises_user_error(code):
        exported(settings, tmp_path / "runs", "adapter", tmp_path / "into")
    assert [p.name for p in (tmp_path / "into").iterdir() if p.suffix != ".lock"] == []


def test_a_damaged_export_is_refused(settings, exports, tmp_path) -> None:
    shutil.copytree(exports["bf16"], tmp_path / "export")
    weights = tmp_path / "export" / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:5000])
    trained = read_trained_settings(tmp_path / "export", SftCommand, "student")
    assert asdict(trained) == asdict(settings)
    with raises_user_error("damaged-file"):
        loading.load_trained(trained.student, "fp32", tmp_path / "export")
    (tmp_path / "config.yaml").write_text("format: bf16")
    (tmp_path / "export").rename(tmp_path / "student")
    with raises_user_error("missing-run", contains="student"):
        read_trained_settings(tmp_path, SftCommand, "student")
    (tmp_path / "student" / "export.json").write_text("{")
    with raises_user_error("damaged-file"):
        run_title(tmp_path / "student")
