"""The observers of a benchmark: how exact eyes must be to reach an accuracy."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

from dynapix.benchmark import Benchmark
from dynapix.conf.errors import UserError
from dynapix.selection import Result

if TYPE_CHECKING:
    import pandas as pd

    from dynapix.data.checks.observer_curve import ObserverError

SEED = 0
"""Seed of the resampling of scenes."""


def observer(bench: Benchmark, *, error: float = 1.0, workers: int = 2) -> Observers:
    """Simulate observers on the selection items of a split. This takes minutes; the results are
    kept in the benchmark's folder.

    An observer sees the objects of each prefix with an error, fits a position and a velocity to
    each, and chooses the candidate nearest to its prediction.

    Args:
        error: The error of the ceilings, px at 336 x 336: 0, 0.25, 0.5, 1, 2, 4, 8, 16 or 32.
        workers: Number of worker processes.

    Raises:
        UserError: The scenes of the benchmark are those of a release, its folder cannot be written,
            the split has no items, or no observer has this error. Observers need the extra
            `simulate`.
    """
    if missing := next((n for n in ("joblib", "pandas", "pybullet") if not find_spec(n)), None):
        raise UserError(
            f"observers need {missing}: pip install -e '.[simulate]'", code="missing-package"
        )
    from dynapix.data.checks.observer import ERRORS, observe_benchmark
    from dynapix.data.parallel import Workers

    if error not in (0, *ERRORS):
        options = ", ".join(f"{each:g}" for each in (0, *ERRORS))
        raise UserError(f"error={error!r}: choose one of {options} px", code="unknown-option")
    return Observers(bench, observe_benchmark(bench.store, bench.split, Workers(workers)), error)


@dataclass(frozen=True, eq=False, repr=False)
class Observers:
    """The results of the observers on a split. Printing them shows the curve.

    Attributes:
        results: By observer (`simulates`, `extrapolates`): the share of the draws in which it is
            right, a row for each item id and a column for each error in px at 336 x 336.
        error: The error of the ceilings.
    """

    benchmark: Benchmark
    results: dict[str, pd.DataFrame]
    error: float

    @property
    def ceilings(self) -> dict[str, float]:
        """The chance by item id of the observer that simulates with the error `error`."""
        return self.results["simulates"][float(self.error)].to_dict()

    @property
    def curve(self) -> pd.DataFrame:
        """The accuracies over all items with 95% intervals over scenes: a row for each observer and
        error, with the columns `accuracy`, `low` and `high`."""
        import pandas as pd

        from dynapix.data.checks.observer_curve import observer_curves

        items = self.benchmark.store.selection(self.benchmark.split)
        rows = {
            (observer, error): {"accuracy": found.value, "low": found.low, "high": found.high}
            for observer, curve in observer_curves(self.results, items, SEED).items()
            for error, found in curve.accuracy.items()
        }
        return pd.DataFrame.from_dict(rows, "index").rename_axis(["observer", "error"])

    def error_of(self, accuracy: float | Result) -> ObserverError:
        """Return the error of the observer that simulates and has the same accuracy.

        Args:
            accuracy: An accuracy over all items of the split, from 0 to 1, or a result, whose micro
                accuracy is compared with the curve over exactly its items.

        Raises:
            UserError: The result is on another build or split, or the accuracy is not from 0 to 1.
        """
        from dynapix.data.checks.intervals import Interval
        from dynapix.data.checks.observer_curve import observer_curves

        items = self.benchmark.store.selection(self.benchmark.split)
        if isinstance(accuracy, Result):
            given = accuracy.benchmark
            if (given.store.identity, given.split) != (
                self.benchmark.store.identity,
                self.benchmark.split,
            ):
                raise UserError(
                    f"{accuracy.name} is a result on {given.name}, {given.split}, and the "
                    f"observers are on {self.benchmark.name}, {self.benchmark.split}: give a "
                    "result on the same build and split",
                    code="different-builds",
                )
            items, measured = [i.record for i in accuracy.items], accuracy.accuracy.micro
        elif 0 <= accuracy <= 1:
            measured = Interval(accuracy, accuracy, accuracy, len(items))
        else:
            raise UserError(
                f"accuracy={accuracy!r}: give a fraction from 0 to 1", code="invalid-setting"
            )
        return observer_curves(self.results, items, SEED)["simulates"].error_of(measured)

    def __str__(self) -> str:
        table = 100 * self.curve["accuracy"].unstack("error")
        return f"Accuracy of observers by error in px, %\n{table.to_string(float_format='%.1f')}"

    def __repr__(self) -> str:
        return (
            f"<Observers of {self.benchmark.name}, {self.benchmark.split}: {len(self.ceilings):,} "
            f"items, {100 * sum(self.ceilings.values()) / len(self.ceilings):.1f}% right with an "
            f"error of {self.error:g} px>"
        )
