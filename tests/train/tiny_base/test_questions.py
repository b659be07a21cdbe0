"""What the tiny base is asked is true of the oracle, and one answer alone is right."""

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
        micro_store, micro_store.selection("train"), student_cfg, frames, 0
    )


def shown(store: Store, scene_id: str, frame: int) -> dict[str, str]:
    scene = store.scene(scene_id)
    return {
        o.phrase: object_region(scene, frame, k)
        for k, o in enumerate(scene.objects)
        if scene.in_view[frame, k] and scene.visible_fraction[frame, k] > 0.05
    }


def all_shown(store: Store, frames: FrameReader) -> dict[bytes, list[dict[str, str]]]:
    """What frames show, by their pixels. A scene at rest is told alike, but where an object creeps
    over a region's border."""
    every: dict[bytes, list[dict[str, str]]] = {}
    for scene_id in {item.scene_id for item in store.selection()}:
        for frame in range(128):
            pixels = frames.array(scene_id, frame).tobytes()
            every.setdefault(pixels, []).append(shown(store, scene_id, frame))
    return every


def asked_and_answered(planned: LazySample, epoch: int = 0) -> tuple[str, str]:
    sample = planned.make(epoch)
    return sample.content[-1]["text"], sample.response


def test_a_frame_is_told_object_by_object(micro_store, kinds) -> None:
    for planned in kinds["frame"]:
        sample = planned.make(0)
        scene_id, frame = sample.sample_id.rsplit(" ", 1)
        there = shown(micro_store, scene_id, int(frame))
        told = re.findall(r"The (\w+ \w+ \w+) is (near the [\w-]+)\.", sample.response)
        assert dict(told) == there
        assert len(told) == len(there)


def test_each_candidate_is_told_under_its_letter(micro_store, frames, kinds) -> None:
    every = all_shown(micro_store, frames)
    told_apart = 0
    for planned in kinds["candidates"][:16]:
        for epoch in range(4):
            sample = planned.make(epoch)
            lines = sample.response.split("\n")
            told = [dict(re.findall(r"The (\w+ \w+ \w+) is (near the [\w-]+)\.", x)) for x in lines]
            assert [line[:13] for line in lines] == [f"Candidate {x}: " for x in LETTERS]
            for image, objects in zip(sample.images, told, strict=True):
                assert objects in every[image.tobytes()]
            told_apart += len({str(objects) for objects in told}) > 1
    assert told_apart > 24


def test_an_object_is_where_it_is_said_to_be_in_each_candidate(micro_store, frames, kinds) -> None:
    every = all_shown(micro_store, frames)
    answers = set()
    for planned in kinds["where"][:16]:
        for epoch in range(4):
            sample = planned.make(epoch)
            asked = sample.content[-1]["text"]
            assert sample.clip is None
            phrase = re.search(r"Where does each candidate show the (.+)\?$", asked)[1]
            places = said_of_each(sample.response, phrase, r"\.")
            for image, (place, _) in zip(sample.images, places, strict=True):
                assert any(objects.get(phrase) == place for objects in every[image.tobytes()])
            answers.add(tuple(places))
    assert len(answers) > 16


def test_candidates_are_compared_with_what_is_foreseen_of_an_object(
    micro_store, frames, kinds
) -> None:
    every = all_shown(micro_store, frames)
    answers = set()
    for planned in kinds["compared"][:16]:
        for epoch in range(4):
            sample = planned.make(epoch)
            asked = sample.content[-1]["text"]
            assert sample.clip is not None
            phrase = re.search(r"Compare each .+ with the prediction by the (.+)\.$", asked)[1]
            expected = foreseen(asked, phrase)
            verdicts = said_of_each(sample.response, phrase, r"( and agrees|, not (near .+?)|)\.")
            for image, (place, verdict) in zip(sample.images, verdicts, strict=True):
                assert any(objects.get(phrase) == place for objects in every[image.tobytes()])
                if place == expected:
                    assert verdict == " and agrees"
                else:
                    assert verdict == ((place and f", not {expected}") or "")
            assert " and agrees" in {verdict for _, verdict in verdicts}
            answers.add(tuple(verdicts))
    assert len(answers) > 16


def test_an_object_of_a_clip_moves_as_it_is_said_to(micro_store, kinds) -> None:
    items = {item.item_id: item for item in micro_store.selection("train")}
    rests = []
    for planned in kinds["moves"][:24]:
        sample = planned.make(0)
        item = items[sample.sample_id.partition(" (")[0]]
        scene = micro_store.scene(item.scene_id)
        end = find_cut(scene, item.prefix_start, item.prefix_stop)
        phrase = re.fullmatch(r"How does the (.+) move\?", sample.content[-1]["text"])[1]
        index = [o.phrase for o in scene.objects].index(phrase)
        speed = np.linalg.norm(scene.velocities[end, index])
        told = re.fullmatch(
            rf"[A-Z].+, the {phrase} is (near the [\w-]+) and (does not move|moves .+)\.",
            sample.response,
        )
        assert told[1] == object_region(scene, end, index)
        assert (told[2] == "does not move") == (speed < 0.05)
        if way := re.search(r"toward the (\w+)$", told[2]):
            gone = np.diff(scene.image_positions[[end - 1, end], index], axis=0)[0]
            assert np.dot(gone, DIRECTIONS[way[1]]) > 0
        rests.append(told[2] == "does not move")
    assert 0.2 < np.mean(rests) < 0.8


