"""Questions of the tiny base: answers agree with the oracle and are unique."""

from __future__ import annotations

import re

import numpy as np
import pytest

from data.records import LETTERS
from data.render.frame_cache import FrameReader
from data.store import Store
from teacher.predicates import find_cut, object_region
from train.student.lazy_samples import LazySample
from train.tiny_base import questions


@pytest.fixture
def kinds(micro_store, frames, student_cfg) -> dict[str, list[LazySample]]:
    return questions.build_questions(
        micro_store, micro_store.selection("train"), student_cfg.frames, frames, 0
    )


def visible(store: Store, scene_id: str, frame: int) -> dict[str, str]:
    scene = store.scene(scene_id)
    return {
        o.phrase: object_region(scene, frame, k)
        for k, o in enumerate(scene.objects)
        if scene.in_view[frame, k] and scene.visible_fraction[frame, k] > 0.05
    }


def all_visible(store: Store, frames: FrameReader) -> dict[bytes, list[dict[str, str]]]:
    """Visible objects and regions of frames, by their pixels. The frames of a scene at rest have
    the same entry, except when an object slowly crosses the border of a region."""
    every: dict[bytes, list[dict[str, str]]] = {}
    for scene_id in {item.scene_id for item in store.selection()}:
        for frame in range(128):
            pixels = frames.array(scene_id, frame).tobytes()
            every.setdefault(pixels, []).append(visible(store, scene_id, frame))
    return every


def question_and_answer(lazy: LazySample, epoch: int = 0) -> tuple[str, str]:
    sample = lazy.load(epoch)
    return sample.content[-1]["text"], sample.response


def test_frame_is_described_completely(micro_store, kinds) -> None:
    for lazy in kinds["frame"]:
        sample = lazy.load(0)
        scene_id, frame = sample.sample_id.rsplit(" ", 1)
        expected = visible(micro_store, scene_id, int(frame))
        stated = re.findall(r"The (\w+ \w+ \w+) is (near the [\w-]+)\.", sample.response)
        assert dict(stated) == expected
        assert len(stated) == len(expected)


def test_each_candidate_is_described_under_its_letter(micro_store, frames, kinds) -> None:
    every = all_visible(micro_store, frames)
    distinguished = 0
    for lazy in kinds["candidates"][:16]:
        for epoch in range(4):
            sample = lazy.load(epoch)
            lines = sample.response.split("\n")
            stated = [
                dict(re.findall(r"The (\w+ \w+ \w+) is (near the [\w-]+)\.", x)) for x in lines
            ]
            assert [line[:13] for line in lines] == [f"Candidate {x}: " for x in LETTERS]
            for image, objects in zip(sample.images, stated, strict=True):
                assert objects in every[image.tobytes()]
            distinguished += len({str(objects) for objects in stated}) > 1
    assert distinguished > 24


def test_places_of_an_object_in_each_candidate(micro_store, frames, kinds) -> None:
    every = all_visible(micro_store, frames)
    answers = set()
    for lazy in kinds["where"][:16]:
        for epoch in range(4):
            sample = lazy.load(epoch)
            question = sample.content[-1]["text"]
            assert sample.clip is None
            phrase = re.search(r"Where does each candidate show the (.+)\?$", question)[1]
            places = parse_places(sample.response, phrase, r"\.")
            for image, (place, _) in zip(sample.images, places, strict=True):
                assert any(objects.get(phrase) == place for objects in every[image.tobytes()])
            answers.add(tuple(places))
    assert len(answers) > 16


def test_candidates_are_compared_with_the_predicted_place(micro_store, frames, kinds) -> None:
    every = all_visible(micro_store, frames)
    answers = set()
    for lazy in kinds["compared"][:16]:
        for epoch in range(4):
            sample = lazy.load(epoch)
            question = sample.content[-1]["text"]
            assert sample.clip is not None
            phrase = re.search(r"Compare each .+ with the prediction by the (.+)\.$", question)[1]
            expected = predicted_place(question, phrase)
            verdicts = parse_places(sample.response, phrase, r"( and agrees|, not (near .+?)|)\.")
            for image, (place, verdict) in zip(sample.images, verdicts, strict=True):
                assert any(objects.get(phrase) == place for objects in every[image.tobytes()])
                if place == expected:
                    assert verdict == " and agrees"
                else:
                    assert verdict == ((place and f", not {expected}") or "")
            assert " and agrees" in {verdict for _, verdict in verdicts}
            answers.add(tuple(verdicts))
    assert len(answers) > 16


