"""The page's browser of items: which are shown, what is told of each, and their frames."""

from __future__ import annotations

import base64
import io
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from conf.errors import UserError
from data.records import FAMILIES, LETTERS, FrameRef, SelectionItem, sample_prefix_frames
from data.render.frame_cache import FrameReader
from data.store import Store
from evaluation.reporting.run_responses import Said, Scored

OBSERVED = 6
"""Frames of a prefix that are shown."""
WIDTH = 160
"""Of a frame, px."""
QUALITY = 70
"""Of WebP, from 0 to 100."""
TEXT = 4000
"""Characters of an answer that are shown."""

Answers = Mapping[str, Mapping[str, Said | Scored]]
"""What each model said, by its label and by item."""


def spread(
    items: Sequence[SelectionItem], answers: Answers, bound: int, seed: int
) -> list[SelectionItem]:
    """At most `bound` items that show most: each one taken has the subtypes, and in them the right
    and the wrong answers of each model, that those before it show least of; by family and subtype.
    `seed` chooses among items that show as much."""
    order = np.random.default_rng(seed).permutation(len(items))
    waiting = {items[k].item_id: items[k] for k in order}
    cells = {name: _cells(item, answers) for name, item in waiting.items()}
    seen: Counter[tuple] = Counter()
    chosen = []
    while waiting and len(chosen) < bound:
        best = max(waiting, key=lambda name: sum(1 / (1 + seen[c]) for c in cells[name]))
        seen.update(cells[best])
        chosen.append(waiting.pop(best))
    return sorted(chosen, key=lambda item: (FAMILIES.index(item.family), item.subtype))


def _cells(item: SelectionItem, answers: Answers) -> list[tuple]:
    subtype = (item.family, item.subtype)
    given = {label: said.get(item.item_id) for label, said in answers.items()}
    return [(*subtype, label, s.choice.letter == item.letter) for label, s in given.items() if s]


def entries(
    items: Sequence[SelectionItem], answers: Answers, store: Store
) -> Iterator[dict[str, Any]]:
    """What the page tells of each item, frames by the names that `pictures` gives them."""
    for item in items:
        shown = sample_prefix_frames(item.prefix_start, item.prefix_stop, OBSERVED)
        yield {
            "id": item.item_id,
            "benchmark": store.name,
            "family": item.family,
            "subtype": item.subtype,
            "question": item.question,
            "prefix": [frame_name(store, FrameRef(item.scene_id, f)) for f in shown],
            "observed": f"frames {item.prefix_start} to {item.prefix_stop} of {item.scene_id}",
            "candidates": [
                {
                    "letter": letter,
                    "frame": frame_name(store, c),
                    "told": f"{c.source.replace('_', ' ')}: frame {c.frame}"
                    + (f" of {c.scene_id}" if c.scene_id != item.scene_id else ""),
                }
                for letter, c in zip(LETTERS, item.candidates, strict=True)
            ],
            "answer": item.letter,
            "truth": truth(item, store),
            "said": [
                _told(label, said[item.item_id], item)
                for label, said in answers.items()
                if item.item_id in said
            ],
        }


def truth(item: SelectionItem, store: Store) -> list[str]:
    """What the oracle has of an item, in sentences."""
    scene = store.scene(item.scene_id)
    after = item.target_frame - item.prefix_stop
    told = [
        f"{item.letter} is right: frame {item.target_frame}, {after} frames after the observation. "
        f"Any two candidates differ by {item.min_displacement:.0f} px or more."
    ]
    for collision in scene.collisions:
        if item.prefix_stop < collision.frame <= item.target_frame:
            one, other = (scene.objects[k].phrase for k in collision.objects)
            told.append(f"The {one} and the {other} collide at frame {collision.frame}.")
    return told


def _told(label: str, said: Said | Scored, item: SelectionItem) -> dict[str, Any]:
    choice = said.choice
    text = said.text
    if len(text) > TEXT:
        text = f"{text[:TEXT]}… (the first {TEXT:,} of {len(text):,} characters; the run's "
        text += "answers.jsonl has the others)"
    verdict = (
        "unread" if choice.letter is None else ["wrong", "right"][choice.letter == item.letter]
    )
    reason = str(choice.reason) if choice.letter is None and choice.reason else None
    return {
        "by": label, "letter": choice.letter, "verdict": verdict, "reason": reason, "text": text,
        "cut": said.cut,
    }  # fmt: skip


def frame_name(store: Store, frame: FrameRef) -> str:
    return f"{store.name}/{frame.scene_id}/{frame.frame}"


def pictures(items: Sequence[SelectionItem], store: Store) -> tuple[dict[str, str], list[str]]:
    """Every frame of the items once, as WebP data of `WIDTH` px; and of scenes whose frames are
    gone why, in a sentence each."""
    wanted: dict[str, set[int]] = {}
    for item in items:
        prefix = sample_prefix_frames(item.prefix_start, item.prefix_stop, OBSERVED)
        wanted.setdefault(item.scene_id, set()).update(prefix)
        for c in item.candidates:
            wanted.setdefault(c.scene_id, set()).add(c.frame)
    frames, found, gone = FrameReader(store), {}, []
    for scene_id, indices in tqdm(wanted.items(), desc=f"frames of {store.name}", unit="scene"):
        ordered = sorted(indices)
        try:
            stack = frames.stack(scene_id, ordered)
        except (UserError, OSError) as error:
            gone.append(str(error))
            continue
        for index, pixels in zip(ordered, stack, strict=True):
            found[frame_name(store, FrameRef(scene_id, index))] = webp(pixels)
    return found, gone


def webp(pixels: np.ndarray) -> str:
    """(height, width, 3) uint8 as a data address of an image of `WIDTH` px."""
    from PIL import Image

    height, width = pixels.shape[:2]
    size = (WIDTH, round(height * WIDTH / width))
    target = io.BytesIO()
    image = Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS)
    image.save(target, "WEBP", quality=QUALITY, method=6)
    return f"data:image/webp;base64,{base64.b64encode(target.getvalue()).decode()}"
