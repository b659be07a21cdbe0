"""Vocabularies: the kinds of predicates from which rationales are written, and their versions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from dynapix.data.oracle.events import next_collision
from dynapix.data.records import CONTACT, Scene, SelectionItem
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.facts import Predicates, RelationalPredicates

if TYPE_CHECKING:
    from dynapix.conf.schema import TeacherConfig
    from dynapix.data.store import Store

VERSIONS = {"paper": "2", "relational": "8"}
"""Version of each vocabulary. It changes whenever the same item gives other predicates or other
deciding statements."""
GROUNDING_VERSION = "1"
"""Version of the facts of ungrounded rationales (`teacher.grounding`)."""


def name_vocabulary(cfg: TeacherConfig) -> str:
    """Return the name of the vocabulary and its version, such as "relational 1"."""
    guess = "" if cfg.grounding == "oracle" else f", {cfg.grounding} {GROUNDING_VERSION}"
    return f"{cfg.predicates} {VERSIONS[cfg.predicates]}{guess}"


def describe_item(
    item: SelectionItem,
    store: Store,
    cfg: TeacherConfig,
    scene_of: Callable[[str], Scene] | None = None,
) -> RelationalPredicates | None:
    """Return all predicates of an item; None if its prefix is too short.

    Args:
        scene_of: Returns a scene by its id, instead of the store.
    """
    scene_of = scene_of or store.scene
    # The scene of the target is the one whose future the item asks for.
    scene = scene_of(item.target.scene_id)
    predicates = extract_predicates(item, scene, scene_of)
    collision = next_collision(scene, item.prefix_stop)
    if predicates is None or item.distractors != CONTACT or collision is None:
        return predicates
    masses = store.manifest["config"]["world"]["objects"]["mass"]
    light, heavy = sorted(
        (masses[scene.objects[k].material] * scene.object_scales[k] ** 3, k)
        for k in collision.objects
    )
    if heavy[0] == light[0]:
        return predicates
    names = tuple(scene.objects[k].noun_phrase for _, k in (heavy, light))
    return replace(predicates, heavier=(names,))


def choose_vocabulary(predicates: RelationalPredicates, cfg: TeacherConfig) -> Predicates:
    """Return the predicates of the vocabulary in the settings."""
    return predicates if cfg.predicates == "relational" else predicates.without_relations()
