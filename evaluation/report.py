"""Summarize the finished runs below checkpoints/: tables in the paper's shape, and a page with
figures and a browser of items that opens without a network."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

from conf.entry import Run, command
from conf.runs import write_text
from conf.schema import ReportCommand

log = logging.getLogger(__name__)

PAGE = "report.html"


@command("evaluation.report", ReportCommand)
def main(cfg: ReportCommand, run: Run) -> None:
    from evaluation.reporting.runs import RETRIEVAL_KINDS, SELECTION_KINDS, gather_runs

    root = Path(cfg.checkpoints)
    runs = gather_runs(root, cfg.runs)

    from evaluation.metrics.results import RetrievalResult, SelectionResult
    from evaluation.reporting.comparisons import check_comparable
    from evaluation.reporting.item_browser import browse_items
    from evaluation.reporting.measurements import deduplicate, read_measurements
    from evaluation.reporting.page import write_page
    from evaluation.reporting.sections import build_sections

    selections = read_measurements(runs, root, SELECTION_KINDS, SelectionResult)
    retrievals = read_measurements(runs, root, RETRIEVAL_KINDS, RetrievalResult)
    check_comparable(selections, retrievals)
    browser = browse_items(selections, Path(cfg.store), cfg.items, cfg.seed)

    # The previous report stays until the new one is complete.
    partial = run.folder / "partial"
    shutil.rmtree(partial, ignore_errors=True)
    for name in ("figures", "tables"):
        (partial / name).mkdir(parents=True)
    try:
        rows = deduplicate(selections), deduplicate(retrievals)
        sections = build_sections(*rows, runs, browser)
        tables = [table for section in sections for table in section.tables]
        for figure in (figure for section in sections for figure in section.figures):
            write_text(partial / "figures" / f"{figure.name}.svg", figure.svg)
        for table in tables:
            write_text(partial / "tables" / f"{table.name}.md", table.as_markdown())
            write_text(partial / "tables" / f"{table.name}.tex", table.as_latex())
        text = "\n\n".join(str(table) for table in tables if not table.folded)
        write_text(partial / "report.txt", text + "\n")
        write_page(partial / PAGE, sections, browser, [r.title for r in runs])
        for part in partial.iterdir():
            shutil.rmtree(run.folder / part.name, ignore_errors=True)
            part.replace(run.folder / part.name)
    finally:
        shutil.rmtree(partial)

    log.info("%s", text)
    log.info("\ntables: %s\npage: %s", run.folder / "tables", run.folder / PAGE)


if __name__ == "__main__":
    main()
