"""Questions for the tiny base: their answers agree with the oracle and are unambiguous."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from data.records import LETTERS
from data.store import Store
from models.student.prompts import Sample
from teacher.predicates.motion import find_cut
from teacher.predicates.places import object_region
from train.student.lazy_samples import LazySample
from train.tiny_base import questions
from train.tiny_base.questions import visible_objects, visible_regions


@pytest.fixture
def kinds(micro_store, frames, student_cfg) -> dict[str, list[LazySample]]:
    return questions.build_questions(
        micro_store, micro_store.selection("train"), student_cfg.frames, frames, 0
    )


def visible(store: Store, scene_id: str, frame: int) -> dict[str, str]:
    scene = store.scene(scene_id)
    return {
        o.noun_phrase: object_region(scene, frame, k)
        for k, o in enumerate(scene.objects)
        if scene.in_view[frame, k] and scene.visible_fraction[frame, k] > 0.05
    }


@pytest.fixture
def regions(micro_store, frames) -> dict[bytes, list[dict[str, str]]]:
    """For each image, by its pixels, the visible objects and their regions in the frames that look
    so. These differ if an object slowly crosses the border of a region."""
    every: dict[bytes, list[dict[str, str]]] = {}
    for scene_id in {item.scene_id for item in micro_store.selection()}:
        for frame in range(128):
            pixels = frames.array(scene_id, frame).tobytes()
            every.setdefault(pixels, []).append(visible(micro_store, scene_id, frame))
    return every


def described(text: str) -> dict[str, str]:
    """Return the objects that a description names, with their regions."""
    stated = re.findall(r"The (\w+ \w+ \w+) is (near the [\w-]+)\.", text)
    assert len(dict(stated)) == len(stated)
    return dict(stated)


def samples_of(lazy: list[LazySample], epochs: int = 1) -> Iterator[Sample]:
    return (one.render(epoch) for one in lazy for epoch in range(epochs))


def test_a_frame_is_described_completely(regions, kinds) -> None:
    for sample in samples_of(kinds["frame"]):
        assert described(sample.response) in regions[sample.images[0].tobytes()]


def test_each_candidate_is_described_under_its_letter(regions, kinds) -> None:
    distinguished = 0
    for sample in samples_of(kinds["candidates"][:16], 4):
        lines = sample.response.split("\n")
        assert [line[:13] for line in lines] == [f"Candidate {x}: " for x in LETTERS]
        stated = [described(line) for line in lines]
        for image, objects in zip(sample.images, stated, strict=True):
            assert objects in regions[image.tobytes()]
        distinguished += len({str(objects) for objects in stated}) > 1
    assert distinguished > 24


@pytest.mark.parametrize(
    ("kind", "question", "end"),
    [
        ("where", r"Where does each candidate show the (.+)\?$", r"()\."),
        (
            "compared",
            r"Compare each .+ with the prediction by the (.+)\.$",
            r"( and agrees|, not near .+?|)\.",
        ),
    ],
)
def test_places_of_an_object_in_each_candidate(regions, kinds, kind, question, end) -> None:
    answers = set()
    for sample in samples_of(kinds[kind][:16], 4):
        text = sample.content[-1]["text"]
        phrase = re.search(question, text)[1]
        each = rf"Candidate (\w) (?:lacks|shows) the {phrase}(?: (near the [\w-]+))?{end}"
        matches = list(re.finditer(each, sample.response))
        assert [one[1] for one in matches] == list(LETTERS)
        assert " ".join(one[0] for one in matches) == sample.response
        for image, one in zip(sample.images, matches, strict=True):
            assert any(objects.get(phrase) == one[2] for objects in regions[image.tobytes()])
        assert (sample.clip is None) == (kind == "where")
        if kind == "compared":
            expected = predicted_place(text, phrase)
            for one in matches:
                difference = f", not {expected}" if one[2] else ""
                assert one[3] == (" and agrees" if one[2] == expected else difference)
            assert " and agrees" in {one[3] for one in matches}
        answers.add(sample.response)
    assert len(answers) > 16


def predicted_place(text: str, phrase: str) -> str | None:
    """Return the region that the narrator predicts for an object."""
    prediction = text[text.index("Prediction: ") : text.index("Outcome: ")]
    will = rf"{phrase} (?:will be|should be|remains|stays)(?: hidden)? (near the [\w-]+)"
    matches = re.search(will, prediction)
    return matches and matches[1]


def test_motion_of_an_object_in_a_clip(micro_store, kinds) -> None:
    items = {item.item_id: item for item in micro_store.selection("train")}
    rests = []
    for sample in samples_of(kinds["moves"][:24]):
        item = items[sample.sample_id.partition(" (")[0]]
        scene = micro_store.scene(item.scene_id)
        end = find_cut(scene, item.prefix_start, item.prefix_stop)
        phrase = re.fullmatch(r"How does the (.+) move\?", sample.content[-1]["text"])[1]
        index = [o.noun_phrase for o in scene.objects].index(phrase)
        speed = np.linalg.norm(scene.velocities[end, index])
        stated = re.fullmatch(
            rf"[A-Z].+, the {phrase} is (near the [\w-]+) and (does not move|moves .+)\.",
            sample.response,
        )
        assert stated[1] == object_region(scene, end, index)
        assert (stated[2] == "does not move") == (speed < 0.05)
        if heading := re.search(r"toward the (\w+)$", stated[2]):
            gone = np.diff(scene.image_positions[[end - 1, end], index], axis=0)[0]
            assert np.dot(gone, DIRECTIONS[heading[1]]) > 0
        rests.append(stated[2] == "does not move")
    assert 0.2 < np.mean(rests) < 0.8


DIRECTIONS = {
    "east": (1, 0), "southeast": (1, 1), "south": (0, 1), "southwest": (-1, 1),
    "west": (-1, 0), "northwest": (-1, -1), "north": (0, -1), "northeast": (1, -1),
}  # fmt: skip


def test_headings_of_objects_at_visual_tokens(micro_store, kinds) -> None:
    items = {item.item_id: item for item in micro_store.selection("train")}
    headings = set()
    for sample in samples_of(kinds["moves"][::6]):
        item = items[sample.sample_id.partition(" (")[0]]
        scene, frames = micro_store.scene(item.scene_id), sample.clip.indices
        assert {label.picture for label in sample.object_labels} <= set(range(sample.pictures))
        for label in sample.object_labels:
            index = [tuple(o.noun_phrase.split()) for o in scene.objects].index(label.words[:3])
            pair = [frames[2 * label.picture], frames[2 * label.picture + 1]]
            moves = np.linalg.norm(scene.velocities[pair[1], index]) >= 0.05
            assert (label.words[3] != "stationary") == moves
            if moves:
                gone = np.diff(scene.image_positions[pair, index], axis=0)[0]
                assert np.dot(gone, DIRECTIONS[label.words[3]]) > 0
            headings.add(label.words[3])
    assert len(headings) > 4


def test_only_one_candidate_fits_a_description(micro_store, kinds) -> None:
    items = {item.item_id: item for item in micro_store.selection("train")}
    assert kinds["match"]
    for sample in samples_of(kinds["match"]):
        item = items[sample.sample_id.partition(" (")[0]]
        wanted = re.findall(r"the (\w+ \w+ \w+) (near the [\w-]+)", sample.content[-1]["text"])
        assert wanted
        fitting = [
            letter
            for letter, c in zip(LETTERS, item.candidates, strict=True)
            if dict(wanted).items() <= visible(micro_store, c.scene_id, c.frame).items()
        ]
        assert fitting == [item.letter]
        assert sample.response.endswith(f"\nAnswer: {item.letter}")
        assert f"Candidate {item.letter} matches: " in sample.response
        assert len(sample.images) == 4
        assert sample.clip is None


def test_answer_is_the_later_frame(kinds) -> None:
    letters = set()
    for sample in samples_of(kinds["later"], 3):
        assert len(sample.images) == 2
        letters.add(sample.response)
        wrong = sample.images[sample.response == "Answer: A"]
        # The earlier frame is the last frame of the clip, and the frames differ.
        assert (wrong == sample.clip.pixels[-1]).all()
        assert not (sample.images[0] == sample.images[1]).all()
    assert letters == {"Answer: A", "Answer: B"}


def test_clip_is_described_with_and_without_the_target(kinds) -> None:
    for lazy in kinds["clip"]:
        samples = [lazy.render(epoch) for epoch in range(12)]
        assert {len(sample.images) for sample in samples} == {0, 1}
        assert len({sample.response for sample in samples}) == 1
        assert samples[0].response.startswith("Scene parse: ")


def test_frames_vary_by_epoch_reproducibly(kinds) -> None:
    responses = [[lazy.render(epoch).response for lazy in kinds["frame"]] for epoch in (0, 1, 0)]
    assert responses[0] == responses[2]
    assert responses[0] != responses[1]


def test_objects_of_unknown_visibility_are_described(micro_store) -> None:
    """Releases record whether an object is in view, and NaN as its visible fraction."""
    scene = micro_store.scene(micro_store.scene_ids("train")[0])
    unknown = replace(scene, visible_fraction=np.full_like(scene.visible_fraction, np.nan))
    in_view = {
        o.noun_phrase for o, seen in zip(scene.objects, scene.in_view[0], strict=True) if seen
    }
    assert visible_regions(unknown, 0).keys() == in_view
    assert len(list(visible_objects(unknown, 0))) == len(in_view) > 0
