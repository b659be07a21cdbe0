"""Trains and evaluates variants with several seeds, and records their results in a parquet file.

A variant and a seed whose results are recorded are not run again. The project's commands train and
evaluate in subprocesses. They resume, so an interrupted experiment resumes when its script is
started again.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.arguments import positive_int
from dynapix.conf.compose import compose
from dynapix.conf.files import write_bytes
from dynapix.conf.schema import SelectCommand
from dynapix.data.store import Store, open_store
from dynapix.evaluation.metrics.results import SelectionReport, from_json, variant_name
from dynapix.evaluation.reporting.run_responses import Responses, read_responses, reading
from dynapix.models.fingerprints import settings_key

Job = tuple[str, int]
"""A variant and a seed."""

MINUTES = "cpu_minutes.txt"
"""File with the CPU time of a training, in its folder. An interrupted training has none."""
MONITORING = ("evaluations", "generated_items", "keep_checkpoints")
"""Settings of a training that do not change its last step."""


class CommandError(SystemExit):
    """A command of an experiment failed. Unless it is caught, it ends the script."""


def create_parser(description: str, benchmark: str, record: Path) -> argparse.ArgumentParser:
    """Return a parser with the options of every experiment, some with an experiment's defaults."""
    parser = argparse.ArgumentParser(description=description.partition("\n\n")[0])
    parser.add_argument("--benchmark", default=benchmark, help="name of a preset")
    parser.add_argument("--store", default="store", help="folder of built benchmarks")
    parser.add_argument(
        "--checkpoints", type=Path, default=Path("checkpoints"), help="folder of runs"
    )
    parser.add_argument("--record", type=Path, default=record, help="file of recorded results")
    parser.add_argument("--seeds", type=positive_int, default=3, help="number of seeds per variant")
    parser.add_argument("--table", action="store_true", help="only print the recorded results")
    return parser


@dataclass(frozen=True)
class Experiment:
    """An experiment that trains and evaluates variants of a model.

    The rows of its record have the columns of its identity, and the variant, its settings' key and
    the seed.
    """

    args: argparse.Namespace
    """The parsed options of `create_parser`."""
    base: str
    """Hash of the weights that every variant starts from."""
    settings: Mapping[str, str]
    """Key of each variant's settings and of the versions that its results depend on, by variant."""

    @property
    def identity(self) -> dict[str, str]:
        """Columns and values that identify the rows of this experiment in the record."""
        return {"benchmark": self.args.benchmark, "base": self.base}

    @property
    def benchmark_overrides(self) -> list[str]:
        """Overrides that choose the benchmark."""
        return [f"benchmark={self.args.benchmark}", f"store={self.args.store}"]

    @property
    def shared_overrides(self) -> list[str]:
        """Overrides of every training and evaluation."""
        return [*self.benchmark_overrides, f"checkpoints={self.args.checkpoints}"]

    def run_name(self, variant: str, seed: int) -> str:
        """Return the name of the runs of a variant and a seed."""
        words = variant.replace(",", "").replace(" ", "_")
        return f"{self.args.benchmark}-{self.base[:8]}-{self.settings[variant][:8]}-{words}-{seed}"

    def read_record(self) -> pd.DataFrame:
        """Return the whole record; an empty table if there is no file yet."""
        if not self.args.record.exists():
            return pd.DataFrame(columns=[*self.identity, "variant", "settings", "seed"])
        return pd.read_parquet(self.args.record)

    def read_results(self, seeds: int | None = None) -> pd.DataFrame:
        """Return the recorded results with seeds below `seeds`; all by default. They are those of
        the present base and settings; with `--table`, of those that were recorded last."""
        table = self.read_record()
        table = table[(table.benchmark == self.args.benchmark) & table.variant.isin(self.settings)]
        bases = table.base if self.args.table else [self.base]
        table = table[table.base.isin(bases[-1:])]
        recorded = table.groupby("variant").settings.last() if self.args.table else self.settings
        table = table[table.settings == table.variant.map(recorded)]
        return table if seeds is None else table[table.seed < seeds]

    def run(
        self, jobs: Sequence[Job], evaluate: Callable[[Job], list[dict[str, Any]]]
    ) -> pd.DataFrame:
        """Run the jobs that are not recorded, and return the results of the seeds to compare.

        A job that fails is reported at the end, after the others.

        Args:
            evaluate: Runs a job and returns its rows of the record, without the columns that the
                experiment adds: its identity, the variant, its settings' key and the seed.
        """
        failures = []
        if not self.args.table:
            run_command(["data.build", *self.benchmark_overrides])
            recorded = self.read_results()
            done = set(zip(recorded.variant, recorded.seed, strict=True))
            for job in (job for job in jobs if job not in done):
                try:
                    self._record(job, evaluate(job))
                except CommandError as error:
                    failures.append(str(error))
        results = self.read_results(self.args.seeds)
        if failures:
            raise SystemExit("\n".join(failures))
        if results.empty:
            raise SystemExit("error: no results are recorded: run without --table")
        is_present = results.settings == results.variant.map(self.settings)
        if not all(is_present & (results.base == self.base)):
            print("Some results are of an earlier base, or of earlier settings or versions.")
        return results

    def _record(self, job: Job, rows: list[dict[str, Any]]) -> None:
        variant, seed = job
        shared = {"variant": variant, "settings": self.settings[variant], "seed": seed}
        rows = pd.DataFrame([{**self.identity, **shared, **row} for row in rows])
        table = pd.concat([self.read_record(), rows])
        write_bytes(self.args.record, table.to_parquet(index=False, compression="zstd"))

    def train(self, command: str, name: str, overrides: Sequence[str]) -> Path:
        """Train with a command unless the run is finished, and return the folder of the run.

        The run's name contains the key of the settings that decide its result, so a finished run
        with other such settings is never reused.
        """
        folder = self._find_folder(command, name)
        interrupted, started = folder.exists(), read_cpu_minutes()
        if not is_finished(folder):
            run_command([command, *overrides, f"run={name}"])
            if not interrupted:
                (folder / MINUTES).write_text(f"{read_cpu_minutes() - started}\n")
        return folder

    def evaluate(self, command: str, name: str, overrides: Sequence[str]) -> Path:
        """Evaluate with a command unless the run is finished, and return the folder of the run."""
        folder = self._find_folder(command, name)
        if not is_finished(folder):
            run_command([command, *overrides, *self.shared_overrides, f"run={name}"])
        return folder

    def _find_folder(self, command: str, name: str) -> Path:
        return self.args.checkpoints / command.partition(".")[2] / name


