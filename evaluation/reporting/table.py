"""A table and the formats that it is written in, all from the same rows: aligned text, Markdown,
LaTeX and HTML."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

NAME_WIDTH = 40
"""Characters that text gives a head or a row's name."""
ENDING = 14
"""Of these, those that are kept of a longer name's end, which says how a model was asked."""
LINE = 100
"""Characters of a line of notes."""

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
    """A cell that is the best of its column: bold, except in plain text."""

    __slots__ = ()


@dataclass(frozen=True)
class Table:
    """Rows of cells as they are printed, as wide as the head each. A row whose name begins with two
    spaces belongs to the one above it.

    `name` is the stem of the files that it is written to. `parts` holds the rows by their part's
    label, which is empty where a part needs none.
    """

    name: str
    caption: str
    head: Sequence[str]
    parts: Mapping[str, Sequence[Sequence[str]]]
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.as_text()

    def as_text(self) -> str:
        """Aligned columns, the first to the left, one part after the other under its label; names
        that are too long lose their middle."""
        head = [clipped(cell) for cell in self.head]
        parts = {
            label: [[clipped(name), *rest] for name, *rest in rows]
            for label, rows in self.parts.items()
        }
        cells = [head, *(row for rows in parts.values() for row in rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        rule = "-" * (sum(widths) + 2 * len(widths) - 2)
        lines = [_line(head, widths)]
        for label, rows in parts.items():
            lines += [rule, *([label] if label else []), *(_line(row, widths) for row in rows)]
        notes = [textwrap.fill(note, LINE) for note in self.notes]
        return "\n".join([*lines, rule, *notes])

    def as_markdown(self) -> str:
        """A table of GitHub's Markdown under its caption."""
        others = len(self.head) - 1
        lines = [_piped(self.head), f"|:--{'|--:' * others}|"]
        for label, rows in self.parts.items():
            lines += [_piped([f"*{_plain(label)}*", *[""] * others], raw=1)] if label else []
            lines += [_piped(row) for row in rows]
        notes = [_plain(note) for note in self.notes]
        return "\n\n".join([f"**{_plain(self.caption)}**", "\n".join(lines), *notes]) + "\n"

    def as_latex(self) -> str:
        """A float in the paper's shape; needs the packages booktabs and graphicx."""
        columns = len(self.head)
        body = [_ampersands(self.head)]
        for label, rows in self.parts.items():
            body.append(r"\midrule")
            if label:
                body.append(rf"\multicolumn{{{columns}}}{{@{{}}l}}{{\emph{{{_latex(label)}}}}} \\")
            for row in rows:
                indent = r"\quad " * (bool(label) + row[0].startswith("  "))
                body.append(indent + _ampersands(row))
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

    def as_html(self) -> str:
        """A `table` element with its caption, and its notes in paragraphs after it."""
        lines = [f"<caption>{escape(self.caption)}</caption>", "<thead>"]
        lines += [_tagged(self.head, 'th scope="col"'), "</thead>"]
        for label, rows in self.parts.items():
            lines.append("<tbody>")
            if label:
                spans = f'colspan="{len(self.head)}" scope="rowgroup"'
                lines.append(f'<tr class="part"><th {spans}>{escape(label)}</th></tr>')
            lines += [_tagged(row, "td", 'th scope="row"') for row in rows]
            lines.append("</tbody>")
        notes = [f'<p class="note">{escape(note)}</p>' for note in self.notes]
        return "\n".join(["<table>", *lines, "</table>", *notes])


def clipped(name: str) -> str:
    """A name without its middle where it is longer than `NAME_WIDTH`."""
    if len(name) <= NAME_WIDTH:
        return name
    return f"{name[: NAME_WIDTH - ENDING - 1]}…{name[-ENDING:]}"


def _line(row: Iterable[str], widths: list[int]) -> str:
    first, *rest = row
    cells = [first.ljust(widths[0])]
    cells += [cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True)]
    return "  ".join(cells).rstrip()


def _piped(row: Sequence[str], raw: int = 0) -> str:
    """A line of a Markdown table; the first `raw` cells are Markdown already."""
    cells = [*row[:raw], *_shown(row[raw:], _plain, "**{}**")]
    return f"| {' | '.join(cells)} |"


def _shown(row: Iterable[str], written: Callable[[str], str], bold: str) -> list[str]:
    """Each cell as a format has it written, the best ones in its way of bold."""
    cells = ((cell, written(cell.strip())) for cell in row)
    return [bold.format(text) if isinstance(cell, Best) else text for cell, text in cells]


def _plain(text: str) -> str:
    """Text that Markdown shows as it is."""
    return re.sub(r"([\\`*_\[\]<>|~#&$])", r"\\\1", text.strip())


def _ampersands(row: Sequence[str]) -> str:
    return " & ".join(_shown(row, _latex, r"\textbf{{{}}}")) + r" \\"


def _latex(text: str) -> str:
    return re.sub(r"->|.", lambda found: _LATEX.get(found[0], found[0]), text)


def _tagged(row: Sequence[str], tag: str, first: str | None = None) -> str:
    """A line of an HTML table, its cells in elements of `tag`, the first one in that of `first`."""
    tags = [first or tag, *[tag] * (len(row) - 1)]
    told = zip(tags, _shown(row, escape, "<b>{}</b>"), strict=True)
    cells = [f"<{t}>{cell}</{t.split()[0]}>" for t, cell in told]
    under = ' class="under"' if row[0].startswith("  ") else ""
    return f"<tr{under}>{''.join(cells)}</tr>"
