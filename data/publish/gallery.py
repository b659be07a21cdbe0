"""The sheets of a benchmark's gallery, and the page that contains them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from dynapix.conf.schema.benchmark import INTERVENTIONS, MATCHED_ANCHOR
from dynapix.data.items.controls import pair_items
from dynapix.data.publish.contact_sheets import SheetRows, draw_sheet
from dynapix.data.records import SPLITS
from dynapix.data.seeded_order import named_rng
from dynapix.data.store import Store


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
    for pair in pair_items(store.selection(suite=INTERVENTIONS)):
        change = pair[0].subtype
        groups["Interventions", change, f"{INTERVENTIONS}-{change}"].append(pair)
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
    text = (files("dynapix.data.publish") / "templates/gallery.html").read_text()
    return Template(text, autoescape=True).render(
        store=store,
        sections=sections,
        fps=store.scene(store.scene_ids("test")[0]).fps,
        scenes=sum(len(store.scene_ids(split)) for split in SPLITS),
    )
