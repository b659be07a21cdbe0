"""The report as a page: its figures, and random rationales beside their frames for reading."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from conf.runs import write_text
from data.publish.contact_sheets import draw_sheet
from data.publish.examples import ExampleRows
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
<p>{shown} of {accepted:,} accepted rationales for benchmark {benchmark}, chosen at random. Left of
the line is what is observed, right of it the candidates; the answer is framed in green.</p>
{body}
</html>
"""


def write_page(
    store: Store, accepted: Sequence[Rationale], figures: str, shown: int, seed: int, folder: Path
) -> Path:
    """Write report.html and its pictures: `figures` as they are, and `shown` of the rationales as
    `seed` chooses them."""
    chosen = np.random.default_rng(seed).permutation(len(accepted))[:shown]
    items = {item.item_id: item for item in store.selection("train")}
    look = ExampleRows(store)
    body = []
    for k in sorted(chosen.tolist()):
        rationale = accepted[k]
        item = items[rationale.item_id]
        write_atomically(folder / "shown" / f"{item.item_id}.png", draw_sheet([look.item(item)]))
        predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
        facts = json.dumps(predicates.to_dict() if predicates else None, indent=1)
        body.append(_article(rationale, facts))
    page = folder / "report.html"
    told = PAGE.format(
        teacher=escape(accepted[0].teacher if accepted else "nobody"),
        shown=len(body),
        accepted=len(accepted),
        benchmark=escape(store.name),
        figures=escape(figures),
        body="\n".join(body),
    )
    write_text(page, told)
    return page


def _article(rationale: Rationale, facts: str) -> str:
    name = escape(rationale.item_id)
    parts = [f"<p><b>{escape(k)}.</b> {escape(v)}</p>" for k, v in rationale.sections.items()]
    source = "the built-in narrator instead" if rationale.fallback else rationale.teacher
    told = f"{source}, attempt {rationale.attempt + 1}"
    return "\n".join(
        [
            f'<article id="{name}">',
            f'<img src="shown/{name}.png" alt="{name}" loading="lazy">',
            *parts,
            f"<p><b>Answer: {escape(str(rationale.answer))}</b> <small>{escape(told)}</small></p>",
            f"<details><summary>What it was told</summary><pre>{escape(facts)}</pre></details>",
            "</article>",
        ]
    )
