"""Summarize the finished runs below checkpoints/: tables in the layout of the paper's, and a page
with figures and a browser of items. The page opens without a network."""

from __future__ import annotations

import logging
import re
import shutil
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from dynapix.conf.entry import Run, command
from dynapix.conf.files import write_text
from dynapix.conf.schema import ReportCommand

if TYPE_CHECKING:
    from dynapix.evaluation.reporting.item_results import ItemResults
    from dynapix.evaluation.reporting.sections import Section

log = logging.getLogger(__name__)

PAGE = "report.html"


@command("evaluation.report", ReportCommand)
def main(cfg: ReportCommand, run: Run) -> None:
    from dynapix.evaluation.reporting.item_results import read_item_results
    from dynapix.evaluation.reporting.measurements import read_measurements
    from dynapix.evaluation.reporting.overview import write_overview
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
    retrievals = read_measurements(runs, RETRIEVAL_KINDS)
    by_item = read_item_results(selections, Path(cfg.store), cfg.items, cfg.seed)
    sections = build_sections(selections, retrievals, runs, by_item)
    tables = [table for section in sections for table in section.tables]
    text = "\n\n".join(str(table) for table in tables if not table.folded)

    # All files are rendered before the first is written: an error leaves the previous report as is.
    contents = {
        "report.txt": text + "\n",
        PAGE: render_page(sections, by_item, [r.title for r in runs], left_out),
    }
    for figure in (figure for section in sections for figure in section.figures):
        contents[f"figures/{figure.name}.svg"] = figure.svg
    for table in tables:
        contents[f"tables/{table.name}.md"] = table.as_markdown()
        contents[f"tables/{table.name}.tex"] = table.as_latex()
    for name in ("figures", "tables"):
        shutil.rmtree(run.folder / name, ignore_errors=True)
        (run.folder / name).mkdir()
    for name, content in contents.items():
        write_text(run.folder / name, content)

    log.info("%s", text)
    if overview := write_overview(selections, retrievals, by_item):
        log.info("\n%s", overview)
    log.info("\ntables: %s\npage: %s", run.folder / "tables", run.folder / PAGE)


def render_page(
    sections: Sequence[Section],
    by_item: ItemResults,
    runs: Sequence[str],
    left_out: Sequence[str],
) -> str:
    """Return the page as one HTML file that needs no network.

    Args:
        runs: The names of the runs that it covers.
        left_out: A sentence for each run that it does not cover, with the reason.
    """
    import jinja2
    from markupsafe import Markup

    from dynapix.evaluation.reporting.table import Best

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("dynapix.evaluation.reporting"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.tests["best"] = lambda cell: isinstance(cell, Best)
    templates = files("dynapix.evaluation.reporting") / "templates"
    figures = [figure for section in sections for figure in section.figures]
    return environment.get_template("page.html").render(
        sections=sections,
        svgs={f.name: Markup(inline_svg(f.svg, k)) for k, f in enumerate(figures)},
        runs=runs,
        left_out=left_out,
        by_item=by_item,
        style=Markup((templates / "page.css").read_text(encoding="utf-8")),
        script=Markup((templates / "page.js").read_text(encoding="utf-8")),
    )


def inline_svg(svg: str, number: int) -> str:
    """Return the <svg> element of an SVG file, with ids that `number` makes unique on the page."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    return re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>f{number}-", svg)


if __name__ == "__main__":
    main()
