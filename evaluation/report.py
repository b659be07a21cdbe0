"""Summarize the finished runs below checkpoints/: tables in the layout of the paper's, and a page
with figures and a browser of items. The page opens without a network."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

from dynapix.conf.entry import Run, command
from dynapix.conf.files import write_text
from dynapix.conf.schema import ReportCommand

log = logging.getLogger(__name__)

PAGE = "report.html"


@command("evaluation.report", ReportCommand)
def main(cfg: ReportCommand, run: Run) -> None:
    from dynapix.evaluation.reporting.item_browser import browse_items
    from dynapix.evaluation.reporting.measurements import (
        deduplicate,
        distinguish_item_sets,
        read_measurements,
    )
    from dynapix.evaluation.reporting.overview import write_overview
    from dynapix.evaluation.reporting.page import render_page
    from dynapix.evaluation.reporting.runs import RETRIEVAL_KINDS, SELECTION_KINDS, gather_runs
    from dynapix.evaluation.reporting.sections import build_sections
    from dynapix.integrations.saved_logs import save_log

    for path in cfg.logs:
        log.info("%s is saved in %s", path, save_log(path, Path(cfg.store), Path(cfg.saved)))
    root = Path(cfg.checkpoints)
    runs, left_out = gather_runs(root, Path(cfg.saved), cfg.runs)
    for sentence in left_out:
        log.warning("%s", sentence)
    selections = read_measurements(runs, SELECTION_KINDS)
    selections = deduplicate(distinguish_item_sets(selections))
    retrievals = read_measurements(runs, RETRIEVAL_KINDS)
    retrievals = deduplicate(distinguish_item_sets(retrievals))
    browser = browse_items(selections, Path(cfg.store), cfg.items, cfg.seed)
    sections = build_sections(selections, retrievals, runs, browser)
    tables = [table for section in sections for table in section.tables]
    text = "\n\n".join(str(table) for table in tables if not table.folded)

    # All files are rendered before the first is written: an error leaves the previous report as is.
    files = {
        "report.txt": text + "\n",
        PAGE: render_page(sections, browser, [r.title for r in runs], left_out),
    }
    for figure in (figure for section in sections for figure in section.figures):
        files[f"figures/{figure.name}.svg"] = figure.svg
    for table in tables:
        files[f"tables/{table.name}.md"] = table.as_markdown()
        files[f"tables/{table.name}.tex"] = table.as_latex()
    for name in ("figures", "tables"):
        shutil.rmtree(run.folder / name, ignore_errors=True)
        (run.folder / name).mkdir()
    for name, content in files.items():
        write_text(run.folder / name, content)

    log.info("%s", text)
    if overview := write_overview(selections, retrievals, browser):
        log.info("\n%s", overview)
    log.info("\ntables: %s\npage: %s", run.folder / "tables", run.folder / PAGE)


if __name__ == "__main__":
    main()
