"""Every format of a table holds the same cells, whatever stands in them."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest

from evaluation.reporting.table import NAME_WIDTH, Best, Table, clipped

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
        "paper & others": [["one", "2.0", ""], ["  95% interval", "1-3", ""]],
    },
    ("A note of 5% & more.",),
)
ROWS = [[cell.strip() for cell in row] for rows in TABLE.parts.values() for row in rows]


class Cells(HTMLParser):
    """The rows of an HTML table."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.tags: set[str] = set()
        self.open = False

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag == "tr":
            self.rows.append([])
        self.open = tag in ("td", "th")
        if self.open:
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        self.open = False

    def handle_data(self, data):
        if self.open:
            self.rows[-1][-1] += data


def of_html(text: str) -> list[list[str]]:
    cells = Cells()
    cells.feed(text)
    assert cells.tags == {"table", "caption", "thead", "tbody", "tr", "th", "td", "p"}
    return [row for row in cells.rows[1:] if len(row) == 3]


def of_markdown(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")][2:]
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines]
    plain = [[re.sub(r"\\(.)", r"\1", cell.strip()) for cell in row] for row in rows]
    return [row for row in plain if not row[0].startswith("*paper")]


def of_latex(text: str) -> list[list[str]]:
    body = text.partition(r"\toprule")[2].partition(r"\bottomrule")[0]
    lines = [line.removesuffix(r" \\") for line in body.splitlines() if line.endswith(r" \\")]
    rows = [re.split(r"(?<!\\)&", line) for line in lines[1:] if "multicolumn" not in line]
    return [[unescaped(cell.replace(r"\quad", "").strip()) for cell in row] for row in rows]


def unescaped(text: str) -> str:
    words = {
        "textbackslash": "\\", "textasciitilde": "~", "textasciicircum": "^",
        "textless": "<", "textgreater": ">", "ldots": "…",
    }  # fmt: skip
    text = text.replace(r"$\rightarrow$", "->")
    return re.sub(r"\\(?:([a-z]+)\{\}|([&%$#_{}]))", lambda f: words[f[1]] if f[1] else f[2], text)


@pytest.mark.parametrize(
    ("written", "read"),
    [
        (TABLE.as_html(), of_html),
        (TABLE.as_markdown(), of_markdown),
        (TABLE.as_latex(), of_latex),
    ],
    ids=["html", "markdown", "latex"],
)
def test_a_format_holds_every_cell(written, read):
    assert read(written) == ROWS


def test_the_best_of_a_column_stands_bold_and_the_rest_do_not():
    table = Table("t", "c", ["Name", "R"], {"": [["a", Best("9 & 10")], ["b", "8"]]})
    assert table.as_html().count("<b>") == table.as_html().count("<td><b>9 &amp; 10</b></td>") == 1
    assert r"| **9 \& 10** |" in table.as_markdown()
    assert "| 8 |" in table.as_markdown()
    assert table.as_latex().count("textbf") == table.as_latex().count(r"\textbf{9 \& 10} \\") == 1
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
    assert clipped(long).startswith("very very")
    assert clipped(long).endswith("… (constrained)"[-15:])
    assert len(clipped(long)) == NAME_WIDTH
    assert clipped("short") == "short"
