"""The report as an HTML page: its figures, and random rationales beside their frames."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from conf.runs import write_text
from data.publish.contact_sheets import ExampleRows, draw_sheet
from data.records import Rationale
from data.store import Store, write_atomically
from teacher.predicates import extract_predicates

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>Rationales of {teacher}</title>
<style>
  body {{ font: 16px/1.55 system-ui, sans-serif; color: #222; background: #f4f4f4; margin: 0 auto;
         max-width: 1400px; padding: 8px 24px 48px; }}
  article {{ background: #fff; border: 1px solid #ddd; padding: 16px 20px; margin: 24px 0; }}
  img {{ max-width: 100%; }}
  p {{ max-width: 75em; margin: 8px 0; }}
  small, summary {{ color: #666; }}
  pre {{ white-space: pre-wrap; font-size: 13px; }}
</style>
<h1>Rationales of {teacher}</h1>
<pre>{figures}</pre>
<p>{count} of {accepted:,} accepted rationales for the benchmark {benchmark}, a random sample. The
frames of the prefix are on the left and the candidates on the right; the answer has a green
frame.</p>
{articles}
</html>
"""


def write_page(
    store: Store, accepted: Sequence[Rationale], figures: str, count: int, seed: int, folder: Path
) -> Path:
    """Write report.html with `figures` and `count` random rationales, and its images."""
    chosen = np.random.default_rng(seed).permutation(len(accepted))[:count]
    items = {item.item_id: item for item in store.selection("train")}
    rows = ExampleRows(store)
    articles = []
    for k in sorted(chosen.tolist()):
        rationale = accepted[k]
        item = items[rationale.item_id]
        write_atomically(folder / "images" / f"{item.item_id}.png", draw_sheet([rows.item(item)]))
        predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
        facts = json.dumps(predicates.to_dict() if predicates else None, indent=1)
        articles.append(_format_article(rationale, facts))
    page = PAGE.format(
        teacher=escape(accepted[0].teacher if accepted else "an unnamed teacher"),
        count=len(articles),
        accepted=len(accepted),
        benchmark=escape(store.name),
        figures=escape(figures),
        articles="\n".join(articles),
    )
    write_text(folder / "report.html", page)
    return folder / "report.html"


def _format_article(rationale: Rationale, facts: str) -> str:
    name = escape(rationale.item_id)
    source = "built-in narrator (fallback)" if rationale.fallback else rationale.teacher
    source = escape(f"{source}, attempt {rationale.attempt + 1}")
    return "\n".join(
        [
            f'<article id="{name}">',
            f'<img src="images/{name}.png" alt="{name}" loading="lazy">',
            *(f"<p><b>{escape(k)}.</b> {escape(v)}</p>" for k, v in rationale.sections.items()),
            f"<p><b>Answer: {escape(str(rationale.answer))}</b> <small>{source}</small></p>",
            f"<details><summary>Predicates</summary><pre>{escape(facts)}</pre></details>",
            "</article>",
        ]
    )
