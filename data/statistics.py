"""Report a benchmark's statistics, and the accuracy of baselines that do not simulate the scene."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import UserError
from dynapix.conf.files import write_text
from dynapix.conf.schema import StatisticsCommand

log = logging.getLogger(__name__)


@command("data.statistics", StatisticsCommand)
def main(cfg: StatisticsCommand, run: Run) -> dict[str, float]:
    from dynapix.data.build import ensure_items
    from dynapix.data.checks.observer import observe_benchmark
    from dynapix.data.checks.statistics import compute_statistics, format_statistics
    from dynapix.data.parallel import Workers

    # Small images are rendered for the shortcuts; the frames of the benchmark are not needed.
    workers = Workers(cfg.workers)
    store = ensure_items(cfg.benchmark, Path(cfg.store), workers)
    if not store.selection():
        raise UserError(
            f"{store.folder} has no selection items, so there are no statistics to report: "
            "choose a benchmark with quotas in benchmark.selection",
            code="empty-split",
        )
    # The observers go first: they may refuse a benchmark.
    observers = observe_benchmark(store, "test", workers) if cfg.observer else None
    statistics = compute_statistics(store, cfg.blind)
    text = format_statistics(statistics)
    if observers is not None:
        from dynapix.data.checks.observer_curve import (
            format_observers,
            observer_curves,
            plot_observers,
            summarize_observers,
        )

        items, seed = store.selection("test"), store.manifest["seed"]
        statistics["observers"] = summarize_observers(observers, items, seed)
        text += "\n\n" + format_observers(statistics["observers"])
        plot_observers(observer_curves(observers, items, seed), run.folder / "observer.png")
    log.info("%s", text)
    write_text(run.folder / "report.txt", text + "\n")
    write_text(run.folder / "report.json", json.dumps(statistics, indent=1))
    return {
        f"{strategy}_{category}": accuracy
        for category, row in statistics["shortcuts"].items()
        for strategy, accuracy in row.items()
        if strategy != "items" and accuracy is not None
    }


if __name__ == "__main__":
    main()
