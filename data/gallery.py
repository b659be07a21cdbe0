"""Show what a benchmark asks: contact sheets of items and queries, and a page with all of them."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

from tqdm import tqdm

from conf.entry import Run, command
from conf.runs import write_text
from conf.schema import GalleryCommand
from data.publish.contact_sheets import Cell, Row, paths, sheet
from data.records import (
    FAMILIES,
    LETTERS,
    SPLITS,
    FrameRef,
    RetrievalQuery,
    SelectionItem,
    sample_prefix_frames,
)
from data.render.frame_cache import FrameReader
from data.store import Store, write_atomically
from data.tracks.controls import MATCHED_ANCHOR
from data.tracks.quota import named_rng
from data.tracks.retrieval.counterfactual import removal_displacement
from data.world.displacement import cross_scene_displacement

log = logging.getLogger(__name__)

OBSERVED = 4
"""Frames of a prefix on a sheet."""
AXES = {
    "framing": "framing {}",
    "gap": "gap {}",
    "horizon": "horizon {}",
    "group": "group {}",
    "window_family": "family {}",
    "difficulty": "{}",
}
"""How a row tells the axes that apply to its item."""


@dataclass(frozen=True)
class Sheet:
    """A picture of a group of items, queries or scenes, and where it stands on the page."""

    section: str
    title: str
    file: str
    picture: bytes


@command("data.gallery", GalleryCommand)
def main(cfg: GalleryCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    titles = []
    for drawn in tqdm(sheets(store, cfg.examples, cfg.seed), desc="drawing", unit="sheet"):
        write_atomically(run.folder / drawn.file, drawn.picture)
        titles.append((drawn.section, drawn.title, drawn.file))
    write_text(run.folder / "index.html", page(store, titles))
    log.info("%d sheets: open %s", len(titles), run.folder / "index.html")
    return {"sheets": float(len(titles))}


def sheets(store: Store, examples: int, seed: int) -> Iterator[Sheet]:
    """Every sheet, with `examples` of each group chosen by `seed`."""
    look = Looker(store)
    items, queries = store.selection(), store.retrieval()
    for family in FAMILIES:
        cells = _grouped(i for i in items if i.family == family)
        for subtype, every in cells.items():
            rows = [look.item(i) for i in _some(every, examples, seed, subtype)]
            title = f"{subtype} ({len(every):,} items)"
            yield Sheet(f"Selection: {family}", title, f"{family}-{subtype}.png", sheet(rows))
    for builder, every in sorted(_grouped(queries, "builder").items()):
        rows = [look.query(q) for q in _some(every, examples, seed, f"builder {builder}")]
        title = f"builder {builder} ({len(every):,} queries)"
        yield Sheet("Retrieval: future", title, f"retrieval-builder-{builder}.png", sheet(rows))
    if every := store.retrieval(pool="counterfactual"):
        rows = [look.absence(q) for q in _some(every, 2 * examples, seed, "counterfactual")]
        title = f"the scene as it was, and without an object ({len(every):,} queries)"
        yield Sheet("Retrieval: counterfactual", title, "counterfactual.png", sheet(rows))
    if every := store.selection(suite=MATCHED_ANCHOR):
        pairs = [every[k : k + 2] for k in range(0, len(every), 2)]
        rows = [look.item(i) for pair in _some(pairs, examples, seed, MATCHED_ANCHOR) for i in pair]
        title = f"pairs that differ in their anchor alone ({len(pairs):,} pairs)"
        yield Sheet("Controls", title, f"controls-{MATCHED_ANCHOR}.png", sheet(rows))
    names = [name for split in SPLITS for name in store.scene_ids(split)]
    scenes = [store.scene(name) for name in _some(names, 2 * examples, seed, "paths")]
    # Another simulator's camera stands elsewhere, and so does a stand-in's.
    if all(scene.footage is None for scene in scenes) and store.suite == "dynapix":
        title = (
            "from hollow (start) to full (end), a dot a second, a cross and its frame a collision"
        )
        yield Sheet("Paths over the floor", title, "paths.png", paths(scenes))


def _grouped(every: Iterable[Any], key: str = "subtype") -> dict[Any, list[Any]]:
    found = defaultdict(list)
    for asked in every:
        found[getattr(asked, key)].append(asked)
    return found


def _some(every: Sequence[Any], count: int, seed: int, name: str) -> list[Any]:
    chosen = named_rng(seed, "gallery", name).permutation(len(every))[:count]
    return [every[k] for k in sorted(chosen)]


class Looker:
    """Makes a row of a sheet from an item or a query of a store."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._frames = FrameReader(store)

    def item(self, item: SelectionItem) -> Row:
        """A selection item: its prefix and its candidates, the answer marked."""
        told = {name: getattr(item, name) for name in AXES}
        axes = [AXES[name].format(value) for name, value in told.items() if value is not None]
        return Row(
            item.item_id,
            ", ".join([item.split, *axes, f"least displacement {item.min_displacement:.0f} px"]),
            item.question,
            self._observed(item),
            [self._candidate(item, k) for k in range(len(item.candidates))],
        )

    def query(self, query: RetrievalQuery) -> Row:
        """A future-state query: its prefix, its target and its hard negatives."""
        return Row(
            query.query_id,
            f"{query.split}, anchor {query.anchor}",
            query.question,
            self._observed(query),
            [
                self._cell(query.target, "target", _told(query, query.target), right=True),
                *(self._negative(query, frame) for frame in query.hard_negatives),
            ],
        )

    def absence(self, query: RetrievalQuery) -> Row:
        """A counterfactual query: the scene as it was beside the scene without the object, at the
        target's moment. A ring follows the object that is absent."""
        scene, absent = (self._store.scene(i) for i in (query.scene_id, query.target.scene_id))
        removed = [look.phrase for look in scene.objects].index(query.removed_object)
        factual, *others = query.hard_negatives
        shift = removal_displacement(scene, absent, removed)[query.target.frame]
        moment = _told(query, query.target)
        return Row(
            query.query_id,
            f"{query.split}, without the {query.removed_object}",
            query.question,
            self._observed(query, removed),
            [
                self._cell(
                    factual, "as it was", f"others up to {shift:.0f} px off", ringed=removed
                ),
                self._cell(query.target, "target: without it", moment, right=True),
                *(self._negative(query, frame) for frame in others),
            ],
        )

    def _observed(
        self, asked: SelectionItem | RetrievalQuery, ringed: int | None = None
    ) -> list[Cell]:
        shown = sample_prefix_frames(asked.prefix_start, asked.prefix_stop, OBSERVED)
        refs = [FrameRef(asked.scene_id, frame) for frame in shown]
        return [self._cell(ref, f"frame {ref.frame}", ringed=ringed) for ref in refs]

    def _candidate(self, item: SelectionItem, position: int) -> Cell:
        candidate = item.candidates[position]
        away = {
            LETTERS[k]: self._apart(candidate, other)
            for k, other in enumerate(item.candidates)
            if k != position
        }
        nearest = min(away, key=away.get)
        told = f"{_told(item, candidate)}, {away[nearest]:.0f} px from {nearest}"
        return self._cell(
            candidate,
            candidate.source,
            told,
            right=position == item.answer,
            letter=LETTERS[position],
        )

    def _negative(self, query: RetrievalQuery, frame: FrameRef) -> Cell:
        away = f"{self._apart(query.target, frame):.0f} px off"
        return self._cell(frame, "wrong time", f"{_told(query, frame)}, {away}")

    def _cell(
        self,
        frame: FrameRef,
        *caption: str,
        right: bool = False,
        letter: str = "",
        ringed: int | None = None,
    ) -> Cell:
        ring = None
        if ringed is not None:
            scene = self._store.scene(frame.scene_id)
            x, y = scene.image_positions[frame.frame, ringed] / scene.image_size
            ring = (float(x), float(y))
        image = self._frames.image(frame.scene_id, frame.frame)
        return Cell(image, caption, letter, right, ring)

    def _apart(self, one: FrameRef, two: FrameRef) -> float:
        """How far two frames are apart, px at 336 x 336."""
        here, there = self._store.scene(one.scene_id), self._store.scene(two.scene_id)
        return cross_scene_displacement(here, one.frame, there, two.frame)


