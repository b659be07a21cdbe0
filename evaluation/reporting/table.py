"""A table and its rendering as text, Markdown and LaTeX; the page's template writes HTML."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

NAME_WIDTH = 40
"""Longest row name in plain text, in characters."""
SUFFIX_WIDTH = 14
"""Characters that a shortened name keeps of its end, which names the mode."""
NOTE_WIDTH = 100

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


class Best(str):
    """A cell that holds the best value of its column: bold, except in plain text."""

    __slots__ = ()


@dataclass(frozen=True)
class Table:
    """Rows of formatted cells, each row as long as the head.

    A row whose name begins with two spaces belongs to the row above it.

    Attributes:
        name: Stem of the files that the table is written to.
        groups: Rows by the label of their group; an empty label is not printed, and neither is a
            group without rows.
    """

    name: str
    caption: str
    head: Sequence[str]
    groups: Mapping[str, Sequence[Sequence[str]]]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        groups = {label: rows for label, rows in self.groups.items() if rows}
        object.__setattr__(self, "groups", groups)

    def __str__(self) -> str:
        return self.as_text()

    def as_text(self) -> str:
        """Aligned columns, the first one to the left; long names lose their middle."""
        head = [shorten(cell) for cell in self.head]
        groups = {
            label: [[shorten(name), *cells] for name, *cells in rows]
            for label, rows in self.groups.items()
        }
        cells = [head, *(row for rows in groups.values() for row in rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        rule = "-" * (sum(widths) + 2 * len(widths) - 2)
        lines = [_align(head, widths)]
        for label, rows in groups.items():
            lines += [rule, *([label] if label else []), *(_align(row, widths) for row in rows)]
        notes = [textwrap.fill(note, NOTE_WIDTH) for note in self.notes]
        return "\n".join([*lines, rule, *notes])

    def as_markdown(self) -> str:
        """A GitHub Markdown table below its caption."""
        columns = len(self.head)
        lines = [_markdown_row(self.head), f"|:--{'|--:' * (columns - 1)}|"]
        for label, rows in self.groups.items():
            lines += [f"| *{_markdown(label)}* |{'  |' * (columns - 1)}"] if label else []
            lines += map(_markdown_row, rows)
        notes = map(_markdown, self.notes)
        return "\n\n".join([f"**{_markdown(self.caption)}**", "\n".join(lines), *notes]) + "\n"

    def as_latex(self) -> str:
        """A float; requires the packages booktabs and graphicx."""
        columns = len(self.head)
        body = [_latex_row(self.head)]
        for label, rows in self.groups.items():
            body.append(r"\midrule")
            if label:
                body.append(rf"\multicolumn{{{columns}}}{{@{{}}l}}{{\emph{{{_latex(label)}}}}} \\")
            for row in rows:
                indent = r"\quad " * (bool(label) + row[0].startswith("  "))
                body.append(indent + _latex_row(row))
        caption = _latex(" ".join([f"{self.caption.rstrip('.')}.", *self.notes]))
        return "\n".join(
            [
                r"\begin{table}[t]",
                r"\centering",
                r"\small",
                r"\resizebox{\columnwidth}{!}{%",
                rf"\begin{{tabular}}{{@{{}}l{'r' * (columns - 1)}@{{}}}}",
                r"\toprule",
                *body,
                r"\bottomrule",
                r"\end{tabular}}",
                rf"\caption{{{caption}}}",
                rf"\label{{tab:{re.sub('[^A-Za-z0-9-]', '-', self.name)}}}",
                r"\end{table}",
                "",
            ]
        )


def shorten(name: str) -> str:
    """A name without its middle if it is longer than `NAME_WIDTH`."""
    if len(name) <= NAME_WIDTH:
        return name
    return f"{name[: NAME_WIDTH - SUFFIX_WIDTH - 1]}…{name[-SUFFIX_WIDTH:]}"


def mark_best(
    groups: Mapping[str, Sequence[Sequence[str]]],
    head: Sequence[str],
    best: Mapping[str, Callable[[Sequence[float]], float]],
    skipped: Sequence[str] = (),
) -> dict[str, list[list[str]]]:
    """The rows of all groups with the best cells marked, if a column holds two values or more.

    Args:
        best: `max` or `min` for each column that has a best value.
        skipped: Names of rows that do not compete.
    """
    groups = {label: [list(row) for row in rows] for label, rows in groups.items()}
    rows = [row for group in groups.values() for row in group]
    rows = [row for row in rows if not row[0].startswith("  ") and row[0] not in skipped]
    for column, heading in enumerate(head):
        filled = [row for row in rows if row[column] not in ("", "-")]
        if heading in best and len(filled) > 1:
            value = best[heading]([float(row[column]) for row in filled])
            for row in filled:
                if float(row[column]) == value:
                    row[column] = Best(row[column])
    return groups


def _align(row: Iterable[str], widths: list[int]) -> str:
    first, *rest = row
    cells = [first.ljust(widths[0])]
    cells += [cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True)]
    return "  ".join(cells).rstrip()


def _emphasize(row: Iterable[str], escape: Callable[[str], str], bold: str) -> list[str]:
    """The escaped cells of a row, the best ones in the format `bold`."""
    return [
        bold.format(escape(cell.strip())) if isinstance(cell, Best) else escape(cell.strip())
        for cell in row
    ]


def _markdown_row(row: Sequence[str]) -> str:
    return f"| {' | '.join(_emphasize(row, _markdown, '**{}**'))} |"


def _markdown(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|~#&$])", r"\\\1", text.strip())


def _latex_row(row: Sequence[str]) -> str:
    return " & ".join(_emphasize(row, _latex, r"\textbf{{{}}}")) + r" \\"


def _latex(text: str) -> str:
    return re.sub(r"->|.", lambda found: _LATEX.get(found[0], found[0]), text)
