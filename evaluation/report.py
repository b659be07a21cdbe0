"""Gather what was trained and measured below checkpoints/: tables in the paper's shape, and a page
with figures and a browser of items, which opens without a network."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from conf.entry import Run, command
from conf.runs import write_text
from conf.schema import ReportCommand

log = logging.getLogger(__name__)

PAGE = "report.html"


@command("evaluation.report", ReportCommand)
def main(cfg: ReportCommand, run: Run) -> None:
    from evaluation.reporting.runs import gather

    root = Path(cfg.checkpoints)
    runs = gather(root, cfg.runs)

    from evaluation.reporting.checks import browser_of
    from evaluation.reporting.measurements import once, read_rows
    from evaluation.reporting.page import write_page
    from evaluation.reporting.run_responses import check_same_build, check_same_rankings
    from evaluation.reporting.sections import sections_of

    choices, ranks = read_rows(runs, root)
    check_same_build(m.run for m in (*choices, *ranks))
    check_same_rankings(ranks)
    browser = browser_of(choices, Path(cfg.store), cfg.items, cfg.seed)
    # What there was stays until all of it is made anew.
    with emptied(run.folder / "partial") as made:
        figures, tables = made / "figures", made / "tables"
        for folder in (figures, tables):
            folder.mkdir()
        told = (browser.confusions, browser.apart)
        sections = sections_of(once(choices), once(ranks), runs, *told, figures)
        for section in sections:
            for table in (*section.tables, *section.details):
                write_text(tables / f"{table.name}.md", table.as_markdown())
                write_text(tables / f"{table.name}.tex", table.as_latex())
        text = "\n\n".join(f"{t.caption}\n\n{t}" for section in sections for t in section.tables)
        write_text(made / "report.txt", text + "\n")
        write_page(made / PAGE, sections, browser, [f"{r.kind}/{r.name}" for r in runs])
        for folder in (figures, tables):
            shutil.rmtree(run.folder / folder.name, ignore_errors=True)
            folder.rename(run.folder / folder.name)
        for name in ("report.txt", PAGE):
            (made / name).replace(run.folder / name)

    log.info("%s", text)
    log.info("\ntables: %s\npage: %s", run.folder / "tables", run.folder / PAGE)


@contextmanager
def emptied(folder: Path) -> Iterator[Path]:
    """A folder without what a killed run left in it, which is gone afterwards."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
