"""The items that the page shows: their choice, their frames, and the models' responses."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from conf.errors import UserError
from data.records import FAMILIES, LETTERS, FrameRef, SelectionItem, sample_prefix_frames
from data.render.frame_cache import FrameReader
from data.store import Store, open_store
from data.tracks.controls import MATCHED_ANCHOR
from data.tracks.quota import interleave
from evaluation.metrics.significance import PairedComparison, check_same_items
from evaluation.reporting.comparisons import compare_models
from evaluation.reporting.figures import count_confusions
from evaluation.reporting.measurements import Measurement, deduplicate
from evaluation.reporting.run_responses import ItemResponse, Responses, read_responses

PREFIX_FRAMES = 6
FRAME_WIDTH = 160
"""Pixels."""
WEBP_QUALITY = 70
TEXT_LIMIT = 4000
"""Characters of a response."""


@dataclass
class ItemBrowser:
    """The items of the page, and what was computed from the responses to all items.

    Attributes:
        entries: The items, as the page's script reads them.
        frames: Data URLs of their frames by name.
        notes: Sentences on the shown and the missing items of each benchmark.
        confusions: Counts of `count_confusions`, by item set and model.
        comparisons: Paired comparisons by benchmark.
    """

    entries: list[dict[str, Any]] = field(default_factory=list)
    frames: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    confusions: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    comparisons: dict[str, list[list[PairedComparison]]] = field(default_factory=dict)


def browse_items(
    selections: Sequence[Measurement], stores: Path, limit: int, seed: int
) -> ItemBrowser:
    """At most `limit` items of each benchmark with responses.

    Raises:
        UserError: two runs measured different items of one benchmark.
    """
    runs = {m.run.folder: m.run for m in selections}
    by_run = {folder: read_responses(run) for folder, run in runs.items()}
    first: dict[str, tuple[str, Responses]] = {}
    for m in selections:
        own = (str(m.run.folder), by_run[m.run.folder].get(m.row.key, {}))
        (other_folder, others), (folder, responses) = first.setdefault(m.items, own), own
        check_same_items(others, responses, (other_folder, folder))
    browser, kept = ItemBrowser(), deduplicate(selections)
    for name in dict.fromkeys(m.row.benchmark for m in kept):
        answered = [
            (m, by_run[m.run.folder].get(m.row.key, {})) for m in kept if m.row.benchmark == name
        ]
        try:
            store = open_store(stores / name)
        except UserError as error:
            browser.notes.append(f"The items of {name} cannot be shown: {error} benchmark={name}.")
            continue
        if any(m.run.report["build"] != store.identity for m, _ in answered):
            # Its items can differ although their ids agree.
            browser.notes.append(
                f"The items of {name} cannot be shown: {store.folder} was rebuilt since the runs."
            )
            continue
        _add_benchmark(browser, store, answered, limit, seed)
    return browser


def _add_benchmark(
    browser: ItemBrowser,
    store: Store,
    answered: Sequence[tuple[Measurement, Responses]],
    limit: int,
    seed: int,
) -> None:
    items = {
        i.item_id: i for suite in (None, MATCHED_ANCHOR) for i in store.selection("test", suite)
    }
    by_label: dict[str, Responses] = {}
    for m, responses in answered:
        label = ", ".join([m.label, *m.variants])
        by_label[label] = {k: r for k, r in responses.items() if k in items}
        pairs = [(items[k].letter, r.letter) for k, r in by_label[label].items()]
        browser.confusions.setdefault(m.items, {})[label] = count_confusions(pairs)
    # Controls are compared by the run that measured them.
    unchanged = {m.label: (m, by_label[m.label]) for m, _ in answered if not m.variants}
    browser.comparisons[store.name] = compare_models(unchanged, items, seed)
    known = [i for k, i in items.items() if any(k in r for r in by_label.values())]
    shown = choose_items(known, by_label, limit, seed)
    browser.entries += page_entries(shown, by_label, store)
    frames, errors = encode_frames(shown, store)
    browser.frames |= frames
    browser.notes.append(
        f"{store.name}: {len(shown):,} of {len(known):,} answered items, spread over subtypes and "
        "over correct and wrong answers; items=N shows another number."
    )
    if errors:
        more = f" ({len(errors) - 1:,} more scenes)" if errors[1:] else ""
        browser.notes.append(f"Frames are missing: {errors[0]}{more}.")


def choose_items(
    items: Sequence[SelectionItem], responses: Mapping[str, Responses], limit: int, seed: int
) -> list[SelectionItem]:
    """At most `limit` random items with equally many of each subtype, and in a subtype of each
    combination of correct and wrong answers; by family and subtype."""

    def subtype(item: SelectionItem) -> tuple[int, str]:
        return FAMILIES.index(item.family), item.subtype

    def verdicts(item: SelectionItem) -> tuple:
        of_item = [r.get(item.item_id) for r in responses.values()]
        return *subtype(item), *(r and r.letter == item.letter for r in of_item)

    order = np.random.default_rng(seed).permutation(len(items))
    spread = interleave([items[k] for k in order], verdicts)
    return sorted(interleave(spread, subtype)[:limit], key=subtype)


def page_entries(
    items: Sequence[SelectionItem], responses: Mapping[str, Responses], store: Store
) -> Iterator[dict[str, Any]]:
    """The page's data of each item; frames by the names of `encode_frames`."""
    for item in items:
        yield {
            "id": item.item_id,
            "benchmark": store.name,
            "family": item.family,
            "subtype": item.subtype,
            "question": item.question,
            "prefix": [_frame_name(store, frame) for frame in _prefix(item)],
            "observed": f"frames {item.prefix_start} to {item.prefix_stop} of {item.scene_id}",
            "candidates": [
                {
                    "letter": letter,
                    "frame": _frame_name(store, c),
                    "caption": f"{c.source.replace('_', ' ')}: frame {c.frame}"
                    + (f" of {c.scene_id}" if c.scene_id != item.scene_id else ""),
                }
                for letter, c in zip(LETTERS, item.candidates, strict=True)
            ],
            "answer": item.letter,
            "truth": describe_truth(item, store),
            "responses": [
                _response_entry(label, r[item.item_id], item)
                for label, r in responses.items()
                if item.item_id in r
            ],
        }


