"""The report as one HTML file that needs no network: tables, figures, and a browser of items."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from conf.runs import write_text
from evaluation.reporting.figures import FAINT, GRID, INK
from evaluation.reporting.item_browser import ItemBrowser
from evaluation.reporting.sections import Section
from evaluation.reporting.table import Best

PAGE_COLORS = {
    "#ffffff": "var(--card)",
    "#000000": "currentColor",
    INK: "currentColor",
    FAINT: "var(--soft)",
    GRID: "var(--line)",
}
"""Colors of a figure that follow the page's light or dark theme."""


def write_page(
    path: Path, sections: Sequence[Section], browser: ItemBrowser, runs: Sequence[str]
) -> None:
    """Write the page atomically. `runs` are the names of the runs that it covers."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("evaluation.reporting"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.tests["best"] = lambda cell: isinstance(cell, Best)
    templates = files("evaluation.reporting") / "templates"
    figures = [figure for section in sections for figure in section.figures]
    page = environment.get_template("page.html").render(
        sections=sections,
        svgs={f.name: Markup(inline_svg(f.svg, k)) for k, f in enumerate(figures)},
        runs=runs,
        notes=browser.notes,
        has_items=bool(browser.entries),
        data=script_json({"items": browser.entries, "frames": browser.frames}),
        style=Markup((templates / "page.css").read_text(encoding="utf-8")),
        script=Markup((templates / "page.js").read_text(encoding="utf-8")),
    )
    write_text(path, page)


def script_json(value: Any) -> Markup:
    """JSON for a script element; no text in it can close the element."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace("\u2028", "\\u2028"))


def inline_svg(svg: str, number: int) -> str:
    """An SVG file as an element in the page's colors; `number` makes its ids unique."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>f{number}-", svg)
    for color, page_color in PAGE_COLORS.items():
        svg = svg.replace(color, page_color)
    return svg
