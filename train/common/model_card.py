"""The model card of an export, from what its training run recorded."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import ModelCard, ModelCardData

from conf.multirun.table import AT_START_SUFFIX
from conf.schema import ContrastiveCommand, SftCommand
from models.fingerprints import is_hub_model
from models.resolved import read_resolved
from train.common.journal import BEST_STEP

PACKAGES = ("torch", "transformers", "sentence-transformers", "peft", "bitsandbytes")
"""Packages whose versions the card lists."""
FORMATS = {
    "bf16": "merged into its base; weights in bf16",
    "fp32": "merged into its base; weights in fp32",
    "adapter": "the LoRA adapters, to be loaded over their base",
}
NO_TEACHER = ("answer_only", "describe")
"""Regimes without rationales."""
PIPELINES = {"student": "image-text-to-text", "retriever": "sentence-similarity"}
TEMPLATE = """---
{{ card_data }}
---

# {{ name }}

A {{ product }} of DynaPix: {{ format }}.

## Training

| | |
| --- | --- |
{% for label, value in training %}| {{ label }} | {{ value }} |
{% endfor %}

The settings that define it:

```yaml
{{ settings }}```
{% if over_nf4 %}
The adapters belong to the base in NF4, as bitsandbytes quantises it. Over the unquantised base, as
servers load them, the model differs from the trained one; the merged weights do not
(`python -m train.export run={{ name }} product={{ product }} format=bf16`).
{% endif %}
## Evaluation

On at most {{ count }} {{ items }} of training scenes that the model was not trained on, before the
first step and after {{ kept }}.
{% if product == "student" %}
A letter is chosen by the letters' logits, after the correct preceding text.
{% else %}
The database consists of frames of these scenes.
{% endif %}

| | start | end |
| --- | --- | --- |
{% for label, start, end in curve %}| {{ label }} | {{ start }} | {{ end }} |
{% endfor %}
{% if measured %}
The merged weights compared with the adapters over their base as trained, on some of these
{{ items }} (differences are relative to the size of the values):

| | |
| --- | --- |
{% for label, value in measured %}| {{ label }} | {{ value }} |
{% endfor %}
{% endif %}"""


def model_card(
    name: str,
    settings: SftCommand | ContrastiveCommand,
    folder: Path,
    format: str,
    measured: dict[str, float],
) -> ModelCard:
    """The card of an export.

    Args:
        name: The training run.
        settings: Its settings.
        folder: Its folder.
        format: What was exported: bf16, fp32 or adapter.
        measured: Differences between the exported and the trained model.
    """
    student = isinstance(settings, SftCommand)
    product = "student" if student else "retriever"
    preset, train = getattr(settings, product), settings.train
    metrics = json.loads((folder / "metrics.json").read_text())
    merged_library = "transformers" if student else "sentence-transformers"
    return ModelCard.from_template(
        ModelCardData(
            # A local folder is not a model that the hub could link to.
            base_model=preset.model if is_hub_model(preset.model) else None,
            library_name="peft" if format == "adapter" else merged_library,
            pipeline_tag=PIPELINES[product],
            tags=["dynapix", train.regime if student else "retriever"],
        ),
        template_str=TEMPLATE,
        name=name,
        product=product,
        format=FORMATS[format],
        training=list(_training_rows(settings, preset, folder)),
        settings=yaml.safe_dump({product: asdict(preset), "train": asdict(train)}, sort_keys=False),
        over_nf4=format == "adapter" and preset.quantization == "nf4",
        count=train.validation_items if student else train.validation_queries,
        items="items" if student else "queries",
        kept=_kept_step(train.best_metric, metrics),
        curve=[
            (_label(key), f"{metrics[f'{key}{AT_START_SUFFIX}']:.4g}", f"{value:.4g}")
            for key, value in metrics.items()
            if f"{key}{AT_START_SUFFIX}" in metrics
        ],
        measured=[(_label(key), f"{value:.4g}") for key, value in measured.items()],
    )


def _label(name: str) -> str:
    return name.replace("_", " ")


def _kept_step(best: str | None, metrics: dict[str, float]) -> str:
    """The step whose weights are exported."""
    if (step := metrics.get(BEST_STEP)) is None:
        return "the last one"
    return f"step {step:g}, the best by {best}"


def _training_rows(
    settings: SftCommand | ContrastiveCommand, preset: Any, folder: Path
) -> Iterator[tuple[str, str]]:
    benchmark = settings.benchmark
    record = json.loads((folder / "run.json").read_text())
    yield "base", f"{preset.model}{f' at {preset.revision}' if preset.revision else ''}"
    if not is_hub_model(preset.model) and (resolved := read_resolved(folder)):
        yield "digest of the base's weights", resolved["base"]
    scenes = f"{benchmark.scenes} scenes by " if benchmark.simulator == "bullet" else ""
    yield "benchmark", f"{benchmark.name}, {scenes}{benchmark.simulator}, seed {benchmark.seed}"
    if isinstance(settings, SftCommand) and settings.train.regime not in NO_TEACHER:
        teacher = settings.teacher
        yield "teacher", f"{teacher.name}{f' ({teacher.model})' if teacher.model else ''}"
    yield "seed", str(settings.seed)
    yield "started", record["started"]
    if record["git"]:
        changed = ", with changes" if record["git"]["dirty"] else ""
        yield "code", f"commit {record['git']['commit']}{changed}"
    versions = record["packages"]
    yield "versions", ", ".join(f"{p} {versions[p]}" for p in PACKAGES if p in versions)
