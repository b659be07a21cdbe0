"""Statistics of a benchmark's scenes and selection items, and the accuracy of baselines."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from data.checks import shortcuts
from data.checks.baselines import BASELINES, score_baselines, score_scene_alone
from data.items.scores import item_scores
from data.oracle.displacement import cross_scene_displacement
from data.records import FAMILIES, LETTERS, SPLITS, SelectionItem
from data.store import Store

LOGISTIC = "logistic model of all scores"


def compute_statistics(store: Store, blind: bool = False) -> dict[str, Any]:
    """Return the statistics of a store that has selection items.

    Args:
        blind: Whether to train blind models too.

    Returns:
        ``scenes``: distributions of objects, collisions and event frames. ``answers``: items by
        letter. ``cells``: items and quotas by family, window group and subtype. ``candidates``:
        median displacements, and items by number of distractors earlier than the target, by
        category. ``baselines``: accuracies by category. ``retrieval``: measures of a ranker that
        only recognises the scene, on the standard test. ``shortcuts``: accuracies of the strategies
        of `data.checks.shortcuts` on the test split, by category. ``shortfalls``: cells with fewer
        records than their quotas. A category is a family, a kind of distractors in the event
        family, or a difficulty in the window family.
    """
    items, queries = store.selection(), store.standard_test()
    progress = tqdm(items, desc="describing items", unit="item")
    rows = pd.DataFrame([_describe_item(item, store) for item in progress])
    categories = rows.explode("category").groupby("category")
    earlier = pd.crosstab(categories.obj["category"], categories.obj["earlier"])
    candidates = categories[["nearest distractor", "least"]].median()
    for count in range(4):
        candidates[f"{count} earlier"] = earlier.get(count, pd.Series(dtype=int))
    baselines = categories[list(BASELINES)].mean()
    baselines["items"] = categories.size()
    return {
        "scenes": describe_scenes(store),
        "answers": rows["letter"].value_counts().reindex(list(LETTERS), fill_value=0).to_dict(),
        "cells": count_cells(items, store.manifest["config"]["selection"]),
        "candidates": candidates.fillna(0).to_dict("index"),
        "baselines": _without_nan(baselines),
        "retrieval": score_scene_alone(queries, store.database()) if queries else {},
        "shortcuts": _without_nan(measure_shortcuts(items, store, blind)),
        "shortfalls": store.manifest["shortfalls"],
    }


def measure_shortcuts(items: list[SelectionItem], store: Store, blind: bool) -> pd.DataFrame:
    """Return the accuracy of each shortcut on the items of the test split, by category."""
    blind_right = {}
    if blind:
        from data.checks.blind_models import score_blind_models

        blind_right = score_blind_models(items, store, store.manifest["seed"])
    progress = tqdm(items, desc="scoring shortcuts", unit="item")
    config = store.manifest["config"]
    scores = np.stack([item_scores(item, store.scene, config) for item in progress])
    answers = np.array([item.answer for item in items])
    right = pd.DataFrame(
        shortcuts.score_simple_strategies(scores, answers), columns=list(shortcuts.SIMPLE)
    )
    right[LOGISTIC] = shortcuts.score_logistic_model(items, scores, answers)
    for name, values in blind_right.items():
        right[name] = values
    right["category"] = [list(_categories(item)) for item in items]
    test = right[[item.split == "test" for item in items]]
    categories = test.explode("category").groupby("category")
    names = [name for name in right if name != "category"]
    return categories[names].mean().assign(items=categories.size())


def _without_nan(table: pd.DataFrame) -> dict[str, dict[str, Any]]:
    return table.astype(object).where(table.notna(), None).to_dict("index")


def describe_scenes(store: Store) -> dict[str, Any]:
    """Count scenes by their numbers of objects and collisions; find quartiles of event frames."""
    scenes = [store.scene(name) for split in SPLITS for name in store.scene_ids(split)]
    counts = pd.DataFrame({s.scene_id: (len(s.objects), len(s.collisions)) for s in scenes}).T
    frames = [c.frame for scene in scenes for c in scene.collisions]
    objects, collisions = (counts[k].value_counts().sort_index().to_dict() for k in (0, 1))
    return {
        "objects": {str(n): scenes for n, scenes in objects.items()},
        "collisions": {str(n): scenes for n, scenes in collisions.items()},
        "mean collisions": len(frames) / len(scenes),
        "event frames": np.percentile(frames, [0, 25, 50, 75, 100]).tolist() if frames else [],
    }


def count_cells(
    items: list[SelectionItem], quotas: dict[str, dict[str, dict[str, int]]]
) -> dict[str, dict[str, int]]:
    """Return the items and the quotas of each split, for each family, window group and subtype."""
    counts = [(item.family, item.subtype, item.split, 1) for item in items]
    counts += [
        (family, subtype, f"{split} quota", quotas[family][subtype][split])
        for family in FAMILIES
        for subtype in quotas[family]
        for split in SPLITS
    ]
    rows = pd.DataFrame(counts, columns=["family", "subtype", "column", "count"])
    group = rows["subtype"].str.partition("_")[0].where(rows["family"] == "window")
    names = rows["family"], rows["family"] + "/" + rows["subtype"], rows["family"] + "/" + group
    cells = pd.concat([rows.assign(cell=name) for name in names])
    table = cells.pivot_table("count", "cell", "column", aggfunc="sum", fill_value=0)
    columns = [*SPLITS, *(f"{split} quota" for split in SPLITS)]
    return table.reindex(columns=columns, fill_value=0).to_dict("index")


def _describe_item(item: SelectionItem, store: Store) -> dict[str, Any]:
    frames = [(store.scene(c.scene_id), c.frame) for c in item.candidates]
    target = frames.pop(item.answer)
    same_scene = all(scene is target[0] for scene, _ in frames)
    return {
        "category": list(_categories(item)),
        "letter": item.letter,
        "least": item.min_displacement,
        "nearest distractor": min(cross_scene_displacement(*target, *frame) for frame in frames),
        "earlier": sum(frame < item.target_frame for _, frame in frames) if same_scene else None,
        **score_baselines(item, store),
    }


def _categories(item: SelectionItem) -> Iterator[str]:
    yield item.family
    if item.family == "event":
        yield f"event, {item.distractors}"
    if item.difficulty is not None:
        yield f"window, {item.difficulty}"


def format_statistics(statistics: dict[str, Any]) -> str:
    """Format the statistics as text tables whose lines have at most 100 characters."""
    scenes = statistics["scenes"]
    candidates = pd.DataFrame(statistics["candidates"]).T.round().astype(int)
    baselines = pd.DataFrame(statistics["baselines"]).T.astype(float)
    baselines[list(BASELINES)] *= 100
    cells = pd.DataFrame(statistics["cells"]).T
    sections = [
        f"Objects per scene:    {_join(scenes['objects'])}\n"
        f"Collisions per scene: {_join(scenes['collisions'])} "
        f"(mean {scenes['mean collisions']:.2f})\n"
        f"Event frames:         {' '.join(f'{q:g}' for q in scenes['event frames'])} "
        "(minimum, quartiles, maximum)\n"
        f"Answers:              {_join(statistics['answers'])}",
        "Accuracy of baselines, %; only velocity predicts, from the moment and true velocities\n"
        + baselines.astype({"items": int}).to_string(float_format="{:.1f}".format, na_rep="-"),
        "Accuracy of shortcuts on the test split, %\n" + format_shortcuts(statistics["shortcuts"]),
        "Candidates: median displacement in px from the target to the nearest distractor and\n"
        "between any two candidates; items by number of distractors earlier than the target\n"
        + candidates.to_string(),
        "Items and quotas\n" + cells.to_string(),
    ]
    if retrieval := statistics["retrieval"]:
        measures = "  ".join(f"{name} {value:.3g}" for name, value in retrieval.items())
        sections.append(f"Standard test, a ranker that only recognises the scene\n{measures}")
    if shortfalls := statistics["shortfalls"]:
        sections.append(
            "Short of their quotas\n" + "\n".join(f"{k}: {n}" for k, n in shortfalls.items())
        )
    return "\n\n".join(sections)


def format_shortcuts(shortcuts: dict[str, dict[str, Any]]) -> str:
    """Format accuracies as a table with a row for each strategy, and a column for each family and
    each difficulty."""
    columns = [name for name in shortcuts if not name.startswith("event, ")]
    table = pd.DataFrame(shortcuts)[columns].astype(float)
    table.loc[table.index != "items"] *= 100
    return table.to_string(float_format="{:.1f}".format, na_rep="-")


def _join(counts: dict[str, int]) -> str:
    return ", ".join(f"{name}: {count:,}" for name, count in counts.items())
