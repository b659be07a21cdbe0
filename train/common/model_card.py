"""Build the model cards of trained runs and of exports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml
from huggingface_hub import EvalResult, ModelCard, ModelCardData, try_to_load_from_cache
from transformers import Qwen3VLProcessor

from dynapix.conf.files import read_json, read_json_if_valid
from dynapix.conf.multirun.table import AT_START_SUFFIX
from dynapix.conf.runs import Run
from dynapix.conf.schema import ContrastiveCommand, SftCommand
from dynapix.models.checks import ADAPTER_CONFIG
from dynapix.models.fingerprints import is_hub_model
from dynapix.models.resolved_settings import read_resolved
from dynapix.models.student.chat_format import TIMED_PROCESSORS
from dynapix.models.student.prompts import choose_instruction, write_time
from dynapix.models.trained_runs import locate_run, modes_of_regime, read_settings

CARD = "README.md"
EVALUATIONS = ("select", "similarity", "retrieve", "two_stage")
"""Folders below checkpoints/ of the evaluations whose results a card shows."""
TIMES = {
    "video": (
        "true times, from the frame rate and the indices of the frames; a processor of Qwen3-VL "
        "writes them in seconds before each pair of frames (`<0.5 seconds>`)"
    ),
    "images": f"a text before each frame, in seconds (`{write_time(0.5)}`)",
    "separate": "none: a clip is the mean of its frames",
}
"""Times of a clip, by the form of the input (`models.retriever.inputs`)."""


@dataclass(frozen=True)
class Evaluation:
    """The result of a command of `EVALUATIONS` for a model, on a benchmark's test items."""

    command: str
    benchmark: str
    metrics: dict[str, float]


def find_evaluations(checkpoints: Path, run: Path) -> list[Evaluation]:
    """Return the finished evaluations below `checkpoints` of the model that a run has trained, on
    all items and without a control."""
    found = []
    for command in EVALUATIONS:
        for metrics in sorted(checkpoints.glob(f"{command}/**/metrics.json")):
            settings = read_settings(metrics.parent / "config.yaml")
            model = settings.get("model") and locate_run(settings["model"], checkpoints)
            if not model or model.resolve() != run.resolve():
                continue
            if settings.get("limit") is None and settings.get("control") is None:
                benchmark = settings["benchmark"]["name"]
                found.append(Evaluation(f"evaluation.{command}", benchmark, read_json(metrics)))
    return found


def write_run_card(
    run: Run, settings: SftCommand | ContrastiveCommand, metrics: dict[str, float]
) -> None:
    """Write the card of the student or retriever of a run, which ends with `metrics`."""
    product = "student" if isinstance(settings, SftCommand) else "retriever"
    format = "adapter" if getattr(settings, product).lora.rank else "whole"
    folder = run.folder / product
    card = build_model_card(run.name, settings, run.folder, folder, format, metrics)
    card.save(folder / CARD)


def build_model_card(
    name: str,
    settings: SftCommand | ContrastiveCommand,
    run: Path,
    location: Path,
    format: str,
    metrics: dict[str, float],
    evaluations: Sequence[Evaluation] = (),
) -> ModelCard:
    """Return the card of a trained student or retriever.

    Args:
        name: Name of the training run.
        settings: Settings of the training run.
        run: Folder of the training run, with its student or retriever.
        location: Folder from which the card's code loads the model.
        format: bf16, fp32, adapter, or whole for a model all of whose weights were trained.
        metrics: Metrics of the run.
        evaluations: Results on test items, which the hub shows beside the card.
    """
    student = isinstance(settings, SftCommand)
    product = "student" if student else "retriever"
    preset, train = getattr(settings, product), settings.train
    narrated = student and train.regime != "answer_only"
    on_hub = is_hub_model(preset.model)
    saved = run / product
    record = read_json(run / "run.json") if (run / "run.json").exists() else {}
    base = None
    if format == "adapter":
        base = read_json(saved / ADAPTER_CONFIG)["base_model_name_or_path"]
    licence = read_licence(preset.model, preset.revision)
    if student:
        modes = modes_of_regime(train.regime)
        prompts = {
            f"end of a prompt in {m} mode": choose_instruction(m, train.regime) for m in modes
        }
    else:
        own = read_json(saved / "config_sentence_transformers.json")["prompts"]
        prompts = {f"prompt of a {kind}": text or "none" for kind, text in own.items()}
    processor = read_json_if_valid(saved / "processor_config.json")
    modalities = read_json_if_valid(saved / "sentence_bert_config.json").get("modality_config", {})
    form = "images" if student or "message" in modalities else "separate"
    timed = TIMED_PROCESSORS if student else (Qwen3VLProcessor,)
    if processor.get("processor_class") in [kind.__name__ for kind in timed]:
        form = "video"
    merged_library = "transformers" if student else "sentence-transformers"
    return ModelCard.from_template(
        ModelCardData(
            # A local folder is not a model that the hub could link to.
            base_model=preset.model if on_hub else None,
            license=licence,
            library_name="peft" if format == "adapter" else merged_library,
            pipeline_tag="image-text-to-text" if student else "sentence-similarity",
            tags=["dynapix", train.regime if student else "retriever"],
            model_name=name if evaluations else None,
            # The hub's library reads an empty list as a damaged one.
            eval_results=[
                EvalResult(
                    task_type="image-text-to-text" if student else "sentence-similarity",
                    dataset_type=f"dynapix-{each.benchmark}",
                    dataset_name=f"DynaPix {each.benchmark}",
                    dataset_split="test",
                    metric_type=metric,
                    metric_value=value,
                    metric_name=f"{metric}, {each.command}",
                )
                for each in evaluations
                for metric, value in each.metrics.items()
            ]
            or None,
        ),
        template_path=str(Path(__file__).with_suffix(".md")),
        name=name,
        student=student,
        product=product,
        kind="SentenceTransformer" if student or not preset.late else "MultiVectorEncoder",
        location=location.resolve(),
        format=format,
        quantized=format == "adapter" and preset.quantization == "nf4",
        preset=preset,
        base=base,
        prompts=prompts,
        form=form,
        times=TIMES[form],
        licence=licence,
        digest=None if on_hub else read_resolved(run).get("base"),
        benchmark=settings.benchmark,
        seed=settings.seed,
        teacher=settings.teacher if narrated else None,
        record=record,
        settings=yaml.safe_dump({product: asdict(preset), "train": asdict(train)}, sort_keys=False),
        items="items" if student else "queries",
        metrics=metrics,
        evaluations=evaluations,
        at_start=AT_START_SUFFIX,
    )


def read_licence(model: str | None, revision: str | None) -> str | None:
    """Return the licence that the card of a base names, if the card is on this machine."""
    if model is None:
        return None
    path = Path(model) / CARD
    if is_hub_model(model):
        cached = try_to_load_from_cache(model, CARD, revision=revision)
        path = Path(cached) if isinstance(cached, str) else path
    return ModelCard.load(path).data.license if path.exists() else None
