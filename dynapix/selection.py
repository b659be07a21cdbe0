"""Evaluate a model on selection items."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from dynapix.benchmark import Benchmark, Item, refuse_repeated
from dynapix.conf.errors import UserError
from dynapix.conf.files import expand_path, write_json, write_json_lines, write_text
from dynapix.conf.schema.benchmark import PAIRED
from dynapix.data.records import LETTERS
from dynapix.evaluation.metrics.future_moment import FutureMoment, measure_future_moment
from dynapix.evaluation.metrics.ranking import to_array
from dynapix.evaluation.metrics.results import SIMILARITY, SelectionReport, SelectionResult
from dynapix.evaluation.metrics.selection import Choices, build_selection_report
from dynapix.evaluation.metrics.significance import PairedComparison, compare_runs
from dynapix.evaluation.reporting.run_responses import nearest_candidates
from dynapix.integrations.logs import Log, name_damage, read_inspect, read_lmms_eval
from dynapix.models.student.answer_parser import parse_choice
from dynapix.saved_runs import saved_run

TEXT = "text"
"""Mode of results whose predictions are letters or texts."""
MIN_FAILURES_TO_STOP = 8
"""An evaluation stops if at least this many items, and all items so far, have failed."""


@dataclass(frozen=True)
class Outcome:
    """What a model predicted for an item.

    Attributes:
        text: The predicted letter or text; None for scores and failures.
        scores: The four scores; None for texts and failures.
        letter: The chosen letter; None for a tie, a failure, or a text without a clear letter.
        credit: 1 for a correct choice, 1/m if the target is one of m candidates with the highest
            score, and 0 otherwise.
        reason: Why a text has no letter, or why the item failed.
        truncated: Whether the text ended at the limit of tokens, if that is known.
    """

    item_id: str
    text: str | None
    scores: tuple[float, ...] | None
    letter: str | None
    credit: float
    reason: str | None = None
    truncated: bool = False

    @property
    def failed(self) -> bool:
        return self.text is None and self.scores is None


def evaluate(
    items: Sequence[Item],
    predict: Callable[[Any], Any],
    *,
    batch_size: int | None = None,
    name: str = "model",
    seed: int = 0,
    progress: bool = True,
) -> Result:
    """Evaluate a model on selection items of one benchmark.

    Args:
        items: `Benchmark.selection`, or some of its items.
        predict: Returns the prediction for an item: a letter, a text that states one (it is parsed
            by `parse_choice`), or four scores, of which the highest is chosen. With `batch_size`,
            it receives a list of items and returns a list of predictions. If it raises an exception
            or returns anything else, the items count as wrong and are in `Result.failures`.
        batch_size: The number of items per call; None passes one item at a time.
        name: The model's name in tables.
        seed: Seed of the bootstrap over scenes.
        progress: Whether to show a progress bar.

    Raises:
        UserError: There are no items, items of several benchmarks or an item twice, `predict`
            returns another number of predictions than it received items, or the first items all
            fail.
    """
    items = list(items)
    benchmarks = {id(item._benchmark): item._benchmark for item in items}
    if len({benchmark.store.identity for benchmark in benchmarks.values()}) != 1:
        problem = "items of several benchmarks" if items else "no items"
        raise UserError(
            f"{problem}: give Benchmark.selection or some of its items", code="invalid-items"
        )
    refuse_repeated([item.item_id for item in items], "item")
    if batch_size is not None and batch_size < 1:
        raise UserError(f"batch_size={batch_size}: give 1 or more", code="invalid-setting")
    outcomes: list[Outcome] = []
    size = batch_size or 1
    with tqdm(
        total=len(items), desc=name, unit="item", disable=not progress or sys.stderr is None
    ) as bar:
        for start in range(0, len(items), size):
            batch = items[start : start + size]
            outcomes += _predict_batch(predict, batch, single=batch_size is None)
            bar.update(len(batch))
            _stop_if_all_failed(outcomes, len(items))
            _stop_if_mixed(outcomes)
    return Result(items[0]._benchmark, name, tuple(items), tuple(outcomes), seed)


def _predict_batch(predict: Callable[[Any], Any], batch: list[Item], single: bool) -> list[Outcome]:
    try:
        predictions = [predict(batch[0])] if single else list(predict(batch))
    except Exception as error:
        reason = f"predict raised {type(error).__name__}: {error}"
        return [_failure(item, reason) for item in batch]
    if len(predictions) != len(batch):
        raise UserError(
            f"predict returned {len(predictions)} predictions for a batch of {len(batch)} items: "
            "return one for each item, in their order",
            code="invalid-prediction",
        )
    return [_read(item, of_item) for item, of_item in zip(batch, predictions, strict=True)]


def _read(item: Item, prediction: Any) -> Outcome:
    if isinstance(prediction, str):
        return _read_text(item, prediction)
    try:
        scores = to_array(prediction, float)
    except Exception:  # A library's own error must not lose the earlier predictions.
        return _failure(item, f"predict returned {_shorten(prediction)}")
    if scores.shape != (len(LETTERS),):
        return _failure(item, f"predict returned {_shorten(prediction)}")
    if not np.isfinite(scores).all():
        return _failure(item, f"predict returned the scores {scores.tolist()}, not all finite")
    chosen = nearest_candidates(scores.tolist())
    letter, credit = chosen.letter, chosen.credit(item.answer)
    reason = None if letter else "tied scores"
    return Outcome(item.item_id, None, tuple(scores.tolist()), letter, credit, reason)


def _read_text(item: Item, text: str, truncated: bool = False) -> Outcome:
    parsed = parse_choice(text, truncated)
    reason = str(parsed.reason) if parsed.letter is None else None
    right = float(parsed.letter == item.answer)
    return Outcome(item.item_id, text, None, parsed.letter, right, reason, truncated)


def _find_items(benchmark: Benchmark, names: Sequence[str], source: Path) -> dict[str, Item]:
    """Return the items with some ids, in this order. Raises UserError if one is missing."""
    every = {item.item_id: item for item in (*benchmark.selection, *benchmark.interventions)}
    if missing := [name for name in names if name not in every]:
        raise UserError(
            f"{source} has {len(missing)} items that the {benchmark.split} split of "
            f"{benchmark.name} does not have, such as {missing[0]}",
            code="different-items",
        )
    return {name: every[name] for name in names}


def _failure(item: Item, reason: str) -> Outcome:
    return Outcome(item.item_id, None, None, None, 0.0, reason)


def _shorten(prediction: Any) -> str:
    text, kind = repr(prediction), type(prediction).__name__
    shortened = text if len(text) <= 60 else f"{text[:57]}..."
    return f"{shortened} ({kind}) instead of a letter, a text, or four scores"


def _stop_if_all_failed(outcomes: Sequence[Outcome], total: int) -> None:
    if len(outcomes) >= min(MIN_FAILURES_TO_STOP, total) and all(o.failed for o in outcomes):
        raise UserError(
            f"all of the first {len(outcomes)} items failed; {outcomes[0].item_id}: "
            f"{outcomes[0].reason}",
            code="invalid-prediction",
        )


class Comparison(tuple[PairedComparison, ...]):
    """Paired comparisons of two results, which are printed as a table."""

    __slots__ = ()

    def __str__(self) -> str:
        from dynapix.evaluation.reporting.tables import paired_table

        return str(paired_table(self))


def _stop_if_mixed(outcomes: Sequence[Outcome]) -> None:
    if any(o.text is not None for o in outcomes) and any(o.scores for o in outcomes):
        raise UserError(
            "predict returned texts for some items and scores for others: return one of both",
            code="invalid-prediction",
        )


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """The result of `evaluate`. Printing it shows the table of `python -m evaluation.select`.

    Attributes:
        benchmark: The benchmark of the items.
        name: The model's name.
        items: The items, in the order of evaluation.
        outcomes: The model's prediction for each item, with its credit.
        seed: Seed of the bootstrap over scenes.
    """

    benchmark: Benchmark
    name: str
    items: tuple[Item, ...]
    outcomes: tuple[Outcome, ...]
    seed: int = 0

    @cached_property
    def _texts(self) -> bool:
        return not any(outcome.scores for outcome in self.outcomes)

    @cached_property
    def failures(self) -> list[Outcome]:
        """The outcomes of the items without a usable prediction, each with its `reason`. These
        items count as wrong."""
        return [outcome for outcome in self.outcomes if outcome.failed]

    @cached_property
    def report(self) -> SelectionReport:
        """All tables' numbers: accuracies with intervals, by subtype, by letter."""
        mode = TEXT if self._texts else SIMILARITY
        credits = [o.credit for o in self.outcomes]
        letters = [o.letter for o in self.outcomes]
        choices = Choices(self.name, mode, None, credits, letters)
        records = [item.record for item in self.items]
        asked = [(TEXT, None, TEXT)] if self._texts else []
        suite = records[0].suite if records[0].suite in PAIRED else None
        store = self.benchmark.store
        return build_selection_report([choices], records, store, self.seed, suite, asked)

    @property
    def accuracy(self) -> SelectionResult:
        """Accuracy by family, macro and micro, with 95% intervals over scenes."""
        return self.report.rows[0]

    @cached_property
    def future_moment(self) -> FutureMoment | None:
        """How often the answers to balanced time items show the true future, and the true moment;
        None without such items."""
        letters = {
            o.item_id: nearest_candidates(o.scores).letters if o.scores else o.letter or ""
            for o in self.outcomes
        }
        records = [item.record for item in self.items]
        measured = measure_future_moment(records, {self.name: letters}, self.seed)
        return measured.get(self.name)

    def compare(self, other: Result) -> Comparison:
        """Compare with another result on the same items, by family, macro, and over all items.

        Returns:
            Comparisons with the paired difference (this result minus `other`), its 95% interval
            over scenes, the p-value of the sign-flip test over scenes, and McNemar's p-value.
            Printing them shows a table.

        Raises:
            UserError: `other` is on other items, or on another build of the benchmark.
        """
        builds = [r.benchmark.store.identity for r in (self, other)]
        if builds[0] != builds[1]:
            raise UserError(
                f"{self.name} and {other.name} are results on different benchmarks or builds "
                f"({self.benchmark.name} {builds[0]}, {other.benchmark.name} {builds[1]})",
                code="different-builds",
            )
        left, right = ({o.item_id: o.credit for o in r.outcomes} for r in (self, other))
        records = [item.record for item in self.items]
        return Comparison(compare_runs(records, left, right, (self.name, other.name), self.seed))

    def save(self, folder: str | Path) -> Path:
        """Write the result as a run, and return its folder.

        `python -m evaluation.report` shows the results in the folder runs/ beside other runs.
        `Result.load` reads it.

        Raises:
            UserError: The folder exists and contains something else.
        """
        folder = Path(expand_path(str(folder)))
        kind = "select" if self._texts else "similarity"
        record = (self.benchmark.store, kind, self.name, self.seed)
        with saved_run(folder, *record, metrics=self.accuracy.metrics):
            if self._texts:
                rows = [
                    {
                        "key": TEXT,
                        "mode": TEXT,
                        "item_id": o.item_id,
                        "text": o.text or "",
                        "truncated": o.truncated,
                    }
                    for o in self.outcomes
                ]
                write_json_lines(folder / "answers.jsonl", rows)
            else:
                scored = [(o.item_id, o.scores) for o in self.outcomes]
                rows = [{"by": self.name, "item_id": i, "scores": scores} for i, scores in scored]
                write_json_lines(folder / "scores.jsonl", rows)
            failed = [{"item_id": o.item_id, "reason": o.reason} for o in self.failures]
            write_json_lines(folder / "failures.jsonl", failed)
            write_json(folder / "report.json", asdict(self.report))
            write_text(folder / "report.txt", f"{self}\n")
        return folder

    @classmethod
    def load(cls, folder: str | Path, benchmark: Benchmark) -> Result:
        """Read a result that `save` wrote.

        Args:
            benchmark: The benchmark that the result is on.

        Raises:
            UserError: The folder has no saved result, or its items are not those of `benchmark`.
        """
        folder = Path(expand_path(str(folder)))
        with name_damage(folder, "a saved result"):
            record = json.loads((folder / "run.json").read_text())
            report = json.loads((folder / "report.json").read_text())
            kind, name, seed = record["kind"], record["name"], record["seed"]
            file = "answers.jsonl" if kind == "select" else "scores.jsonl"
            rows = [json.loads(line) for line in (folder / file).read_text().splitlines()]
            texts = kind == "select"
            predictions = [(row["item_id"], row["text" if texts else "scores"]) for row in rows]
            truncated = {row["item_id"] for row in rows if texts and row["truncated"]}
            lines = (folder / "failures.jsonl").read_text().splitlines()
            failed = {row["item_id"]: row["reason"] for row in map(json.loads, lines)}
            build = report["build"]
        if build != benchmark.store.identity:
            raise UserError(
                f"{folder} is a result on another benchmark or build than {benchmark.store.folder}",
                code="different-builds",
            )
        by_id = _find_items(benchmark, [name for name, _ in predictions], folder)
        outcomes = [
            _failure(by_id[name], failed[name])
            if name in failed
            else _read_text(by_id[name], value, name in truncated)
            if texts
            else _read(by_id[name], value)
            for name, value in predictions
        ]
        return cls(benchmark, name, tuple(by_id.values()), tuple(outcomes), seed)

    @classmethod
    def from_inspect(cls, path: str | Path, benchmark: Benchmark, seed: int = 0) -> Result:
        """Read the log of `inspect eval dynapix/selection`, *.eval or *.json.

        Args:
            benchmark: The benchmark that the log is on.

        Raises:
            UserError: The file is not a finished log, or its items are not those of `benchmark`.
        """
        return cls._from_log(read_inspect, path, benchmark, seed)

    @classmethod
    def from_lmms_eval(cls, path: str | Path, benchmark: Benchmark, seed: int = 0) -> Result:
        """Read the samples that lmms-eval logs of the task dynapix_selection; see `from_inspect`.

        Such a log does not say whether a response ended at the limit of tokens.
        """
        return cls._from_log(read_lmms_eval, path, benchmark, seed)

    @classmethod
    def _from_log(
        cls, read: Callable[[Path], Log], path: str | Path, benchmark: Benchmark, seed: int
    ) -> Result:
        file = Path(expand_path(str(path)))
        log = read(file)
        by_id = _find_items(benchmark, [*log.responses], file)
        outcomes = tuple(
            _read_text(by_id[name], response.text, response.truncated)
            for name, response in log.responses.items()
        )
        return cls(benchmark, log.model, tuple(by_id.values()), outcomes, seed)

    def to_eval_results(
        self, dataset: str, task: str = "selection", notes: str | None = None
    ) -> list[dict[str, Any]]:
        """Return the macro accuracy in percent as an entry of `.eval_results/*.yaml` in a model's
        repository on the Hugging Face hub.

        Args:
            dataset: The benchmark's dataset on the hub, ORGANISATION/NAME.
            task: Id of the task in the dataset's `eval.yaml`.
            notes: Settings of the evaluation in a few words.
        """
        today = datetime.now(UTC).date().isoformat()
        entry = {"dataset": {"id": dataset, "task_id": task}, "date": today}
        value = round(100 * self.accuracy.macro.value, 2)
        return [{**entry, "value": value} | ({"notes": notes} if notes else {})]

    def __str__(self) -> str:
        from dynapix.evaluation.reporting.tables import pair_table, selection_table

        lines = [str(selection_table([self.accuracy], self.items[0].record.suite))]
        lines += [str(pair_table(self.report.pairs))] if self.report.pairs else []
        if self.failures:
            reasons = Counter(failure.reason for failure in self.failures)
            [(reason, count)] = reasons.most_common(1)
            lines.append(
                f"{len(self.failures)} items failed and count as wrong. Most frequent reason "
                f"({count}): {reason}."
            )
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"<Result of {self.name}: macro {self.accuracy.macro.value:.3f}>"
