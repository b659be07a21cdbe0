"""The model card of an export: what its training run wrote down, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from huggingface_hub import ModelCardData

from conf.multirun.table import AT_START_SUFFIX
from conf.schema import ContrastiveCommand, RetrieverConfig, SftCommand, StudentConfig
from models.fingerprints import is_hub_model
from models.resolved import read_resolved
from train.common.journal import BEST_STEP

SHOWN_PACKAGES = ("torch", "transformers", "sentence-transformers", "peft", "bitsandbytes")
WHAT = {
    "bf16": "merged into its base; weights in bf16.",
    "fp32": "merged into its base; weights in fp32.",
    "adapter": "the LoRA adapters, to be laid over their base.",
}
OVER_NF4 = (
    "The adapters go with the base in NF4, as bitsandbytes rounds it. Over a base that is not "
    "rounded, as a server lays them, they give something else than was trained; the merged weights "
    "do not (`python -m train.export run={run} product={product} format=bf16`)."
)
MEASURED = {
    "student": "On the items of training scenes that it was not trained on, {count} at most, "
    "before the first step and {kept}. A letter is chosen by the letters' logits, with what stands "
    "before it given.",
    "retriever": "On the queries of training scenes that it was not trained on, {count} at most, "
    "over the frames of these scenes, before the first step and {kept}.",
}
APART = {
    "student": "The merged weights against the adapters over their base as they were trained, on "
    "some of these items (differences of logits as a share of their size):",
    "retriever": "The merged weights against the adapters over their base as they were trained, on "
    "some of these queries (differences of embeddings and scores as a share of their size):",
}
PIPELINES = {"student": "image-text-to-text", "retriever": "sentence-similarity"}

Settings = SftCommand | ContrastiveCommand


def text(
    name: str, settings: Settings, folder: Path, format: str, measured: dict[str, float]
) -> str:
    """README.md of an export of the run in `folder`.

    `measured` is how far the exported weights are from the trained student or retriever.
    """
    product, preset = product_of(settings), preset_of(settings)
    metrics = json.loads((folder / "metrics.json").read_text())
    train = settings.train
    count = train.validation_items if product == "student" else train.validation_queries
    sections = [
        f"---\n{front_matter(settings, format)}\n---",
        f"# {name}",
        f"A {product} of DynaPix: {WHAT[format]}",
        "## How it was trained",
        _table(("", ""), _training(settings, folder)),
        *(
            [OVER_NF4.format(run=name, product=product)]
            if format == "adapter" and preset.quantization == "nf4"
            else []
        ),
        "## How it was measured",
        MEASURED[product].format(count=count, kept=_kept(settings, metrics)),
        _table(("", "start", "end"), _curve(metrics)),
    ]
    if measured:
        told = [(key.replace("_", " "), _figure(value)) for key, value in measured.items()]
        sections += [APART[product], _table(("", ""), told)]
    return "\n\n".join(sections) + "\n"


def product_of(settings: Settings) -> str:
    return "student" if isinstance(settings, SftCommand) else "retriever"


def preset_of(settings: Settings) -> StudentConfig | RetrieverConfig:
    return getattr(settings, product_of(settings))


def front_matter(settings: Settings, format: str) -> str:
    """The card's metadata as YAML. A base in a folder is none that a hub could link to."""
    model = preset_of(settings).model
    student = isinstance(settings, SftCommand)
    merged = "transformers" if student else "sentence-transformers"
    return ModelCardData(
        base_model=None if Path(model).is_dir() else model,
        library_name="peft" if format == "adapter" else merged,
        pipeline_tag=PIPELINES[product_of(settings)],
        tags=["dynapix", settings.train.regime if student else "retriever"],
    ).to_yaml()


def _training(settings: Settings, folder: Path) -> Iterable[tuple[str, str]]:
    preset, train, benchmark = preset_of(settings), settings.train, settings.benchmark
    student = isinstance(settings, SftCommand)
    record = json.loads((folder / "run.json").read_text())
    yield "base", f"{preset.model}{f' at {preset.revision}' if preset.revision else ''}"
    if not is_hub_model(preset.model) and (resolved := read_resolved(folder)):
        yield "hash of the base's weights", resolved["base"]
    yield "quantisation of the base", preset.quantization
    lora = preset.lora
    yield "adapters", f"LoRA of rank {lora.rank}, alpha {lora.alpha}, dropout {lora.dropout}"
    scenes = f"{benchmark.scenes} scenes by " if benchmark.simulator == "bullet" else ""
    yield "benchmark", f"{benchmark.name}, {scenes}{benchmark.simulator}, seed {benchmark.seed}"
    yield from _of_student(settings) if student else _of_retriever(settings)
    yield "frames", f"{preset.frames} a prefix, {preset.image_size} x {preset.image_size} px"
    length = f"{train.epochs:g} epochs" if train.max_steps == -1 else f"{train.max_steps} steps"
    yield "length", f"{length} of {train.batch} {'samples' if student else 'queries'} a step"
    yield "learning rate", f"{train.lr:g}, {train.schedule}"
    yield "precision", train.precision
    yield "seed", str(settings.seed)
    yield "started", record["started"]
    if record["git"]:
        changed = ", with changes" if record["git"]["dirty"] else ""
        yield "code", f"commit {record['git']['commit']}{changed}"
    versions = record["packages"]
    yield "versions", ", ".join(f"{p} {versions[p]}" for p in SHOWN_PACKAGES if p in versions)


def _of_student(settings: SftCommand) -> Iterable[tuple[str, str]]:
    yield "regime", settings.train.regime
    if settings.train.regime not in ("answer_only", "describe"):
        teacher = settings.teacher
        yield "teacher", f"{teacher.name}{f' ({teacher.model})' if teacher.model else ''}"


def _of_retriever(settings: ContrastiveCommand) -> Iterable[tuple[str, str]]:
    preset, train = settings.retriever, settings.train
    if preset.late is None:
        yield "widths", ", ".join(map(str, preset.widths))
    else:
        yield "vectors", f"one a token, {preset.late.width} wide, for late interaction"
    yield "instruction of queries", preset.query_instruction
    yield "instruction of frames", preset.frame_instruction
    mined = f", mined every {train.mine_every} steps" if train.mine_every else ""
    yield "hard negatives", f"{train.hard_negatives} a query{mined}"
    yield "scale of scores", f"{train.scale:g}"


def _kept(settings: Settings, metrics: dict[str, float]) -> str:
    """Of which step the exported weights are."""
    if (step := metrics.get(BEST_STEP)) is None:
        return "after the last"
    return f"after step {step:g}, the best by {settings.train.best}"


def _curve(metrics: dict[str, float]) -> Iterable[tuple[str, str, str]]:
    for name, value in metrics.items():
        if (start := metrics.get(f"{name}{AT_START_SUFFIX}")) is not None:
            yield name.replace("_", " "), _figure(start), _figure(value)


def _figure(value: float) -> str:
    return f"{value:.4g}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
