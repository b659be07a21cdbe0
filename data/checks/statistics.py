"""Statistics of a benchmark's scenes and selection items, and the accuracy of baselines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from dynapix.data.checks.baselines import score_scene_alone, score_velocity
from dynapix.data.checks.shortcuts import (
    cross_validate_logistic_model,
    score_logistic_model,
    score_not_the_ghost,
    score_simple_strategies,
)
from dynapix.data.items.scores import COLLISION_SCORES, SCORES, CandidateFrames, compare_item
from dynapix.data.oracle.events import collisions_in
from dynapix.data.records import CONTACT, LETTERS, SPLITS, SelectionItem
from dynapix.data.store import Store

LOGISTIC, VELOCITY = "logistic model of all scores", "velocity"


def compute_statistics(store: Store, blind: bool = False) -> dict[str, Any]:
    """Return the statistics of a store that has selection items.

    Args:
        blind: Whether to train blind models too.

    Returns:
        ``scenes``: distributions of objects, collisions and event frames. ``answers``: items by
        letter. ``cells``: items by family, subtype and split; contact items also by the kinds of
        their distractors. ``candidates``: median displacements, and items by number of distractors
        earlier than the target, by category. ``shortcuts``: accuracies on the test split of the
        strategies of `data.checks.shortcuts` and of the baseline `velocity`, by category.
        ``shortcuts, both splits``: the same over all contact items. ``retrieval``: measures of a
        ranker that only recognises the scene, on the standard test. ``shortfalls``: cells with
        fewer records than their quotas. A category is a family, a kind of distractors in the event
        family (of contact items: a subtype), or a difficulty in the window family.
    """
    items, config = store.selection(), store.manifest["config"]
    queries = store.standard_test()
    progress = tqdm(items, desc="comparing candidates", unit="item")
    compared = [compare_item(item, store.scene, config) for item in progress]
    rows = pd.DataFrame([_describe_item(*each) for each in zip(items, compared, strict=True)])
    categories = rows.explode("category").groupby("category")
    earlier = pd.crosstab(categories.obj["category"], categories.obj["earlier"])
    candidates = categories[["nearest distractor", "least"]].median()
    for count in range(4):
        candidates[f"{count} earlier"] = earlier.get(count, pd.Series(dtype=int))
    scores = np.stack([each.item_scores() for each in compared])
    tables = {"shortcuts": measure_shortcuts(items, scores, store, blind)}
    if has_contact_items(items):
        tables["shortcuts, both splits"] = measure_shortcuts(items, scores, store, both=True)
    return {
        "scenes": describe_scenes(store),
        "answers": rows["letter"].value_counts().reindex(list(LETTERS), fill_value=0).to_dict(),
        "cells": count_cells(items).to_dict("index"),
        "candidates": candidates.fillna(0).to_dict("index"),
        **{
            name: table.astype(object).where(table.notna(), None).to_dict("index")
            for name, table in tables.items()
        },
        "retrieval": score_scene_alone(queries, store.database()) if queries else {},
        "shortfalls": store.manifest["shortfalls"],
    }


def measure_shortcuts(
    items: list[SelectionItem],
    scores: np.ndarray,
    store: Store,
    blind: bool = False,
    both: bool = False,
) -> pd.DataFrame:
    """Return the accuracy of each shortcut on the items of the test split, by category, given the
    scores (N, S, 4) of the items' candidates.

    Args:
        both: Whether to take the items of both splits. The logistic model is then cross-validated.
    """
    answers = np.array([item.answer for item in items])
    is_contact = has_contact_items(items)
    names = (*SCORES, *COLLISION_SCORES) if is_contact else SCORES
    right = pd.DataFrame(score_simple_strategies(names, scores, answers))
    if is_contact:
        right["not the ghost"] = score_not_the_ghost(items)
    score_logistic = cross_validate_logistic_model if both else score_logistic_model
    right[LOGISTIC] = score_logistic(items, scores, answers)
    right[VELOCITY] = [score_velocity(item, store) for item in items]
    if blind:
        from dynapix.data.checks.blind_models import score_blind_models

        right = right.assign(**score_blind_models(items, store, store.manifest["seed"]))
    names = list(right)
    right["category"] = [list(list_categories(item)) for item in items]
    counted = right[[both or item.split == "test" for item in items]]
    categories = counted.explode("category").groupby("category")
    return categories[names].mean().assign(items=categories.size())


def count_cells(items: list[SelectionItem]) -> pd.DataFrame:
    """Count items by cell and split; of contact items, also those with each kind of distractor."""
    cells = [f"{item.family}/{item.subtype}" for item in items]
    counts = pd.crosstab(cells, [item.split for item in items])
    if has_contact_items(items):
        kinds = pd.Series([{c.source for c in item.candidates} for item in items]).explode()
        present = pd.crosstab(np.array(cells)[kinds.index], kinds.to_numpy())
        counts = counts.join(present.drop(columns="target"))
    return counts


def has_contact_items(items: list[SelectionItem]) -> bool:
    """Return whether any items have other outcomes of a collision as distractors."""
    return any(item.distractors == CONTACT for item in items)


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
        yield item.subtype if item.distractors == CONTACT else f"event, {item.distractors}"
    if item.difficulty is not None:
        yield f"window, {item.difficulty}"


def format_statistics(statistics: dict[str, Any]) -> str:
    """Format the statistics as text tables whose lines have at most 100 characters."""
    scenes = statistics["scenes"]
    candidates = pd.DataFrame(statistics["candidates"]).T.round().astype(int)
    cells = pd.DataFrame(statistics["cells"]).T
    sections = [
        f"Objects per scene:    {_join(scenes['objects'])}\n"
        f"Collisions per scene: {_join(scenes['collisions'])} "
        f"(mean {scenes['mean collisions']:.2f})\n"
        f"Event frames:         {' '.join(f'{q:g}' for q in scenes['event frames'])} "
        "(minimum, quartiles, maximum)\n"
        f"Answers:              {_join(statistics['answers'])}",
        "Accuracy on the test split, %; only velocity predicts, given the moment and velocities\n"
        + _format_shortcuts(statistics["shortcuts"]),
        "Candidates: median displacement in px from the target to the nearest distractor and\n"
        "between any two candidates; items by number of distractors earlier than the target\n"
        + candidates.to_string(),
        "Items (contact items: also by kinds of distractors)\n" + cells.to_string(),
    ]
    if both := statistics.get("shortcuts, both splits"):
        sections.insert(
            2,
            "Accuracy on both splits, %, with a standard error of 43 / sqrt(items); the logistic\n"
            "model is trained on the scenes of the other folds of a cross-validation\n"
            + _format_shortcuts(both),
        )
    if retrieval := statistics["retrieval"]:
        measures = "  ".join(f"{name} {value:.3g}" for name, value in retrieval.items())
        sections.append(f"Standard test, a ranker that only recognises the scene\n{measures}")
    if shortfalls := statistics["shortfalls"]:
        sections.append(
            "Short of their quotas\n" + "\n".join(f"{k}: {n}" for k, n in shortfalls.items())
        )
    return "\n\n".join(sections)


def _format_shortcuts(shortcuts: dict[str, dict[str, float]]) -> str:
    table = pd.DataFrame(shortcuts).filter(regex="^(?!event, )").astype(float)
    table.loc[table.index != "items"] *= 100
    return table.to_string(float_format="{:.1f}".format, na_rep="-")


def _join(counts: dict[str, int]) -> str:
    return ", ".join(f"{name}: {count:,}" for name, count in counts.items())
