"""Export a trained student or retriever: merged into its base, or its adapters alone.

    checkpoints/export_<product>/<run>/<format>/<product>/
        config.json, model.safetensors         bf16 and fp32: for the libraries alone
        adapter_config.json, adapter_model.safetensors, resolved.yaml    adapter: for peft
        modules.json and the modules' folders  of a retriever
        tokenizer and processor files
        README.md      the model card
        config.yaml, run.json, metrics.json    copied from the training run
        export.json    the run, the format, and a digest of the adapters

Until it is complete, the folder has a temporary name.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import UserError
from dynapix.conf.files import read_json, write_json
from dynapix.conf.runs import lock_file, resolve_run_name, runs_folder
from dynapix.conf.schema import ContrastiveCommand, ExportModelCommand, LoraConfig, SftCommand

log = logging.getLogger(__name__)

RECORDS = ("run.json", "metrics.json")
"""Files that are copied from the training run to its export, beside its settings."""
COMMANDS = {"student": SftCommand, "retriever": ContrastiveCommand}


@command("train.export", ExportModelCommand)
def main(cfg: ExportModelCommand, run: Run) -> dict[str, float]:
    from dynapix.data.store import hash_file
    from dynapix.models.checks import ADAPTER_WEIGHTS
    from dynapix.models.resolved_settings import RESOLVED
    from dynapix.models.trained_runs import EXPORT, read_export_record, settings_file
    from dynapix.train.common.model_card import CARD, build_model_card, find_evaluations

    name, run_folder, settings = find_run(cfg.run, cfg.product, cfg.checkpoints)
    saved, folder = run_folder / cfg.product, run.folder / cfg.product
    weights = hash_file(saved / ADAPTER_WEIGHTS)
    if folder.exists():
        record = read_export_record(folder)
        if record["weights"] != weights:
            raise UserError(
                f"{folder} was exported from other adapters than those now in {saved}: delete "
                f"{folder} and export again",
                code="other-adapters",
            )
        log.info("%s is already exported; delete it to export again", folder)
        return {}
    with renamed_when_complete(folder) as partial:
        if cfg.format == "adapter":
            shutil.copytree(saved, partial, dirs_exist_ok=True)
            if (resolved := run_folder / RESOLVED).exists():
                shutil.copy(resolved, partial)
        elif cfg.product == "student":
            write_merged_student(settings, saved, partial, cfg.format)
        else:
            write_merged_retriever(settings, saved, partial, cfg.format)
        for file_name in RECORDS:
            shutil.copy(run_folder / file_name, partial)
        shutil.copy(settings_file(run_folder), partial / "config.yaml")
        metrics = read_json(run_folder / "metrics.json")
        results = find_evaluations(Path(cfg.checkpoints), run_folder)
        card = build_model_card(name, settings, run_folder, folder, cfg.format, metrics, results)
        card.save(partial / CARD)
        write_json(partial / EXPORT, {"run": name, "format": cfg.format, "weights": weights})
    log.info("the exported %s is in %s", cfg.product, folder)
    return {}


def find_run(
    run: str, product: str, checkpoints: str
) -> tuple[str, Path, SftCommand | ContrastiveCommand]:
    """Return the name, the folder and the settings of the run to export.

    Raises:
        UserError: The run does not exist, is not finished or trained all weights; its adapters are
            missing; its base has changed; or a file is damaged.
    """
    from safetensors import safe_open

    from dynapix.models.checks import ADAPTER_WEIGHTS
    from dynapix.models.loading import explain_damage
    from dynapix.models.resolved_settings import check_base
    from dynapix.models.trained_runs import read_trained_settings

    runs = runs_folder(checkpoints, product, run)
    name = resolve_run_name(run, runs)
    folder = Path(runs) / name
    settings = read_trained_settings(folder, COMMANDS[product], product, "run")
    preset = getattr(settings, product)
    if preset.lora.rank == 0:
        raise UserError(
            f"run={folder} trained the whole model ({product}.lora.rank=0), so it has no adapters "
            f"to merge: {folder / product} is the model itself",
            code="nothing-to-merge",
        )
    if not (adapters := folder / product / ADAPTER_WEIGHTS).exists():
        raise UserError(
            f"{folder / product} holds no adapters: delete the run and train again",
            code="missing-adapters",
        )
    with explain_damage(folder), safe_open(adapters, "pt"):
        pass
    for record in RECORDS:
        read_json(folder / record)
    check_base(folder, preset)
    return name, folder, settings


def write_merged_student(settings: SftCommand, saved: Path, folder: Path, format: str) -> None:
    """Write a student merged with its adapters in `saved`, with weights in `format`, bf16 or
    fp32."""
    from dynapix.models import loading

    student = settings.student
    base, processor = loading.load_base(student, settings.train.precision, list)
    model = loading.merge_adapters(base, saved, student.quantization, format)
    loading.write_model(model, processor, folder)


def write_merged_retriever(
    settings: ContrastiveCommand, saved: Path, folder: Path, format: str
) -> None:
    """Write a retriever merged with its adapters in `saved`, as `write_merged_student` does."""
    from dynapix.models import loading
    from dynapix.models.retriever.embedder import load_head, load_retriever

    base = replace(settings.retriever, lora=LoraConfig(rank=0))
    model = load_retriever(base, settings.train.precision, [], folder)
    model[0].model = loading.merge_adapters(model[0].model, saved, base.quantization, format)
    load_head(model, saved)
    model.save_pretrained(str(folder), create_model_card=False)


@contextmanager
def renamed_when_complete(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder, and rename it to `folder` at the end of the block. It is deleted
    after an exception, and emptied first if a killed export left files in it."""
    partial = folder.with_name(f".{folder.name}.partial")
    with lock_file(partial.with_suffix(".lock"), f"{folder} is being written by another process"):
        partial.mkdir(exist_ok=True)
        for leftover in partial.iterdir():
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        try:
            yield partial
        except BaseException:
            shutil.rmtree(partial)
            raise
        partial.rename(folder)


if __name__ == "__main__":
    main()
