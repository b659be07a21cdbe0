"""Rationales about the collision of a contact item: its moment, its pair, and which is heavier."""

from __future__ import annotations

from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.data.items.futures.contact import LEAD, collision_timings
from dynapix.data.oracle.events import next_collision
from dynapix.data.records import CONTACT, Candidate, Scene, SelectionItem
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.vocabulary import choose_vocabulary, describe_item
from dynapix.teacher.validation.claim_extraction import extract_claims
from tests.data.simulated import preset_world, simulate_scene

WORLD = preset_world("above_masses")
GAP = 16


def make_item(scene: Scene) -> SelectionItem:
    """An item about the first collision after a prefix, with other frames as distractors."""
    timing = collision_timings(GAP, scene)[0]
    frames = (timing.target, timing.event, timing.event + 5, timing.stop - 1)
    return SelectionItem(
        item_id="item", split="train", suite="dynapix", family="event", subtype="collision_gap16",
        question="Which?", scene_id=scene.scene_id, prefix_start=timing.start,
        prefix_stop=timing.stop, target_frame=timing.target, event_frame=timing.event,
        candidates=tuple(Candidate(scene.scene_id, frame) for frame in frames), answer=0,
        min_displacement=1.0, framing="future", distractors=CONTACT, gap=LEAD + GAP,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    scenes = [simulate_scene(0, k, WORLD) for k in range(24)]
    return [scene for scene in scenes if collision_timings(GAP, scene)]


def store_of(scene: Scene) -> SimpleNamespace:
    manifest = {"config": {"world": asdict(WORLD)}}
    return SimpleNamespace(scene=lambda _: scene, manifest=manifest)


@pytest.mark.parametrize("vocabulary", ["paper", "relational"])
def test_rationale_says_which_object_is_heavier(scenes: list[Scene], vocabulary: str) -> None:
    cfg, said = replace(TeacherConfig(), predicates=vocabulary), 0
    for scene in scenes:
        item = make_item(scene)
        pair = [scene.objects[k] for k in next_collision(scene, item.prefix_stop).objects]
        facts = choose_vocabulary(describe_item(item, store_of(scene), cfg), cfg)
        assert facts.moment == "after the collision"
        assert facts.contacts[0].objects == tuple(each.noun_phrase for each in pair)
        text = write_rationale(facts, item, 0)
        metal, rubber = (
            [each.noun_phrase for each in pair if each.material == material]
            for material in ("metal", "rubber")
        )
        if len(metal) != 1:
            assert facts.heavier == ()
            assert "heavier" not in text
            continue
        sentence = f"he {metal[0]} is heavier than the {rubber[0]}."
        if sentence not in text:
            continue
        said += 1
        denied = sentence.replace("heavier", "lighter")
        for words, verdict in ((sentence, "supported"), (denied, "contradicted")):
            claims = extract_claims(text.replace(sentence, words), facts)
            assert [c.verdict for c in claims if c.kind == "weight"] == [verdict]
            assert ("contradicted" in {c.verdict for c in claims}) == (verdict == "contradicted")
    assert said > 2
