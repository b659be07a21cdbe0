"""The sheets of a benchmark's gallery, and the page that contains them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from data.publish.contact_sheets import draw_sheet
from data.publish.examples import ExampleRows
from data.publish.trajectories import draw_trajectories
from data.records import FAMILIES, SPLITS
from data.store import Store
from data.tracks.controls import MATCHED_ANCHOR, pair_items
from data.tracks.quota import named_rng

TEMPLATE = "templates/gallery.html"


@dataclass(frozen=True)
class Sheet:
    """A picture of some items, queries or scenes, and its section and title on the page."""

    section: str
    title: str
    file: str
    png: bytes


def draw_sheets(store: Store, examples: int, seed: int) -> Iterator[Sheet]:
    """Draw every sheet, with `examples` of each subtype and builder sampled by `seed`."""
    rows = ExampleRows(store)
    for family in FAMILIES:
        items = [i for i in store.selection() if i.family == family]
        for subtype, group in _group(items, "subtype").items():
            png = draw_sheet([rows.item(i) for i in _sample(group, examples, seed, subtype)])
            title = f"{subtype} ({len(group):,} items)"
            yield Sheet(f"Selection: {family}", title, f"{family}-{subtype}.png", png)
    for builder, group in sorted(_group(store.retrieval(), "builder").items()):
        sample = _sample(group, examples, seed, f"builder {builder}")
        title = f"builder {builder} ({len(group):,} queries)"
        png = draw_sheet([rows.query(q) for q in sample])
        yield Sheet("Retrieval: future", title, f"retrieval-builder-{builder}.png", png)
    if queries := store.retrieval(pool="counterfactual"):
        sample = _sample(queries, 2 * examples, seed, "counterfactual")
        title = f"the scene with and without an object ({len(queries):,} queries)"
        png = draw_sheet([rows.counterfactual(q) for q in sample])
        yield Sheet("Retrieval: counterfactual", title, "counterfactual.png", png)
    if pairs := pair_items(store.selection(suite=MATCHED_ANCHOR)):
        sample = _sample(pairs, examples, seed, MATCHED_ANCHOR)
        title = f"pairs that differ only in the question's anchor ({len(pairs):,} pairs)"
        png = draw_sheet([rows.item(item) for pair in sample for item in pair])
        yield Sheet("Controls", title, f"controls-{MATCHED_ANCHOR}.png", png)
    # The floor is drawn as the standard camera sees it: other suites have other cameras.
    if store.suite == "dynapix" and store.manifest["config"]["simulator"] == "bullet":
        names = [name for split in SPLITS for name in store.scene_ids(split)]
        scenes = [store.scene(name) for name in _sample(names, 2 * examples, seed, "paths")]
        title = "from start (hollow) to end (full), a dot each second, a cross at each collision"
        png = draw_trajectories(scenes)
        yield Sheet("Trajectories on the floor", title, "trajectories.png", png)


def _group(records: Iterable[Any], field: str) -> dict[Any, list[Any]]:
    groups = defaultdict(list)
    for record in records:
        groups[getattr(record, field)].append(record)
    return groups


def _sample(population: Sequence[Any], count: int, seed: int, name: str) -> list[Any]:
    sample = named_rng(seed, "gallery", name).permutation(len(population))[:count]
    return [population[k] for k in sorted(sample)]


def render_page(store: Store, sheets: Sequence[tuple[str, str, str]]) -> str:
    """Return the HTML page of sheets in its folder, each a (section, title, file)."""
    from jinja2 import Environment

    sections = defaultdict(list)
    for section, title, file in sheets:
        anchor = Path(file).stem
        sections[section].append((anchor, anchor.partition("-")[2] or anchor, title, file))
    template = Environment(autoescape=True).from_string(
        (files("data.publish") / TEMPLATE).read_text()
    )
    return template.render(
        store=store,
        sections=sections,
        fps=store.scene(store.scene_ids("test")[0]).fps,
        scenes=sum(len(store.scene_ids(split)) for split in SPLITS),
    )
