"""Vocabularies: the kinds of predicates from which rationales are written, and their versions."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from data.oracle.contacts import next_collision
from data.records import CONTACT, SelectionItem
from teacher.predicates.extraction import extract_predicates
from teacher.predicates.facts import Predicates, RelationalPredicates

if TYPE_CHECKING:
    from conf.schema import TeacherConfig
    from data.store import Store

VERSIONS = {"paper": "2", "relational": "8"}
"""Version of each vocabulary. It changes whenever the same item gives other predicates or other
deciding statements."""


def name_vocabulary(cfg: TeacherConfig) -> str:
    """Return the name of the vocabulary and its version, such as "relational 1"."""
    return f"{cfg.predicates} {VERSIONS[cfg.predicates]}"


def describe_item(
    item: SelectionItem, store: Store, cfg: TeacherConfig
) -> RelationalPredicates | None:
    """Return all predicates of an item; None if its prefix is too short."""
    # The scene of the target is the one whose future the item asks for.
    scene = store.scene(item.target.scene_id)
    predicates = extract_predicates(item, scene, store.scene, cfg.bounds)
    if predicates is None or item.distractors != CONTACT:
        return predicates
    masses = store.manifest["config"]["world"]["objects"]["mass"]
    light, heavy = sorted(
        (masses[scene.objects[k].material] * scene.object_scales[k] ** 3, k)
        for k in next_collision(scene, item.prefix_stop).objects
    )
    if heavy[0] == light[0]:
        return predicates
    names = tuple(scene.objects[k].noun_phrase for _, k in (heavy, light))
    return replace(predicates, heavier=(names,))


def choose_vocabulary(predicates: RelationalPredicates, cfg: TeacherConfig) -> Predicates:
    """Return the predicates of the vocabulary in the settings."""
    return predicates if cfg.predicates == "relational" else predicates.without_relations()
