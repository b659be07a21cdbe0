"""Every format of a table shows the same cells, whatever text they contain."""

from __future__ import annotations

import html
import re

import pytest

from evaluation.metrics.intervals import Interval
from evaluation.reporting.item_browser import ItemBrowser
from evaluation.reporting.page import write_page
from evaluation.reporting.sections import Section
from evaluation.reporting.table import Table

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
    ["R@1", "of_what"],
    {
        "": [{"name": name, "R@1": 0.01, "of_what": None} for name in NAMES],
        "others & more": [{"name": "one", "R@1": Interval(0.02, 0.01, 0.03, 9)}],
        "empty": [],
    },
    ("A note of 5% & more.",),
    best={"R@1": max},
)
ROWS = [
    ["", *TABLE.columns],
    *([name, "1.0", "-"] for name in NAMES),
    ["one", "2.0", ""],
    ["95% interval", "1-3", ""],
]


def markdown_cells(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if re.match(r"\|[^:]", line)]
    rows = [
        re.split(r"(?<!\\)\|", line)[1:-1] for line in lines if not line.startswith("| *others")
    ]
    plain = [[re.sub(r"^\*\*(.*)\*\*$", r"\1", cell.strip()) for cell in row] for row in rows]
    return [[re.sub(r"\\(.)", r"\1", cell) for cell in row] for row in plain]


def latex_cells(text: str) -> list[list[str]]:
    body = text.partition(r"\toprule")[2].partition(r"\bottomrule")[0]
    lines = [line.removesuffix(r" \\") for line in body.splitlines() if line.endswith(r" \\")]
    rows = [re.split(r"(?<!\\)&", line) for line in lines if "multicolumn" not in line]
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
    write_page(tmp_path / "page.html", [Section("One", [TABLE])], ItemBrowser(), [])
    table = re.search(r"<table>.*</table>", (tmp_path / "page.html").read_text(), re.DOTALL)[0]
    rows = [
        re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)
        for row in re.findall(r"<tr.*?>(.*?)</tr>", table, re.DOTALL)
    ]
    plain = [[html.unescape(re.sub(r"</?b>", "", cell)) for cell in row] for row in rows]
    assert [row for row in plain if len(row) == 3] == ROWS
    tags = {"table", "caption", "thead", "tbody", "tr", "th", "td", "b"}
    assert set(re.findall(r"<(\w+)", table)) == tags
    assert re.findall(r"<b>(.*?)</b>", table) == ["2.0"]


def test_best_values_are_bold_and_people_do_not_compete():
    rows = [
        {"name": "a", "R": Interval(0.09, 0.08, 0.95, 9)}, {"name": "b", "R": 0.08},
        {"name": "tie", "R": 0.0900001}, {"name": "c", "R": None},
        {"name": "human", "R": 0.99, "ranked": False},
    ]  # fmt: skip
    table = Table("t", "c", ["R"], {"": rows}, paper={"paper": rows[:1]}, best={"R": max})
    assert table.as_markdown().count("**9.0**") == 2
    assert table.as_latex().count("textbf") == 2
    # A single value is not compared.
    assert table.as_markdown().count("| 9.0 |") == 1
    assert "*" not in str(table)


def test_differences_have_signs():
    row = {"name": "a", "R@1": Interval(0.09, -0.08, 0.95, 9), "MRR": Interval(-0.1, -0.2, 0, 9)}
    lines = Table("t", "c", ["R@1", "MRR"], {"": [row]}, signed=True).body[0][1]
    assert [line[1:] for line in lines] == [
        ["+9.0", "-0.100"], ["-8.0 to +95.0", "-0.200 to +0.000"]
    ]  # fmt: skip


def test_latex_closes_what_it_opens():
    latex = TABLE.as_latex()
    plain = re.sub(r"\\[{}]", "", latex)
    assert plain.count("{") == plain.count("}")
    assert re.findall(r"\\begin\{(\w+)\}", latex) == re.findall(r"\\end\{(\w+)\}", latex)[::-1]
    assert re.search(r"(?<!\\)[#_^~]", plain) is None
    assert r"\label{tab:hostile---name}" in latex


def test_text_is_aligned():
    lines = str(TABLE).splitlines()
    edge = lines[2].index("R@1") + 3
    assert all(line[edge - 3 : edge] == "1.0" for line in lines[4 : 4 + len(NAMES)])


@pytest.mark.parametrize("render", [str, Table.as_markdown, Table.as_latex])
def test_empty_groups_are_not_printed(render):
    assert "empty" not in render(TABLE)
