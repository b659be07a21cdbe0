"""The report as one file that opens without a network: tables, figures, and a browser of items."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from conf.runs import write_text
from evaluation.reporting.checks import Browser
from evaluation.reporting.plots import inlined
from evaluation.reporting.sections import Section

STYLE, SCRIPT = "page.css", "page.js"


def write_page(
    path: Path, sections: Sequence[Section], browser: Browser, runs: Sequence[str]
) -> None:
    """Write the page whole or not at all; `runs` are the names of those that it is over."""
    loader = jinja2.PackageLoader("evaluation.reporting")
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    folder = files("evaluation.reporting") / "templates"
    drawn = [figure for section in sections for figure in section.figures]
    pictures = {f.path: Markup(inlined(f.path, k)) for k, f in enumerate(drawn)}
    page = environment.get_template("page.html").render(
        sections=sections,
        pictures=pictures,
        runs=runs,
        notes=browser.notes,
        has_items=bool(browser.entries),
        data=embedded({"items": browser.entries, "frames": browser.frames}),
        style=Markup((folder / STYLE).read_text(encoding="utf-8")),
        script=Markup((folder / SCRIPT).read_text(encoding="utf-8")),
    )
    write_text(path, page)


def embedded(value: Any) -> Markup:
    """JSON inside a script element, which nothing in it can close."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace("\u2028", "\\u2028"))
