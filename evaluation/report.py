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
    from evaluation.reporting.runs import gather_runs

    root = Path(cfg.checkpoints)
    runs = gather_runs(root, cfg.runs)

    from evaluation.reporting.comparisons import check_retrieval_sizes, check_same_build
    from evaluation.reporting.item_browser import browse_items
    from evaluation.reporting.measurements import deduplicate, read_measurements
    from evaluation.reporting.page import write_page
    from evaluation.reporting.sections import build_sections

    selections, retrievals = read_measurements(runs, root)
    check_same_build(m.run for m in (*selections, *retrievals))
    check_retrieval_sizes(retrievals)
    browser = browse_items(selections, Path(cfg.store), cfg.items, cfg.seed)

    # The previous report stays until the new one is complete.
    partial = run.folder / "partial"
    shutil.rmtree(partial, ignore_errors=True)
    figures, tables = partial / "figures", partial / "tables"
    for folder in (figures, tables):
        folder.mkdir(parents=True)
    try:
        rows = deduplicate(selections), deduplicate(retrievals)
        sections = build_sections(*rows, runs, browser, figures)
        for section in sections:
            for table in (*section.tables, *section.details):
                write_text(tables / f"{table.name}.md", table.as_markdown())
                write_text(tables / f"{table.name}.tex", table.as_latex())
        text = "\n\n".join(f"{t.caption}\n\n{t}" for section in sections for t in section.tables)
        write_text(partial / "report.txt", text + "\n")
        write_page(partial / PAGE, sections, browser, [f"{r.kind}/{r.name}" for r in runs])
        for folder in (figures, tables):
            shutil.rmtree(run.folder / folder.name, ignore_errors=True)
            folder.rename(run.folder / folder.name)
        for name in ("report.txt", PAGE):
            (partial / name).replace(run.folder / name)
    finally:
        shutil.rmtree(partial)

    log.info("%s", text)
    log.info("\ntables: %s\npage: %s", run.folder / "tables", run.folder / PAGE)


if __name__ == "__main__":
    main()