def is_finished(folder: Path) -> bool:
    """Return whether a folder has the metrics of a finished run."""
    return (folder / "metrics.json").exists()


def training_key(
    command: str, schema: type, overrides: Sequence[str], versions: Mapping[str, Any]
) -> str:
    """Return a short hash of what decides the result of a training, apart from its seed.

    The trained model is that of the last step, so the settings in `MONITORING` change nothing.

    Args:
        versions: Versions of the code that makes the training's data.
    """
    settings = asdict(compose(command, schema, overrides))
    settings["train"] = {k: v for k, v in settings["train"].items() if k not in MONITORING}
    deciding = ("student", "retriever", "teacher", "train", "benchmark")
    return settings_key([{name: settings.get(name) for name in deciding}, versions])


def open_benchmark(store: Path, benchmark: str) -> Store:
    """Return the built benchmark of a preset."""
    preset = compose("evaluation.select", SelectCommand, [f"benchmark={benchmark}"]).benchmark
    return open_store(store / preset.store_name)


def read_item_responses(folder: Path, mode: str, control: str | None = None) -> Responses:
    """Return the responses of a run of `evaluation.select` by item id.

    Raises:
        UserError: The folder is not that of a finished run, or a file of it is damaged.
    """
    with reading(folder):
        report = from_json(SelectionReport, json.loads((folder / "report.json").read_text()))
    return read_responses(folder, "select", report).get(variant_name(mode, control), {})


def run_command(command: Sequence[str]) -> None:
    """Run `python -m` with a command.

    Raises:
        CommandError: The command failed.
    """
    print("python -m", *command, flush=True)
    if subprocess.run([sys.executable, "-m", *command]).returncode:
        raise CommandError(f"error: {' '.join(command)} failed, see above")


def read_cpu_minutes() -> float:
    """Return the CPU time of all finished subprocesses, in minutes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (used.ru_utime + used.ru_stime) / 60


def print_header(*titles: object) -> None:
    """Print the header of a Markdown table, after an empty line."""
    print()
    print_row(*titles)
    print("|---" * len(titles) + "|")


def print_row(*cells: object) -> None:
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)
