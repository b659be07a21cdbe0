"""A table and its rendering as text, Markdown and LaTeX; the page's template writes HTML."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jinja2

from evaluation.metrics.intervals import Interval

NOTE_WIDTH = 100
DETAIL = "  "
"""Prefix of the name of a row that details the row above it."""
FORMATS = {"MRR": (1, ".3f", ".2f"), "Median": (1, "g", ".0f")}
"""Scale and digits of the values and of the ends of intervals in a column; others are percents."""
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
"""A row's `name` and its values by column: an `Interval`, a share, a count, text, or None for an
unknown value. A column that the row lacks stays empty."""


class Best(str):
    """A cell that holds the best value of its column: bold, except in plain text."""

    __slots__ = ()


@dataclass(frozen=True)
class Table:
    """Rows in groups. A row with intervals is followed by a row of their ends.

    Attributes:
        name: Stem of the files that the table is written to.
        groups: Rows by the label of their group; an empty label is not printed, and neither is a
            group without rows.
        paper: The paper's rows, as in `groups`.
        best: `max` or `min` for each column whose best value is marked, separately for `groups`
            and for `paper`. Rows with a false `ranked` do not compete.
        signed: Whether the values are differences.
        folded: Whether the page folds the table, and the text of the report leaves it out.
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
        """The label and the formatted rows of each group with rows."""
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
        ends = [self._format_ends(row, column) for column in self.columns]
        below = [[f"{DETAIL}95% interval", *ends]] if any(ends) else []
        return [[row["name"], *cells.values()], *below]

    def _format(self, row: Row, column: str) -> str:
        value = row.get(column, "")
        value = value.value if isinstance(value, Interval) else value
        if isinstance(value, str | int):
            return value if isinstance(value, str) else f"{value:,}"
        scale, digits, _ = FORMATS.get(column, PERCENT)
        return "-" if value is None else f"{scale * value:{'+' * self.signed}{digits}}"

    def _format_ends(self, row: Row, column: str) -> str:
        value = row.get(column)
        if not isinstance(value, Interval):
            return ""
        scale, digits, end_digits = FORMATS.get(column, PERCENT)
        if self.signed:
            return f"{scale * value.low:+{digits}} to {scale * value.high:+{digits}}"
        return f"{scale * value.low:{end_digits}}-{scale * value.high:{end_digits}}"

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
        """Return a LaTeX float, which requires the packages booktabs and graphicx."""
        return self._render("table.tex", _escape_latex, r"\textbf{{{}}}")

    def _render(self, template: str, escape: Callable[[str], str], bold: str) -> str:
        def cell(text: str) -> str:
            escaped = escape(text.strip())
            return bold.format(escaped) if isinstance(text, Best) else escaped

        environment = jinja2.Environment(
            block_start_string="<%", block_end_string="%>", variable_start_string="<<",
            variable_end_string=">>", loader=jinja2.PackageLoader("evaluation.reporting"),
            undefined=jinja2.StrictUndefined, trim_blocks=True, keep_trailing_newline=True,
        )  # fmt: skip
        environment.filters["cell"] = cell
        slug = re.sub("[^A-Za-z0-9-]", "-", self.name)
        return environment.get_template(template).render(table=self, slug=slug)


def _escape_markdown(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|~#&$])", r"\\\1", text)


def _escape_latex(text: str) -> str:
    return re.sub(r"->|.", lambda found: _LATEX.get(found[0], found[0]), text)
