"""Every format of a table shows the same cells, whatever text they contain."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from evaluation.reporting.item_browser import ItemBrowser
from evaluation.reporting.page import write_page
from evaluation.reporting.sections import Section
from evaluation.reporting.table import NAME_WIDTH, Best, Table, mark_best, shorten

NAMES = (
    "a & b | c_d # 100% $x$",
    r"\input{secret} ~ ^ {open",
    "<script>alert(1)</script>",
    "*bold* [link](there) `code`",
    "Qwen3-VL-8B CoT -> text",
    "run … (answer)",
)
TABLE = Table(
    "hostile & name",
    "A caption with 100% of <b>everything</b>",
    ["Name", "R@1", "of_what"],
    {
        "": [[name, "1.0", "-"] for name in NAMES],
        "paper & others": [["one", Best("2.0"), ""], ["  95% interval", "1-3", ""]],
        "empty": [],
    },
    ("A note of 5% & more.",),
)
ROWS = [[cell.strip() for cell in row] for rows in TABLE.groups.values() for row in rows]


class Cells(HTMLParser):
    """The rows of an HTML table."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.tags: set[str] = set()
        self.bold: list[str] = []
        self.cell, self.in_bold = False, False

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
            self.cell = True
        self.in_bold = tag == "b"

    def handle_endtag(self, tag):
        self.in_bold = False
        self.cell = self.cell and tag not in ("td", "th")

    def handle_data(self, data):
        if self.cell:
            self.rows[-1][-1] += data
        if self.in_bold:
            self.bold.append(data)


def html_cells(folder: Path) -> Cells:
    write_page(folder / "page.html", [Section("One", [TABLE])], ItemBrowser(), [])
    table = re.search(r"<table>.*</table>", (folder / "page.html").read_text(), re.DOTALL)[0]
    cells = Cells()
    cells.feed(table)
    return cells


def markdown_cells(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")][2:]
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines if not line.startswith("| *paper")]
    plain = [[re.sub(r"^\*\*(.*)\*\*$", r"\1", cell.strip()) for cell in row] for row in rows]
    return [[re.sub(r"\\(.)", r"\1", cell) for cell in row] for row in plain]


def latex_cells(text: str) -> list[list[str]]:
    body = text.partition(r"\toprule")[2].partition(r"\bottomrule")[0]
    lines = [line.removesuffix(r" \\") for line in body.splitlines() if line.endswith(r" \\")]
    rows = [re.split(r"(?<!\\)&", line) for line in lines[1:] if "multicolumn" not in line]
    return [[unescape(cell.replace(r"\quad", "").strip()) for cell in row] for row in rows]


def unescape(text: str) -> str:
    words = {
        "textbackslash": "\\", "textasciitilde": "~", "textasciicircum": "^",
        "textless": "<", "textgreater": ">", "ldots": "…",
    }  # fmt: skip
    text = re.sub(r"^\\textbf\{(.*)\}$", r"\1", text.replace(r"$\rightarrow$", "->"))
    return re.sub(r"\\(?:([a-z]+)\{\}|([&%$#_{}]))", lambda f: words[f[1]] if f[1] else f[2], text)


def test_markdown_and_latex_show_every_cell():
    assert markdown_cells(TABLE.as_markdown()) == ROWS
    assert latex_cells(TABLE.as_latex()) == ROWS


def test_html_shows_every_cell_as_text(tmp_path):
    cells = html_cells(tmp_path)
    assert [row for row in cells.rows[1:] if len(row) == 3] == ROWS
    assert cells.tags == {"table", "caption", "thead", "tbody", "tr", "th", "td", "b"}
    assert cells.bold == ["2.0"]


def test_best_values_are_bold_and_reference_people_do_not_compete():
    rows = [["a", "9.0"], ["  95% interval", "9.5"], ["b", "8.0"], ["c", "-"], ["human", "9.9"]]
    marked = mark_best({"": rows}, ["Name", "R"], {"R": max}, ["human"])
    assert [isinstance(row[1], Best) for row in marked[""]] == [True, False, False, False, False]
    single = mark_best({"": rows[:2]}, ["Name", "R"], {"R": max})
    assert not isinstance(single[""][0][1], Best)
    table = Table("t", "c", ["Name", "R"], marked)
    assert "| **9.0** |" in table.as_markdown()
    assert table.as_latex().count("textbf") == table.as_latex().count(r"\textbf{9.0} \\") == 1
    assert "*" not in table.as_text()


def test_latex_closes_what_it_opens():
    latex = TABLE.as_latex()
    plain = re.sub(r"\\[{}]", "", latex)
    assert plain.count("{") == plain.count("}")
    assert re.findall(r"\\begin\{(\w+)\}", latex) == re.findall(r"\\end\{(\w+)\}", latex)[::-1]
    assert re.search(r"(?<!\\)[#_^~]", plain) is None
    assert r"\label{tab:hostile---name}" in latex


def test_text_is_aligned_and_keeps_both_ends_of_a_name():
    text = TABLE.as_text().splitlines()
    edge = text[0].index("R@1") + 3
    assert all(line[edge - 3 : edge] == "1.0" for line in text[2 : 2 + len(NAMES)])
    long = f"{'very ' * 20}long (constrained)"
    assert shorten(long).startswith("very very")
    assert shorten(long).endswith("… (constrained)"[-15:])
    assert len(shorten(long)) == NAME_WIDTH
    assert shorten("short") == "short"


@pytest.mark.parametrize("form", ["as_text", "as_markdown", "as_latex"])
def test_empty_groups_are_not_printed(form):
    assert "empty" not in getattr(TABLE, form)()
