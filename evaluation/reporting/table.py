"""A table of results, rendered as text, Markdown or LaTeX. page.html renders it as HTML."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from dynapix.data.checks.intervals import Interval

NOTE_WIDTH = 100
DETAIL = "  "
"""Prefix of a row's name if the row gives a detail of the row above."""
FORMATS = {"MRR": (1, ".3f", ".2f"), "Median": (1, "g", ".0f")}
"""By column: factor, format of values, and format of interval bounds. Others use `PERCENT`."""
PERCENT = (100, ".1f", ".0f")

_LATEX = {
    **{c: f"\\{c}" for c in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "->": r"$\rightarrow$",
    "…": r"\ldots{}",
}

Row = Mapping[str, Any]
"""A row's `name`, and its values by column: an `Interval`, a number, text, or None for an unknown
value (shown as -). A `float` is a fraction and an `int` a count. Columns that the row lacks are
empty. If `ranked` is false, no value of the row is marked as the best."""


class Best(str):
    """The text of a cell with the best value of its column. It is bold, except in plain text."""

    __slots__ = ()


@dataclass(frozen=True)
class Table:
    """A table. Below each row with intervals, another row shows the bounds of the intervals.

    Attributes:
        name: Name of the files that the table is written to, without suffix.
        groups: Groups of rows by label. An empty label and a group without rows are not printed.
        notes: Sentences below the table.
        paper: Groups of the paper's rows by label, below `groups`.
        best: For each column whose best value is marked: `max` or `min`. The best value is chosen
            among `groups` and, separately, among `paper`.
        signed: Whether the values are differences, which are printed with a sign.
        folded: Whether the table is collapsed on the page and left out of report.txt.
    """

    name: str
    caption: str
    columns: Sequence[str]
    groups: Mapping[str, Sequence[Row]]
    notes: tuple[str, ...] = ()
    paper: Mapping[str, Sequence[Row]] = field(default_factory=dict)
    best: Mapping[str, Callable[..., str]] = field(default_factory=dict)
    signed: bool = False
    folded: bool = False

    @cached_property
    def body(self) -> list[tuple[str, list[list[str]]]]:
        """The label and the rows of each non-empty group; a row is a list of its name and cells."""
        return [*self._format_groups(self.groups), *self._format_groups(self.paper)]

    def _format_groups(
        self, groups: Mapping[str, Sequence[Row]]
    ) -> Iterator[tuple[str, list[list[str]]]]:
        ranked = [row for rows in groups.values() for row in rows if row.get("ranked", True)]
        best = {}
        for column, choose in self.best.items():
            cells = [c for row in ranked if (c := self._format(row, column)) not in ("", "-")]
            if len(cells) > 1:
                best[column] = choose(cells, key=float)
        for label, rows in groups.items():
            if rows:
                yield label, [line for row in rows for line in self._format_row(row, best)]

    def _format_row(self, row: Row, best: Mapping[str, str]) -> list[list[str]]:
        cells = {column: self._format(row, column) for column in self.columns}
        if row.get("ranked", True):
            cells = {c: Best(cell) if cell == best.get(c) else cell for c, cell in cells.items()}
        bounds = [self._format_bounds(row, column) for column in self.columns]
        below = [[f"{DETAIL}95% interval", *bounds]] if any(bounds) else []
        return [[row["name"], *cells.values()], *below]

    def _format(self, row: Row, column: str) -> str:
        value = row.get(column, "")
        value = value.value if isinstance(value, Interval) else value
        if isinstance(value, str | int):
            return value if isinstance(value, str) else f"{value:,}"
        factor, digits, _ = FORMATS.get(column, PERCENT)
        return "-" if value is None else f"{factor * value:{'+' * self.signed}{digits}}"

    def _format_bounds(self, row: Row, column: str) -> str:
        value = row.get(column)
        if not isinstance(value, Interval):
            return ""
        factor, digits, bound_digits = FORMATS.get(column, PERCENT)
        if self.signed:
            return f"{factor * value.low:+{digits}} to {factor * value.high:+{digits}}"
        return f"{factor * value.low:{bound_digits}}-{factor * value.high:{bound_digits}}"

    def __str__(self) -> str:
        """Return the table as plain text with aligned columns."""
        head = ["", *self.columns]
        cells = [head, *(row for _, rows in self.body for row in rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]

        def align(row: Sequence[str]) -> str:
            cells = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
            return "  ".join([row[0].ljust(widths[0]), *cells]).rstrip()

        rule = "-" * (sum(widths) + 2 * len(widths) - 2)
        lines = [*textwrap.wrap(self.caption, NOTE_WIDTH), "", align(head)]
        for label, rows in self.body:
            lines += [rule, *([label] if label else []), *map(align, rows)]
        return "\n".join([*lines, rule, *(textwrap.fill(note, NOTE_WIDTH) for note in self.notes)])

    def as_markdown(self) -> str:
        """Return the table in GitHub Markdown, below its caption."""
        return self._render("table.md", _escape_markdown, "**{}**")

    def as_latex(self) -> str:
        """Return the table as a LaTeX float, which needs the packages booktabs and graphicx."""
        return self._render("table.tex", _escape_latex, r"\textbf{{{}}}")

    def _render(self, template: str, escape: Callable[[str], str], bold: str) -> str:
        def cell(text: str) -> str:
            escaped = escape(text.strip())
            return bold.format(escaped) if isinstance(text, Best) else escaped

        import jinja2

        environment = jinja2.Environment(
            block_start_string="<%", block_end_string="%>", variable_start_string="<<",
            variable_end_string=">>", loader=jinja2.PackageLoader("dynapix.evaluation.reporting"),
            undefined=jinja2.StrictUndefined, trim_blocks=True, keep_trailing_newline=True,
        )  # fmt: skip
        environment.filters["cell"] = cell
        slug = re.sub("[^A-Za-z0-9-]", "-", self.name)
        return environment.get_template(template).render(table=self, slug=slug)


def file_stem(name: str) -> str:
    """Return a name as a file name without spaces and brackets."""
    return re.sub(r"[^\w.+-]+", "-", name).strip("-")


def _escape_markdown(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|~#&$])", r"\\\1", text)


def _escape_latex(text: str) -> str:
    return re.sub(r"->|.", lambda found: _LATEX.get(found[0], found[0]), text)
