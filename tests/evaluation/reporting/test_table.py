"""Every format of a table shows the same cells, whatever text the cells contain."""

from __future__ import annotations

import html
import re

from dynapix.data.checks.intervals import Interval
from dynapix.evaluation.report import render_page
from dynapix.evaluation.reporting.item_results import ItemResults
from dynapix.evaluation.reporting.sections import Section
from dynapix.evaluation.reporting.table import Table

ESCAPED = {
    "a & b | c_d # 100% $x$": (r"a \& b \| c\_d \# 100% \$x\$", r"a \& b | c\_d \# 100\% \$x\$"),
    r"\input{secret} ~ ^ {open": (
        r"\\input{secret} \~ ^ {open",
        r"\textbackslash{}input\{secret\} \textasciitilde{} \textasciicircum{} \{open",
    ),
    "<script>alert(1)</script>": (
        r"\<script\>alert(1)\</script\>",
        r"\textless{}script\textgreater{}alert(1)\textless{}/script\textgreater{}",
    ),
    "*bold* [a](b) `code`": (r"\*bold\* \[a\](b) \`code\`", "*bold* [a](b) `code`"),
    "CoT -> text": (r"CoT -\> text", r"CoT $\rightarrow$ text"),
    "run … (answer)": ("run … (answer)", r"run \ldots{} (answer)"),
}
"""Names of rows, with their escaped forms in Markdown and in LaTeX."""
TABLE = Table(
    "hostile & name",
    "A caption with 100% of <b>everything</b>",
    ["R@1", "of_what"],
    {
        "": [{"name": name, "R@1": 0.01, "of_what": None} for name in ESCAPED],
        "others & more": [{"name": "one", "R@1": Interval(0.02, 0.01, 0.03, 9)}],
        "empty": [],
    },
    ("A note of 5% & more.",),
    best={"R@1": max},
)
ROWS = [
    ["", *TABLE.columns],
    *([name, "1.0", "-"] for name in ESCAPED),
    ["one", "2.0", ""],
    ["95% interval", "1-3", ""],
]


def test_markdown_and_latex_show_every_cell():
    markdown, latex = TABLE.as_markdown(), TABLE.as_latex()
    for in_markdown, in_latex in ESCAPED.values():
        assert f"\n| {in_markdown} | 1.0 | - |\n" in markdown
        assert f"\n{in_latex} & 1.0 & - \\\\\n" in latex
    assert "\n| one | **2.0** |  |\n| 95% interval | 1-3 |  |\n" in markdown
    assert r"\quad one & \textbf{2.0} &  \\" in latex
    assert r"\quad \quad 95\% interval & 1-3 &  \\" in latex


def test_html_shows_every_cell_as_text():
    page = render_page([Section("One", [TABLE])], ItemResults(), [], [])
    table = re.search(r"<table>.*</table>", page, re.DOTALL)[0]
    rows = [
        re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)
        for row in re.findall(r"<tr.*?>(.*?)</tr>", table, re.DOTALL)
    ]
    plain = [[html.unescape(re.sub(r"</?b>", "", cell)) for cell in row] for row in rows]
    assert [row for row in plain if len(row) == 3] == ROWS
    tags = {"table", "caption", "thead", "tbody", "tr", "th", "td", "b"}
    assert set(re.findall(r"<(\w+)", table)) == tags
    assert re.findall(r"<b>(.*?)</b>", table) == ["2.0"]


def test_best_values_are_bold_except_in_rows_that_are_not_ranked():
    rows = [
        {"name": "a", "R": Interval(0.09, 0.08, 0.95, 9)}, {"name": "b", "R": 0.08},
        {"name": "tie", "R": 0.0900001}, {"name": "c", "R": None},
        {"name": "human", "R": 0.99, "ranked": False},
    ]  # fmt: skip
    table = Table("t", "c", ["R"], {"": rows}, paper={"paper": rows[:1]}, best={"R": max})
    assert table.as_markdown().count("**9.0**") == 2
    assert table.as_latex().count("textbf") == 2
    # The paper has a single value in the column, which is not marked.
    assert table.as_markdown().count("| 9.0 |") == 1
    assert "*" not in str(table)


def test_differences_are_printed_with_signs():
    row = {"name": "a", "R@1": Interval(0.09, -0.08, 0.95, 9), "MRR": Interval(-0.1, -0.2, 0, 9)}
    lines = Table("t", "c", ["R@1", "MRR"], {"": [row]}, signed=True).body[0][1]
    assert [line[1:] for line in lines] == [
        ["+9.0", "-0.100"], ["-8.0 to +95.0", "-0.200 to +0.000"]
    ]  # fmt: skip


def test_latex_is_balanced_and_has_no_unescaped_character():
    latex = TABLE.as_latex()
    plain = re.sub(r"\\[{}]", "", latex)
    assert plain.count("{") == plain.count("}")
    assert re.findall(r"\\begin\{(\w+)\}", latex) == re.findall(r"\\end\{(\w+)\}", latex)[::-1]
    assert re.search(r"(?<!\\)[#_^~]", plain) is None
    assert r"\label{tab:hostile---name}" in latex


def test_columns_of_the_plain_text_are_aligned():
    lines = str(TABLE).splitlines()
    edge = lines[2].index("R@1") + 3
    assert all(line[edge - 3 : edge] == "1.0" for line in lines[4 : 4 + len(ESCAPED)])
    # Empty groups are not printed.
    assert "empty" not in str(TABLE) + TABLE.as_markdown() + TABLE.as_latex()
