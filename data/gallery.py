"""Draw contact sheets of a benchmark's items and queries, and a page that contains all of them."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from tqdm import tqdm

from conf.entry import Run, command
from conf.files import write_bytes, write_text
from conf.schema import GalleryCommand
from data.build import ensure_benchmark
from data.items.controls import pair_items
from data.publish.contact_sheets import SheetRows, draw_sheet
from data.records import MATCHED_ANCHOR, SPLITS
from data.seeded_order import named_rng
from data.store import Store

log = logging.getLogger(__name__)


@command("data.gallery", GalleryCommand)
def main(cfg: GalleryCommand, run: Run) -> dict[str, float]:
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    sheets = []
    for sheet in tqdm(draw_sheets(store, cfg.examples, cfg.seed), desc="drawing", unit="sheet"):
        write_bytes(run.folder / sheet.file, sheet.png)
        sheets.append(sheet)
    page = run.folder / "index.html"
    write_text(page, render_page(store, sheets))
    log.info("%d sheets: open %s", len(sheets), page)
    return {"sheets": float(len(sheets))}


@dataclass(frozen=True)
class Sheet:
    """A contact sheet (PNG), its file name, and its section and title on the page."""

    section: str
    title: str
    file: str
    png: bytes


def draw_sheets(store: Store, examples: int, seed: int) -> Iterator[Sheet]:
    """Draw a sheet of up to `examples` random items, queries or pairs for each selection subtype,
    retrieval builder and control."""
    rows = SheetRows(store)
    groups: dict[tuple[str, str, str], list[tuple]] = defaultdict(list)
    for item in store.selection():
        group = f"Selection: {item.family}", item.subtype, f"{item.family}-{item.subtype}"
        groups[group].append((item,))
    for query in sorted(store.retrieval(), key=lambda query: query.builder):
        number = query.builder
        group = "Retrieval: future", f"builder {number}", f"retrieval-builder-{number}"
        groups[group].append((query,))
    for query in store.retrieval(pool="counterfactual"):
        group = "Retrieval: counterfactual", "scenes without one object", "counterfactual"
        groups[group].append((query,))
    for pair in pair_items(store.selection(suite=MATCHED_ANCHOR)):
        group = "Controls", "pairs that differ only in the anchor", f"controls-{MATCHED_ANCHOR}"
        groups[group].append(pair)
    for (section, title, name), examples_of_group in groups.items():
        count = len(examples_of_group)
        order = named_rng(seed, "gallery", name).permutation(count)[:examples]
        records = [record for k in sorted(order) for record in examples_of_group[k]]
        png = draw_sheet([rows.make(record) for record in records])
        yield Sheet(section, f"{title} ({count:,})", f"{name}.png", png)


def render_page(store: Store, sheets: Sequence[Sheet]) -> str:
    """Return an HTML page that shows `sheets`, whose files must be in the folder of the page."""
    from jinja2 import Template

    sections = defaultdict(list)
    for sheet in sheets:
        anchor = Path(sheet.file).stem
        name = anchor.partition("-")[2] or anchor
        sections[sheet.section].append((anchor, name, sheet.title, sheet.file))
    text = (files("data.publish") / "templates/gallery.html").read_text()
    return Template(text, autoescape=True).render(
        store=store,
        sections=sections,
        fps=store.scene(store.scene_ids("test")[0]).fps,
        scenes=sum(len(store.scene_ids(split)) for split in SPLITS),
    )


if __name__ == "__main__":
    main()