DIRECTIONS = {
    "east": (1, 0), "southeast": (1, 1), "south": (0, 1), "southwest": (-1, 1),
    "west": (-1, 0), "northwest": (-1, -1), "north": (0, -1), "northeast": (1, -1),
}  # fmt: skip


def test_a_clips_tokens_tell_how_their_objects_move(micro_store, kinds) -> None:
    items = {item.item_id: item for item in micro_store.selection("train")}
    ways = set()
    for planned in kinds["moves"][::6]:
        sample = planned.make(0)
        item = items[sample.sample_id.partition(" (")[0]]
        scene, frames = micro_store.scene(item.scene_id), sample.clip.indices
        assert {sight.picture for sight in sample.sights} <= set(range(sample.pictures))
        for sight in sample.sights:
            index = [tuple(o.phrase.split()) for o in scene.objects].index(sight.words[:3])
            pair = [frames[2 * sight.picture], frames[2 * sight.picture + 1]]
            moves = np.linalg.norm(scene.velocities[pair[1], index]) >= 0.05
            assert (sight.words[3] != "stationary") == moves
            if moves:
                gone = np.diff(scene.image_positions[pair, index], axis=0)[0]
                assert np.dot(gone, DIRECTIONS[sight.words[3]]) > 0
            ways.add(sight.words[3])
    assert len(ways) > 4


def said_of_each(response: str, phrase: str, end: str) -> list[tuple[str | None, str]]:
    """The place in which each candidate is said to show an object, None where it lacks it, and what
    is said of that."""
    each = rf"Candidate (\w) (?:lacks|shows) the {phrase}(?: (near the [\w-]+))?{end}"
    found = list(re.finditer(each, response))
    assert [one[1] for one in found] == list(LETTERS)
    assert " ".join(one[0] for one in found) == response
    return [(one[2], one[3] if len(one.groups()) > 2 else "") for one in found]


def foreseen(text: str, phrase: str) -> str | None:
    """The place in which a narrator says that an object will be."""
    prediction = text[text.index("Prediction: ") : text.index("Outcome: ")]
    will = rf"{phrase} (?:will be|should be|remains|stays)(?: hidden)? (near the [\w-]+)"
    found = re.search(will, prediction)
    return found and found[1]


def test_one_candidate_alone_fits_a_description(micro_store, kinds) -> None:
    items = {item.item_id: item for item in micro_store.selection("train")}
    assert kinds["match"]
    for planned in kinds["match"]:
        sample = planned.make(0)
        item = items[sample.sample_id.removesuffix(" (match)")]
        wanted = re.findall(r"the (\w+ \w+ \w+) (near the [\w-]+)", sample.content[-1]["text"])
        assert wanted
        fitting = [
            letter
            for letter, c in zip(LETTERS, item.candidates, strict=True)
            if dict(wanted).items() <= shown(micro_store, c.scene_id, c.frame).items()
        ]
        assert fitting == [item.letter]
        assert sample.response.endswith(f"\nAnswer: {item.letter}")
        assert f"Candidate {item.letter} matches: " in sample.response
        assert len(sample.images) == 4
        assert sample.clip is None


def test_the_later_frame_is_the_answer(frames, kinds) -> None:
    letters = set()
    for planned in kinds["later"]:
        for epoch in range(3):
            sample = planned.make(epoch)
            assert len(sample.images) == 2
            letters.add(sample.response)
            wrong = sample.images[sample.response == "Answer: A"]
            # The earlier one is the clip's last frame, and the two can be told apart.
            assert (wrong == sample.clip.pixels[-1]).all()
            assert not (sample.images[0] == sample.images[1]).all()
    assert letters == {"Answer: A", "Answer: B"}


def test_a_clip_is_told_with_its_outcome_shown_and_without(kinds) -> None:
    for planned in kinds["clip"]:
        told = [planned.make(epoch) for epoch in range(12)]
        assert {len(sample.images) for sample in told} == {0, 1}
        assert len({sample.response for sample in told}) == 1
        assert told[0].response.startswith("Scene parse: ")


def test_each_epoch_shows_other_frames_and_the_same_again(kinds) -> None:
    told = [[asked_and_answered(p, epoch)[1] for p in kinds["frame"]] for epoch in (0, 1, 0)]
    assert told[0] == told[2]
    assert told[0] != told[1]
