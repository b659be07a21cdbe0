"""Statistics of a benchmark's scenes and selection items, and the accuracy of baselines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from data.checks.baselines import score_scene_alone, score_velocity
from data.checks.shortcuts import (
    score_logistic_model,
    score_not_the_ghost,
    score_simple_strategies,
)
from data.items.scores import COLLISION_SCORES, SCORES, CandidateFrames, compare_item
from data.oracle.contacts import collisions_in
from data.records import CONTACT, LETTERS, SPLITS, SelectionItem
from data.store import Store

LOGISTIC, VELOCITY = "logistic model of all scores", "velocity"


def compute_statistics(store: Store, blind: bool = False) -> dict[str, Any]:
    """Return the statistics of a store that has selection items.

    Args:
        blind: Whether to train blind models too.

    Returns:
        ``scenes``: distributions of objects, collisions and event frames. ``answers``: items by
        letter. ``cells``: items by family, subtype and split. ``candidates``: median displacements,
        and items by number of distractors earlier than the target, by category. ``shortcuts``:
        accuracies on the test split of the strategies of `data.checks.shortcuts` and of the
        baseline `velocity`, by category. ``retrieval``: measures of a ranker that only recognises
        the scene, on the standard test. ``shortfalls``: cells with fewer records than their quotas.
        A category is a family, a kind of distractors in the event family, or a difficulty in the
        window family.
    """
    items, config = store.selection(), store.manifest["config"]
    queries = store.standard_test()
    cells = [f"{item.family}/{item.subtype}" for item in items]
    progress = tqdm(items, desc="comparing candidates", unit="item")
    compared = [compare_item(item, store.scene, config) for item in progress]
    rows = pd.DataFrame([_describe_item(*each) for each in zip(items, compared, strict=True)])
    categories = rows.explode("category").groupby("category")
    earlier = pd.crosstab(categories.obj["category"], categories.obj["earlier"])
    candidates = categories[["nearest distractor", "least"]].median()
    for count in range(4):
        candidates[f"{count} earlier"] = earlier.get(count, pd.Series(dtype=int))
    scores = np.stack([each.item_scores() for each in compared])
    shortcuts = measure_shortcuts(items, scores, store, blind)
    return {
        "scenes": describe_scenes(store),
        "answers": rows["letter"].value_counts().reindex(list(LETTERS), fill_value=0).to_dict(),
        "cells": pd.crosstab(cells, [item.split for item in items]).to_dict("index"),
        "candidates": candidates.fillna(0).to_dict("index"),
        "shortcuts": shortcuts.astype(object).where(shortcuts.notna(), None).to_dict("index"),
        "retrieval": score_scene_alone(queries, store.database()) if queries else {},
        "shortfalls": store.manifest["shortfalls"],
    }


def measure_shortcuts(
    items: list[SelectionItem], scores: np.ndarray, store: Store, blind: bool
) -> pd.DataFrame:
    """Return the accuracy of each shortcut on the items of the test split, by category, given the
    scores (N, S, 4) of the items' candidates."""
    answers = np.array([item.answer for item in items])
    is_contact = any(item.distractors == CONTACT for item in items)
    names = (*SCORES, *COLLISION_SCORES) if is_contact else SCORES
    right = pd.DataFrame(score_simple_strategies(names, scores, answers))
    if is_contact:
        right["not the ghost"] = score_not_the_ghost(items)
    right[LOGISTIC] = score_logistic_model(items, scores, answers)
    right[VELOCITY] = [score_velocity(item, store) for item in items]
    if blind:
        from data.checks.blind_models import score_blind_models

        right = right.assign(**score_blind_models(items, store, store.manifest["seed"]))
    names = list(right)
    right["category"] = [list(list_categories(item)) for item in items]
    test = right[[item.split == "test" for item in items]]
    categories = test.explode("category").groupby("category")
    return categories[names].mean().assign(items=categories.size())


def describe_scenes(store: Store) -> dict[str, Any]:
    """Count scenes by their numbers of objects and collisions; find quartiles of event frames."""
    scenes = [store.scene(name) for split in SPLITS for name in store.scene_ids(split)]
    collisions = [collisions_in(scene, 1, scene.frames) for scene in scenes]
    frames = [c.frame for own in collisions for c in own]
    objects = Counter(sorted(len(scene.objects) for scene in scenes))
    counts = Counter(sorted(map(len, collisions)))
    return {
        "objects": {str(n): scenes for n, scenes in objects.items()},
        "collisions": {str(n): scenes for n, scenes in counts.items()},
        "mean collisions": len(frames) / len(scenes),
        "event frames": np.percentile(frames, [0, 25, 50, 75, 100]).tolist() if frames else [],
    }


def _describe_item(item: SelectionItem, compared: CandidateFrames) -> dict[str, Any]:
    # Frame 0 is the last observed frame.
    target, wrong = 1 + item.answer, [1 + k for k in range(4) if k != item.answer]
    scenes = {candidate.scene_id for candidate in item.candidates}
    earlier = sum(candidate.frame < item.target_frame for candidate in item.candidates)
    return {
        "category": list(list_categories(item)),
        "letter": item.letter,
        "least": item.min_displacement,
        "nearest distractor": compared.displacement[target, wrong].min(),
        "earlier": earlier if len(scenes) == 1 else None,
    }


def list_categories(item: SelectionItem) -> Iterator[str]:
    """Yield the categories of an item; see `compute_statistics`."""
    yield item.family
    if item.family == "event":
        yield f"event, {item.distractors}"
    if item.difficulty is not None:
        yield f"window, {item.difficulty}"


def format_statistics(statistics: dict[str, Any]) -> str:
    """Format the statistics as text tables whose lines have at most 100 characters."""
    scenes = statistics["scenes"]
    candidates = pd.DataFrame(statistics["candidates"]).T.round().astype(int)
    cells = pd.DataFrame(statistics["cells"]).T
    shortcuts = pd.DataFrame(statistics["shortcuts"]).filter(regex="^(?!event, )").astype(float)
    shortcuts.loc[shortcuts.index != "items"] *= 100
    sections = [
        f"Objects per scene:    {_join(scenes['objects'])}\n"
        f"Collisions per scene: {_join(scenes['collisions'])} "
        f"(mean {scenes['mean collisions']:.2f})\n"
        f"Event frames:         {' '.join(f'{q:g}' for q in scenes['event frames'])} "
        "(minimum, quartiles, maximum)\n"
        f"Answers:              {_join(statistics['answers'])}",
        "Accuracy on the test split, %; only velocity predicts, given the moment and velocities\n"
        + shortcuts.to_string(float_format="{:.1f}".format, na_rep="-"),
        "Candidates: median displacement in px from the target to the nearest distractor and\n"
        "between any two candidates; items by number of distractors earlier than the target\n"
        + candidates.to_string(),
        "Items\n" + cells.to_string(),
    ]
    if retrieval := statistics["retrieval"]:
        measures = "  ".join(f"{name} {value:.3g}" for name, value in retrieval.items())
        sections.append(f"Standard test, a ranker that only recognises the scene\n{measures}")
    if shortfalls := statistics["shortfalls"]:
        sections.append(
            "Short of their quotas\n" + "\n".join(f"{k}: {n}" for k, n in shortfalls.items())
        )
    return "\n\n".join(sections)


def _join(counts: dict[str, int]) -> str:
    return ", ".join(f"{name}: {count:,}" for name, count in counts.items())