def _told(asked: SelectionItem | RetrievalQuery, frame: FrameRef) -> str:
    """A frame's index, and how long after the prefix it is. A counterfactual scene keeps time with
    its own; another scene has no such time."""
    same = frame.scene_id.partition("-without-")[0] == asked.scene_id
    ahead = f" ({frame.frame - asked.prefix_stop:+d})" if same else ""
    return f"frame {frame.frame}{ahead}"


PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>DynaPix, {name}</title>
<style>
  body {{ font: 16px/1.5 system-ui, sans-serif; color: #222; background: #f4f4f4; margin: 0;
         display: grid; grid-template-columns: 210px minmax(0, 1fr); }}
  nav {{ position: sticky; top: 0; height: 100vh; box-sizing: border-box; overflow: auto;
        padding: 20px 16px; font-size: 14px; background: #fff; border-right: 1px solid #ddd; }}
  nav a {{ display: block; color: #0b57d0; text-decoration: none; }}
  nav b {{ display: block; margin-top: 14px; }}
  main {{ max-width: 1940px; padding: 0 24px 48px; }}
  h2 {{ margin: 48px 0 0; }}
  h3 {{ margin: 24px 0 8px; font-weight: 600; }}
  img {{ max-width: 100%; border: 1px solid #ddd; background: #fff; }}
</style>
<nav>{nav}</nav>
<main>
<h1>DynaPix, {name}</h1>
<p>{scenes:,} scenes, store {identity}. Left of the line is what is observed, right of it what there
is to choose from; the answer is framed in green. A number in brackets counts frames from the end of
what is observed ({fps:g} a second), px are displacements at 336 x 336.</p>
{body}
</main>
</html>
"""


def page(store: Store, shown: Sequence[tuple[str, str, str]]) -> str:
    """The page of the sheets that lie beside it, each given by section, title and file."""
    nav, body = [], []
    for section, of in groupby(shown, key=lambda told: told[0]):
        nav.append(f"<b>{escape(section)}</b>")
        body.append(f"<h2>{escape(section)}</h2>")
        for _, title, file in of:
            name = Path(file).stem
            nav.append(f'<a href="#{name}">{escape(name.partition("-")[2] or name)}</a>')
            body.append(f'<h3 id="{name}">{escape(title)}</h3>')
            image = f'<img src="{file}" alt="{escape(title)}" loading="lazy">'
            body.append(f'<a href="{file}">{image}</a>')
    return PAGE.format(
        name=escape(store.name),
        identity=store.identity,
        fps=store.scene(store.scene_ids("test")[0]).fps,
        scenes=sum(len(store.scene_ids(split)) for split in SPLITS),
        nav="\n".join(nav),
        body="\n".join(body),
    )


if __name__ == "__main__":
    main()
