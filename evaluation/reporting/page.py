"""The report as one HTML file that needs no network: tables, figures, and a browser of items."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.resources import files

import jinja2
from markupsafe import Markup

from dynapix.evaluation.reporting.item_browser import ItemBrowser
from dynapix.evaluation.reporting.sections import Section
from dynapix.evaluation.reporting.table import Best


def render_page(
    sections: Sequence[Section],
    browser: ItemBrowser,
    runs: Sequence[str],
    left_out: Sequence[str],
) -> str:
    """Return the page as HTML.

    Args:
        runs: The names of the runs that it covers.
        left_out: A sentence for each run that it does not cover, with the reason.
    """
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
        browser=browser,
        style=Markup((templates / "page.css").read_text(encoding="utf-8")),
        script=Markup((templates / "page.js").read_text(encoding="utf-8")),
    )


def inline_svg(svg: str, number: int) -> str:
    """Return the <svg> element of an SVG file, with ids that `number` makes unique on the page."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    return re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>f{number}-", svg)