def test_motion_of_an_object_in_a_clip(micro_store, kinds) -> None:
    items = {item.item_id: item for item in micro_store.selection("train")}
    rests = []
    for lazy in kinds["moves"][:24]:
        sample = lazy.load(0)
        item = items[sample.sample_id.partition(" (")[0]]
        scene = micro_store.scene(item.scene_id)
        end = find_cut(scene, item.prefix_start, item.prefix_stop)
        phrase = re.fullmatch(r"How does the (.+) move\?", sample.content[-1]["text"])[1]
        index = [o.phrase for o in scene.objects].index(phrase)
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
    for lazy in kinds["moves"][::6]:
        sample = lazy.load(0)
        item = items[sample.sample_id.partition(" (")[0]]
        scene, frames = micro_store.scene(item.scene_id), sample.clip.indices
        assert {label.picture for label in sample.object_labels} <= set(range(sample.pictures))
        for label in sample.object_labels:
            index = [tuple(o.phrase.split()) for o in scene.objects].index(label.words[:3])
            pair = [frames[2 * label.picture], frames[2 * label.picture + 1]]
            moves = np.linalg.norm(scene.velocities[pair[1], index]) >= 0.05
            assert (label.words[3] != "stationary") == moves
            if moves:
                gone = np.diff(scene.image_positions[pair, index], axis=0)[0]
                assert np.dot(gone, DIRECTIONS[label.words[3]]) > 0
            headings.add(label.words[3])
    assert len(headings) > 4


def parse_places(response: str, phrase: str, end: str) -> list[tuple[str | None, str]]:
    """The place of an object in each candidate, None if missing, and the text after it."""
    each = rf"Candidate (\w) (?:lacks|shows) the {phrase}(?: (near the [\w-]+))?{end}"
    matches = list(re.finditer(each, response))
    assert [one[1] for one in matches] == list(LETTERS)
    assert " ".join(one[0] for one in matches) == response
    return [(one[2], one[3] if len(one.groups()) > 2 else "") for one in matches]


def predicted_place(text: str, phrase: str) -> str | None:
    """The place that the narrator predicts for an object."""
    prediction = text[text.index("Prediction: ") : text.index("Outcome: ")]
    will = rf"{phrase} (?:will be|should be|remains|stays)(?: hidden)? (near the [\w-]+)"
    matches = re.search(will, prediction)
    return matches and matches[1]


def test_only_one_candidate_fits_a_description(micro_store, kinds) -> None:
    items = {item.item_id: item for item in micro_store.selection("train")}
    assert kinds["match"]
    for lazy in kinds["match"]:
        sample = lazy.load(0)
        item = items[sample.sample_id.removesuffix(" (match)")]
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


def test_answer_is_the_later_frame(frames, kinds) -> None:
    letters = set()
    for lazy in kinds["later"]:
        for epoch in range(3):
            sample = lazy.load(epoch)
            assert len(sample.images) == 2
            letters.add(sample.response)
            wrong = sample.images[sample.response == "Answer: A"]
            # The earlier one is the clip's last frame, and the two differ.
            assert (wrong == sample.clip.pixels[-1]).all()
            assert not (sample.images[0] == sample.images[1]).all()
    assert letters == {"Answer: A", "Answer: B"}


def test_clip_is_described_with_and_without_the_target(kinds) -> None:
    for lazy in kinds["clip"]:
        stated = [lazy.load(epoch) for epoch in range(12)]
        assert {len(sample.images) for sample in stated} == {0, 1}
        assert len({sample.response for sample in stated}) == 1
        assert stated[0].response.startswith("Scene parse: ")


def test_frames_vary_by_epoch_reproducibly(kinds) -> None:
    stated = [[question_and_answer(p, epoch)[1] for p in kinds["frame"]] for epoch in (0, 1, 0)]
    assert stated[0] == stated[2]
    assert stated[0] != stated[1]
