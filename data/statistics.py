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
from data.geometry import DIAGONAL, MODEL_SIZE, Camera, displacement_across
from data.records import FPS, LETTERS, SPLITS, Candidate, SelectionItem
from data.store import Store

log = logging.getLogger(__name__)


@command("data.statistics", StatisticsCommand)
def main(cfg: StatisticsCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    items = store.selection()
    if not items:
        raise UserError(f"{store.folder} has no items of the selection track to describe")
    found = {
        "scenes": scene_statistics(store),
        "items": item_statistics(items),
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


def item_statistics(items: list[SelectionItem]) -> dict[str, Any]:
    """Answer letters, and the median least displacement (px at 336) by family and difficulty."""
    letters = Counter(i.letter for i in items)
    least = defaultdict(list)
    for item in items:
        for group in _groups(item):
            least[group].append(item.min_displacement)
    return {
        "answers": {letter: letters[letter] for letter in LETTERS},
        "median least displacement": {g: float(np.median(v)) for g, v in sorted(least.items())},
    }


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
    return displacement_across(scene, item.prefix_stop, other, candidate.frame)


def farthest(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """The contrary: what moved most since the last observed frame."""
    return -nearest(item, candidate, store)


def first_position(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """Always the first letter."""
    return float(item.candidates.index(candidate))


def constant_velocity(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """How far a candidate is from where the last observed velocities lead by the target's moment:
    the mean over objects in px at 336, one that is in only one of the scenes as far as can be. It
    is told the moment, which a question of the event family does not tell."""
    scene, other = store.scene(item.scene_id), store.scene(candidate.scene_id)
    seconds = (item.target_frame - item.prefix_stop) / FPS
    places = scene.positions[item.prefix_stop] + seconds * scene.velocities[item.prefix_stop]
    expected, _ = Camera().project(places)
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
    "constant velocity": constant_velocity,
}
"""Each chooses the candidate of the least cost."""


def table(found: dict[str, Any]) -> str:
    """The statistics as text."""
    scenes, items = found["scenes"], found["items"]
    lines = [
        f"objects a scene      {_tally(scenes['objects a scene'])}",
        f"collisions a scene   {_tally(scenes['collisions a scene'])}, "
        f"{scenes['mean collisions']:.2f} on average",
        "event frames         "
        + " ".join(f"{q:g}" for q in scenes["event frames, quartiles"])
        + " (least, quartiles, greatest)",
        f"answers              {_tally(items['answers'])}",
        "",
        f"{'Strategy accuracy, %':<28}" + "".join(f"{name:>19}" for name in STRATEGIES)
        + f"{'items':>8}{'least px':>10}",
    ]  # fmt: skip
    for group, row in found["strategies"].items():
        shares = "".join(f"{100 * row[name]:>19.1f}" for name in STRATEGIES)
        least = items["median least displacement"][group]
        lines.append(f"{group:<28}{shares}{row['items']:>8,}{least:>10.0f}")
    return "\n".join(lines)


def _tally(counts: dict[str, int]) -> str:
    return ", ".join(f"{name}: {count:,}" for name, count in counts.items())


if __name__ == "__main__":
    main()
