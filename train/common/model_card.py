"""Build the model card of an export from the records of its training run."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import yaml
from huggingface_hub import ModelCard, ModelCardData

from conf.files import read_json
from conf.multirun.table import AT_START_SUFFIX
from conf.schema import ContrastiveCommand, SftCommand
from models.fingerprints import is_hub_model
from models.resolved_settings import read_resolved
from train.common.journal import BEST_STEP


def build_model_card(
    name: str,
    settings: SftCommand | ContrastiveCommand,
    folder: Path,
    format: str,
    measured: dict[str, float],
) -> ModelCard:
    """Return the card of an export.

    Args:
        name: Name of the training run.
        settings: Settings of the training run.
        folder: Folder of the training run.
        format: bf16, fp32 or adapter.
        measured: What `train.common.output_comparison.compare_outputs` returned; empty without a
            comparison.
    """
    student = isinstance(settings, SftCommand)
    product = "student" if student else "retriever"
    preset, train = getattr(settings, product), settings.train
    narrated = student and train.regime != "answer_only"
    on_hub = is_hub_model(preset.model)
    metrics = read_json(folder / "metrics.json")
    merged_library = "transformers" if student else "sentence-transformers"
    return ModelCard.from_template(
        ModelCardData(
            # A local folder is not a model that the hub could link to.
            base_model=preset.model if on_hub else None,
            library_name="peft" if format == "adapter" else merged_library,
            pipeline_tag="image-text-to-text" if student else "sentence-similarity",
            tags=["dynapix", train.regime if student else "retriever"],
        ),
        template_path=str(Path(__file__).with_suffix(".md")),
        name=name,
        product=product,
        format=format,
        preset=preset,
        digest=None if on_hub else read_resolved(folder).get("base"),
        benchmark=settings.benchmark,
        seed=settings.seed,
        teacher=settings.teacher if narrated else None,
        record=read_json(folder / "run.json"),
        settings=yaml.safe_dump({product: asdict(preset), "train": asdict(train)}, sort_keys=False),
        items="items" if student else "queries",
        best_step=metrics.get(BEST_STEP),
        best_metric=train.best_metric,
        metrics=metrics,
        at_start=AT_START_SUFFIX,
        measured=measured,
    )
