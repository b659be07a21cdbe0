"""The model card of an exported student: what its training run wrote down, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from huggingface_hub import ModelCardData

from conf.schema import SftCommand
from conf.sweep import AT_START
from train.compatible import BASE
from train.journal import BEST_STEP

SHOWN_PACKAGES = ("torch", "transformers", "peft", "bitsandbytes")
WHAT = {
    "bf16": "A student of DynaPix, merged into its base; weights in bf16.",
    "fp32": "A student of DynaPix, merged into its base; weights in fp32.",
    "adapter": "A student of DynaPix: the LoRA adapters, to be laid over their base.",
}


def text(
    name: str, settings: SftCommand, folder: Path, format: str, measured: dict[str, float]
) -> str:
    """README.md of an export of the run in `folder`.

    `measured` is how far the exported weights are from the trained student.
    """
    metrics = json.loads((folder / "metrics.json").read_text())
    kept = _kept(settings, metrics)
    sections = [
        f"---\n{front_matter(settings, format)}\n---",
        f"# {name}",
        WHAT[format],
        "## How it was trained",
        _table(("", ""), _training(settings, folder)),
        "## How it was measured",
        f"On the items of training scenes that it was not trained on, "
        f"{settings.train.validation_items} at most, before the first step and {kept}. "
        "A letter is chosen by the letters' logits, with what stands before it given.",
        _table(("", "start", "end"), _curve(metrics)),
    ]
    if measured:
        told = [(key.replace("_", " "), _figure(value)) for key, value in measured.items()]
        sections += [
            "The merged weights against the adapters over their base as they were trained, on some "
            "of these items (differences of logits as a share of their size):",
            _table(("", ""), told),
        ]
    return "\n\n".join(sections) + "\n"


def front_matter(settings: SftCommand, format: str) -> str:
    """The card's metadata as YAML. A base in a folder is none that a hub could link to."""
    model = settings.student.model
    return ModelCardData(
        base_model=None if Path(model).is_dir() else model,
        library_name="peft" if format == "adapter" else "transformers",
        pipeline_tag="image-text-to-text",
        tags=["dynapix", settings.train.regime],
    ).to_yaml()


def _training(settings: SftCommand, folder: Path) -> Iterable[tuple[str, str]]:
    student, train, benchmark = settings.student, settings.train, settings.benchmark
    record = json.loads((folder / "run.json").read_text())
    yield "base", f"{student.model}{f' at {student.revision}' if student.revision else ''}"
    if (folder / BASE).exists():
        yield "hash of the base's weights", json.loads((folder / BASE).read_text())
    yield "quantisation of the base", student.quantization
    lora = student.lora
    yield "adapters", f"LoRA of rank {lora.rank}, alpha {lora.alpha}, dropout {lora.dropout}"
    yield "regime", train.regime
    scenes = f"{benchmark.scenes} scenes by " if benchmark.simulator == "bullet" else ""
    yield "benchmark", f"{benchmark.name}, {scenes}{benchmark.simulator}, seed {benchmark.seed}"
    if train.regime not in ("answer_only", "describe"):
        teacher = settings.teacher
        yield "teacher", f"{teacher.name}{f' ({teacher.model})' if teacher.model else ''}"
    yield "frames", f"{student.frames} a prefix, {student.image_size} x {student.image_size} px"
    length = f"{train.epochs:g} epochs" if train.max_steps == -1 else f"{train.max_steps} steps"
    yield "length", f"{length} of {train.batch} samples a step"
    yield "learning rate", f"{train.lr:g}, {train.schedule}"
    yield "precision", train.precision
    yield "seed", str(settings.seed)
    yield "started", record["started"]
    if record["git"]:
        changed = ", with changes" if record["git"]["dirty"] else ""
        yield "code", f"commit {record['git']['commit']}{changed}"
    versions = record["packages"]
    yield "versions", ", ".join(f"{p} {versions[p]}" for p in SHOWN_PACKAGES if p in versions)


def _kept(settings: SftCommand, metrics: dict[str, float]) -> str:
    """Of which step the exported student is."""
    if (step := metrics.get(BEST_STEP)) is None:
        return "after the last"
    return f"after step {step:g}, the best by {settings.train.best}"


def _curve(metrics: dict[str, float]) -> Iterable[tuple[str, str, str]]:
    for name, value in metrics.items():
        if (start := metrics.get(f"{name}{AT_START}")) is not None:
            yield name.replace("_", " "), _figure(start), _figure(value)


def _figure(value: float) -> str:
    return f"{value:.4g}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