def describe_truth(item: SelectionItem, store: Store) -> list[str]:
    """The oracle's facts on an item, in sentences."""
    scene = store.scene(item.scene_id)
    sentences = [
        f"{item.letter} is correct: frame {item.target_frame}, "
        f"{item.target_frame - item.prefix_stop} frames after the prefix. Any two candidates "
        f"differ by {item.min_displacement:.0f} px or more."
    ]
    for collision in scene.collisions:
        if item.prefix_stop < collision.frame <= item.target_frame:
            one, other = (scene.objects[k].noun_phrase for k in collision.objects)
            sentences.append(f"The {one} and the {other} collide at frame {collision.frame}.")
    return sentences


def _response_entry(label: str, response: ItemResponse, item: SelectionItem) -> dict[str, Any]:
    text, letter = response.text, response.letter
    if len(text) > TEXT_LIMIT:
        text = (
            f"{text[:TEXT_LIMIT]}… (the first {TEXT_LIMIT:,} of {len(text):,} characters; the "
            "run's answers.jsonl has all of them)"
        )
    verdict = "correct" if letter == item.letter else "wrong" if letter else "unparsed"
    return {
        "model": label, "letter": letter, "verdict": verdict, "reason": response.reason,
        "text": text, "truncated": response.truncated,
    }  # fmt: skip


def _prefix(item: SelectionItem) -> list[FrameRef]:
    frames = sample_prefix_frames(item.prefix_start, item.prefix_stop, PREFIX_FRAMES)
    return [FrameRef(item.scene_id, frame) for frame in frames]


def _frame_name(store: Store, frame: FrameRef) -> str:
    return f"{store.name}/{frame.scene_id}/{frame.frame}"


def encode_frames(items: Sequence[SelectionItem], store: Store) -> tuple[dict[str, str], list[str]]:
    """The frames of the items as WebP data URLs by name, and a sentence for each scene whose frames
    cannot be read."""
    wanted: dict[str, set[int]] = {}
    for item in items:
        for frame in (*_prefix(item), *item.candidates):
            wanted.setdefault(frame.scene_id, set()).add(frame.frame)
    reader, frames, errors = FrameReader(store), {}, []
    for scene_id, indices in tqdm(wanted.items(), desc=f"frames of {store.name}", unit="scene"):
        ordered = sorted(indices)
        try:
            stack = reader.stack(scene_id, ordered)
        except (UserError, OSError) as error:
            errors.append(str(error))
            continue
        for index, pixels in zip(ordered, stack, strict=True):
            frames[_frame_name(store, FrameRef(scene_id, index))] = encode_webp(pixels)
    return frames, errors


def encode_webp(pixels: np.ndarray) -> str:
    """(height, width, 3) uint8 as the data URL of an image of `FRAME_WIDTH` pixels."""
    from PIL import Image

    height, width = pixels.shape[:2]
    size = (FRAME_WIDTH, round(height * FRAME_WIDTH / width))
    buffer = io.BytesIO()
    image = Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS)
    image.save(buffer, "WEBP", quality=WEBP_QUALITY, method=6)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
