"""Export a trained student or retriever: merged into its base, or its adapters alone.

    checkpoints/export_<product>/<run>/<format>/<product>/
        config.json, model.safetensors         for the standard classes, or
        adapter_config.json, adapter_model.safetensors      for peft
        modules.json and the modules' folders, of a retriever
        tokenizer and processor files
        README.md      the model card
        config.yaml, run.json, metrics.json    from the training run; resolved.yaml with adapters
        export.json    what was exported, and how far it differs from what was trained

The folder is written under another name and renamed when it is complete.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import lock_folder, resolve_run_name, runs_folder, write_json
from conf.schema import (
    ContrastiveCommand,
    ExportModelCommand,
    RetrieverConfig,
    SftCommand,
    StudentConfig,
)

log = logging.getLogger(__name__)

RECORDS = ("config.yaml", "run.json", "metrics.json")
"""Files of the training run that belong to its export."""
COMMANDS = {"student": SftCommand, "retriever": ContrastiveCommand}
LOADERS = {
    "student": "the standard classes and vLLM load",
    "retriever": "SentenceTransformer loads",
}


@dataclass(frozen=True)
class TrainedRun:
    """A finished training run.

    Attributes:
        name: The run.
        folder: Its folder.
        product: What it trained: student or retriever.
        settings: Its settings.
    """

    name: str
    folder: Path
    product: str
    settings: SftCommand | ContrastiveCommand

    @property
    def saved(self) -> Path:
        return self.folder / self.product

    @property
    def preset(self) -> StudentConfig | RetrieverConfig:
        return getattr(self.settings, self.product)


@command("train.export", ExportModelCommand)
def main(cfg: ExportModelCommand, run: Run) -> dict[str, float]:
    trained = find_run(cfg.run, cfg.product, cfg.checkpoints)

    from data.store import hash_file
    from models.resolved import RESOLVED, check_base
    from models.trained_runs import EXPORT, export_record
    from train.common.merge import write_merged
    from train.common.model_card import model_card

    adapters = trained.saved / "adapter_model.safetensors"
    if not adapters.exists():
        raise UserError(
            f"{trained.saved} holds no adapters: delete the run and train again",
            code="missing-adapters",
        )
    check_base(trained.folder, trained.preset)
    weights = hash_file(adapters)
    folder = run.folder / trained.product
    if folder.exists():
        record = export_record(folder)
        if record["weights"] != weights:
            raise UserError(
                f"{folder} is an export of other adapters than {trained.saved} holds now: "
                "delete it to export these",
                code="other-adapters",
            )
        log.info("%s is exported already; delete it to export again", folder)
        return record["measured"]
    measured: dict[str, float] = {}
    with renamed_when_complete(folder) as partial:
        if cfg.format == "adapter":
            shutil.copytree(trained.saved, partial, dirs_exist_ok=True)
            if (resolved := trained.folder / RESOLVED).exists():
                shutil.copy(resolved, partial)
        else:
            store = Path(cfg.store) if cfg.verify else None
            measured = write_merged(product_merge(trained), partial, cfg.format, store, cfg.workers)
        for name in RECORDS:
            shutil.copy(trained.folder / name, partial)
        card = model_card(trained.name, trained.settings, trained.folder, cfg.format, measured)
        card.save(partial / "README.md")
        record = {"run": trained.name, "format": cfg.format, "weights": weights}
        write_json(partial / EXPORT, {**record, "measured": measured})
    for name, value in measured.items():
        log.info("%s: %.4g", name.replace("_", " "), value)
    log.info("the exported %s is in %s", trained.product, folder)
    return measured


def find_run(run: str, product: str, checkpoints: str) -> TrainedRun:
    """Find the run to export.

    Raises:
        UserError: No run has this name, it is not finished, or it trained the whole model.
    """
    from models.trained_runs import trained_settings

    runs = runs_folder(checkpoints, product)
    name = resolve_run_name(run, runs)
    folder = Path(runs) / name
    settings = trained_settings(folder, COMMANDS[product], product, "run")
    trained = TrainedRun(name, folder, product, settings)
    if trained.preset.lora.rank == 0:
        raise UserError(
            f"run={folder} trained the whole model ({product}.lora.rank=0), so it has no adapters "
            f"to merge: {trained.saved} is what {LOADERS[product]}",
            code="nothing-to-merge",
        )
    return trained


def product_merge(trained: TrainedRun):
    """The merge of a run's student or retriever."""
    if trained.product == "student":
        from train.student.merge import StudentMerge

        return StudentMerge(trained.settings, trained.saved)
    from train.retriever.merge import RetrieverMerge

    return RetrieverMerge(trained.settings, trained.saved)


@contextmanager
def renamed_when_complete(folder: Path) -> Iterator[Path]:
    """Yield a folder to write into, and rename it to `folder` at the end. Leftovers of an
    interrupted export are deleted."""
    partial = folder.with_name(f".{folder.name}.partial")
    partial.mkdir(exist_ok=True)
    with lock_folder(partial, f"{folder} is being written by another process"):
        for leftover in partial.iterdir():
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        try:
            yield partial
        except (UserError, KeyboardInterrupt):
            shutil.rmtree(partial)
            raise
        partial.rename(folder)


if __name__ == "__main__":
    main()
