"""What a built benchmark is made of, and how far strategies get on it that foresee nothing.

A strategy that does well without foresight shows a shortcut in the construction.
"""

from __future__ import annotations

import json
import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import write_text
from conf.schema import StatisticsCommand
from data.records import LETTERS, SPLITS, Candidate, SelectionItem
from data.store import Store
from data.world.displacement import DIAGONAL, MODEL_SIZE, cross_scene_displacement
from data.world.standins import standin_view

log = logging.getLogger(__name__)
PAPER = {
    "event": (1151, 249),
    "event/future_cross_gap10": (165, 35),
    "event/future_offset_gap10": (163, 35),
    "event/future_match_gap10": (165, 35),
    "event/future_match_gap5": (162, 38),
    "event/contact_cross": (165, 35),
    "event/contact_offset": (166, 36),
    "event/contact_match": (165, 35),
    "time": (1619, 374),
    "time/in_1s": (555, 111),
    "time/in_2s": (1064, 263),
    "window": (6598, 1585),
    "window/G1": (1967, 412),
    "window/G2": (2300, 680),
    "window/G3": (1578, 324),
    "window/G4": (753, 169),
}
"""The paper's counts of items, train and test (paper, Tables of the subtypes)."""


@command("data.statistics", StatisticsCommand)
def main(cfg: StatisticsCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    items = store.selection()
    if not items:
        raise UserError(f"{store.folder} has no items of the selection track to describe")
    found = {
        "scenes": scene_statistics(store),
        "cells": cell_counts(items),
        "items": item_statistics(items, store),
        "strategies": strategy_accuracy(items, store),
    }
    text = table(found)
    log.info("%s", text)
    write_text(run.folder / "report.txt", text + "\n")
    write_text(run.folder / "report.json", json.dumps(found, indent=1))
    return {
        f"{name}_{group}": value
        for group, row in found["strategies"].items()
        for name, value in row.items()
        if name != "items"
    }


def scene_statistics(store: Store) -> dict[str, Any]:
    """Objects and collisions a scene, as counts of scenes, and quartiles of the events' frames."""
    scenes = [store.scene(name) for split in SPLITS for name in store.scene_ids(split)]
    frames = [c.frame for scene in scenes for c in scene.collisions]
    collisions = Counter(len(scene.collisions) for scene in scenes)
    objects = Counter(len(scene.objects) for scene in scenes)
    return {
        "objects a scene": {str(k): objects[k] for k in sorted(objects)},
        "collisions a scene": {str(k): collisions[k] for k in sorted(collisions)},
        "mean collisions": len(frames) / len(scenes),
        "event frames, quartiles": np.percentile(frames, [0, 25, 50, 75, 100]).tolist(),
    }


def cell_counts(items: list[SelectionItem]) -> dict[str, dict[str, int]]:
    """Items by split of every subtype and family, and of every group of the window family."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for item in items:
        names = [f"{item.family}/{item.subtype}", item.family]
        if item.group is not None:
            names.append(f"window/{item.group}")
        for name in names:
            counts[name][item.split] += 1
    return {name: {split: counts[name][split] for split in SPLITS} for name in sorted(counts)}


def item_statistics(items: list[SelectionItem], store: Store) -> dict[str, Any]:
    """Answer letters, the target's place in time among the candidates of its scene, and by family
    and difficulty the median displacements (px at 336) from the target to its nearest distractor
    and between any two candidates."""
    letters = Counter(i.letter for i in items)
    places: dict[str, Counter[int]] = defaultdict(Counter)
    nearest_wrong, least = defaultdict(list), defaultdict(list)
    for item in items:
        apart = between(item, store)
        for group in _groups(item):
            nearest_wrong[group].append(np.delete(apart[item.answer], item.answer).min())
            least[group].append(item.min_displacement)
            if {c.scene_id for c in item.candidates} == {item.scene_id}:
                early = sum(c.frame < item.target_frame for c in item.candidates)
                places[group][early] += 1
    return {
        "answers": {letter: letters[letter] for letter in LETTERS},
        "target's place in time": {g: [n[k] for k in range(4)] for g, n in sorted(places.items())},
        "median to the nearest distractor": _medians(nearest_wrong),
        "median least displacement": _medians(least),
    }


def _medians(values: dict[str, list[float]]) -> dict[str, float]:
    return {group: float(np.median(of)) for group, of in sorted(values.items())}


def between(item: SelectionItem, store: Store) -> np.ndarray:
    """(4, 4) displacements between an item's candidates, px at 336 x 336."""
    shown = [(store.scene(c.scene_id), c.frame) for c in item.candidates]
    return np.array([[cross_scene_displacement(*one, *two) for two in shown] for one in shown])


def strategy_accuracy(items: list[SelectionItem], store: Store) -> dict[str, dict[str, float]]:
    """Accuracy of each strategy by family, difficulty and source of the distractors; a tie among m
    candidates counts 1/m."""
    credits: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for item in items:
        for name, cost in STRATEGIES.items():
            costs = np.array([cost(item, c, store) for c in item.candidates])
            best = np.flatnonzero(costs == costs.min())
            credit = (item.answer in best) / len(best)
            for group in _groups(item):
                credits[group][name].append(credit)
    return {
        group: {
            **{name: float(np.mean(values)) for name, values in rows.items()},
            "items": len(next(iter(rows.values()))),
        }
        for group, rows in sorted(credits.items())
    }


def _groups(item: SelectionItem) -> Iterable[str]:
    yield item.family
    if item.family == "event":
        yield f"event, {item.distractors}"
    if item.difficulty is not None:
        yield f"window, {item.difficulty}"


def nearest(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """How far a candidate is from the last observed frame: what stays as it was."""
    scene, other = store.scene(item.scene_id), store.scene(candidate.scene_id)
    return cross_scene_displacement(scene, item.prefix_stop, other, candidate.frame)


def farthest(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """The contrary: what moved most since the last observed frame."""
    return -nearest(item, candidate, store)


def first_position(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """Always the first letter."""
    return float(item.candidates.index(candidate))


def odd(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """The candidate least like the others. It looks at no prefix."""
    return -typical(item, candidate, store)


def typical(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """The candidate most like the others. It looks at no prefix."""
    scene = store.scene(candidate.scene_id)
    return sum(
        cross_scene_displacement(scene, candidate.frame, store.scene(c.scene_id), c.frame)
        for c in item.candidates
    )


def constant_velocity(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """How far a candidate is from where the last observed velocities lead by the target's moment:
    the mean over objects in px at 336, one that is in only one of the scenes as far as can be. It
    is told the moment, which a question of the event family does not tell."""
    scene, other = store.scene(item.scene_id), store.scene(candidate.scene_id)
    seconds = (item.target_frame - item.prefix_stop) / scene.fps
    places = scene.positions[item.prefix_stop] + seconds * scene.velocities[item.prefix_stop]
    expected, _ = standin_view(store.manifest["config"].get("standin")).camera.project(places)
    there = {o: other.image_positions[candidate.frame, k] for k, o in enumerate(other.objects)}
    scale = MODEL_SIZE / np.array(scene.image_size)
    apart = [
        min(float(np.linalg.norm((expected[k] - there[o]) * scale)), DIAGONAL)
        if o in there
        else DIAGONAL
        for k, o in enumerate(scene.objects)
    ]
    return float(np.mean(apart))


Cost = Callable[[SelectionItem, Candidate, Store], float]
STRATEGIES: dict[str, Cost] = {
    "nearest": nearest,
    "farthest": farthest,
    "first": first_position,
    "odd": odd,
    "typical": typical,
    "velocity": constant_velocity,
}
"""Each chooses the candidate of the least cost."""


def table(found: dict[str, Any]) -> str:
    """The statistics as text, at most 100 columns wide."""
    scenes, items, strategies = found["scenes"], found["items"], found["strategies"]
    lines = [
        f"objects a scene      {_tally(scenes['objects a scene'])}",
        f"collisions a scene   {_tally(scenes['collisions a scene'])}, "
        f"{scenes['mean collisions']:.2f} on average",
        "event frames         "
        + " ".join(f"{q:g}" for q in scenes["event frames, quartiles"])
        + " (least, quartiles, greatest)",
        f"answers              {_tally(items['answers'])}",
        "",
        f"{'Strategy accuracy, %':<24}" + "".join(f"{name:>10}" for name in STRATEGIES)
        + f"{'items':>8}",
    ]  # fmt: skip
    for group, row in strategies.items():
        shares = "".join(f"{100 * row[name]:>10.1f}" for name in STRATEGIES)
        lines.append(f"{group:<24}{shares}{row['items']:>8,}")
    if margin := hard_margin(strategies):
        lines.append(
            f"The nearest frame is the target {100 * margin:.1f} points less often in hard window "
            "items than in easy ones."
        )
    head = f"{'Candidates, median px':<24}{'nearest':>10}{'least':>10}"
    lines += ["", f"{head}   distractors before the target, items with 0 1 2 3"]
    for group, far in items["median to the nearest distractor"].items():
        places = items["target's place in time"].get(group, [])
        least = items["median least displacement"][group]
        told = " ".join(f"{n:,}" for n in places)
        lines.append(f"{group:<24}{far:>10.0f}{least:>10.0f}   {told}")
    lines += ["", f"{'Items':<36}{'train':>8}{'test':>8}{'paper':>16}"]
    for name, counts in found["cells"].items():
        paper = " / ".join(f"{n:,}" for n in PAPER[name]) if name in PAPER else ""
        lines.append(f"{name:<36}{counts['train']:>8,}{counts['test']:>8,}{paper:>16}")
    return "\n".join(lines)


def hard_margin(strategies: dict[str, dict[str, float]]) -> float | None:
    """By how much the nearest frame is right more often in easy window items than in hard ones."""
    pair = [strategies.get(f"window, {difficulty}") for difficulty in ("easy", "hard")]
    return None if None in pair else pair[0]["nearest"] - pair[1]["nearest"]


def _tally(counts: dict[str, int]) -> str:
    return ", ".join(f"{name}: {count:,}" for name, count in counts.items())


if __name__ == "__main__":
    main()
