"""Write a trained student or retriever for others to load: merged into its base, or its adapters
alone.

    checkpoints/export_<product>/<run>/<format>/<product>/
        config.json, model.safetensors                 what the standard classes load, or
        adapter_config.json, adapter_model.safetensors what peft lays over the base
        modules.json and the modules' folders, of a retriever
        tokenizer and processor files
        README.md      the model card
        config.yaml, resolved.yaml, run.json, metrics.json    the training run's own
        export.json    what was exported, and how far what it gives is from what was trained

The folder is written beside and renamed when it is whole.
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
from conf.runs import lock_folder, resolve_run_name, runs_folder, write_json, write_text
from conf.schema import (
    ContrastiveCommand,
    ExportModelCommand,
    RetrieverConfig,
    SftCommand,
    StudentConfig,
)

log = logging.getLogger(__name__)

KEPT = ("config.yaml", "run.json", "metrics.json")
"""The training run's files that go with an export."""
TRAINED_BY = {"student": SftCommand, "retriever": ContrastiveCommand}
LOADED_BY = {
    "student": "the standard classes and vLLM load",
    "retriever": "SentenceTransformer loads",
}

Measured = dict[str, float]


@dataclass(frozen=True)
class Trained:
    """A finished run of a trainer: its name, its folder, what it trained (student, retriever), and
    its settings."""

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
def main(cfg: ExportModelCommand, run: Run) -> Measured:
    trained = find(cfg)

    from data.store import hash_file
    from models.resolved import check_base
    from models.trained_runs import EXPORT, export_record
    from train.common.model_card import text

    adapters = trained.saved / "adapter_model.safetensors"
    if not adapters.exists():
        raise UserError(f"{trained.saved} holds no adapters: delete the run and train again")
    check_base(trained.folder, trained.preset)
    weights = hash_file(adapters)
    folder = run.folder / trained.product
    if folder.exists():
        record = export_record(folder)
        if record["weights"] != weights:
            raise UserError(
                f"{folder} is an export of other adapters than {trained.saved} holds now: "
                "delete it to export these"
            )
        log.info("%s is exported already; delete it to export anew", folder)
        return record["measured"]
    with renamed_when_whole(folder) as partial:
        if cfg.format == "adapter":
            measured = write_adapter(trained, partial)
        else:
            measured = write_merged(trained, cfg, partial)
        for name in KEPT:
            shutil.copy(trained.folder / name, partial)
        card = text(trained.name, trained.settings, trained.folder, cfg.format, measured)
        write_text(partial / "README.md", card)
        noted = {"run": trained.name, "format": cfg.format, "weights": weights}
        write_json(partial / EXPORT, {**noted, "measured": measured})
    for name, value in measured.items():
        log.info("%s: %.4g", name.replace("_", " "), value)
    log.info("the exported %s is in %s", trained.product, folder)
    return measured


def find(cfg: ExportModelCommand) -> Trained:
    """The run that is to be exported.

    Raises:
        UserError: there is none of that name, it is not finished, or it trained the whole model.
    """
    from models.trained_runs import trained_settings

    runs = runs_folder(cfg.checkpoints, cfg.product)
    name = resolve_run_name(cfg.run, runs)
    folder = Path(runs) / name
    settings = trained_settings(folder, TRAINED_BY[cfg.product], cfg.product, "run")
    trained = Trained(name, folder, cfg.product, settings)
    if trained.preset.lora.rank == 0:
        raise UserError(
            f"run={folder} trained the whole model ({cfg.product}.lora.rank=0), so there are no "
            f"adapters to merge: {trained.saved} is what {LOADED_BY[cfg.product]}"
        )
    return trained


@contextmanager
def renamed_when_whole(folder: Path) -> Iterator[Path]:
    """A folder beside `folder` to write into. It takes that name in the end; what a kill or a full
    disk left of an earlier one is thrown away."""
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


def write_adapter(trained: Trained, folder: Path) -> Measured:
    """Copy the adapters and the processor, and the hash of the base that they were trained over."""
    from models.resolved import RESOLVED

    shutil.copytree(trained.saved, folder, dirs_exist_ok=True)
    if (trained.folder / RESOLVED).exists():
        shutil.copy(trained.folder / RESOLVED, folder)
    return {}


def write_merged(trained: Trained, cfg: ExportModelCommand, folder: Path) -> Measured:
    """Write the merged model, and measure how far what it gives is from what was trained."""

    from train.retriever import merge as retriever_merge
    from train.student import merge as student_merge

    write = {"student": student_merge, "retriever": retriever_merge}[trained.product].write_merged
    return write(trained.settings, trained.saved, cfg, folder)


if __name__ == "__main__":
    main()
