"""Which items the page shows, and what it tells of them."""

from __future__ import annotations

import base64
import io
import json
from collections import defaultdict

import numpy as np
import pytest
from PIL import Image

from evaluation.metrics.intervals import Interval
from evaluation.reporting import item_browser as shown
from evaluation.reporting.page import embedded
from evaluation.reporting.plots import by_horizon, confusion
from evaluation.reporting.run_responses import Said

LABELS = ("one", "other")


@pytest.fixture(scope="module")
def every(micro_store):
    return micro_store.selection("train")


@pytest.fixture(scope="module")
def answers(every):
    """Two models that are right by chance."""
    rng = np.random.default_rng(5)
    return {
        label: {i.item_id: Said(f"Answer: {rng.choice([*'ABCD'])}", False) for i in every}
        for label in LABELS
    }


def cells(items, answers):
    """The ids by (subtype, model, right)."""
    found = defaultdict(set)
    for item in items:
        for label, said in answers.items():
            is_right = said[item.item_id].choice.letter == item.letter
            found[item.family, item.subtype, label, is_right].add(item.item_id)
    return found


def test_a_spread_has_right_and_wrong_answers_of_every_subtype(every, answers):
    one = {"one": answers["one"]}
    there = cells(every, one)
    few = shown.spread(every, one, len(there), 0)
    assert len({i.item_id for i in few}) == len(few) == len(there)
    assert cells(few, one).keys() == there.keys()
    both = shown.spread(every, answers, len(there), 0)
    assert len(cells(both, answers)) > 0.8 * len(cells(every, answers))
    assert shown.spread(every, answers, len(there), 0) == both
    assert shown.spread(every, answers, len(there), 1) != both
    assert shown.spread(every, answers, 10**6, 0) == shown.spread(every, answers, len(every), 0)
    assert shown.spread(every, answers, 0, 0) == []


def test_a_frame_stands_in_the_page_once_and_small(micro_store, every):
    few = [*every[:6], every[0]]
    frames, gone = shown.pictures(few, micro_store)
    assert gone == []
    told = list(shown.entries(few, {}, micro_store))
    named = {n for e in told for n in (*e["prefix"], *(c["frame"] for c in e["candidates"]))}
    assert named == frames.keys()
    for data in frames.values():
        kind, _, content = data.partition(",")
        assert kind == "data:image/webp;base64"
        image = Image.open(io.BytesIO(base64.b64decode(content)))
        assert (image.format, image.width) == ("WEBP", shown.WIDTH)
        assert len(content) < 12_000
    target = f"{micro_store.name}/{few[0].scene_id}/{few[0].target_frame}"
    assert told[0]["candidates"][few[0].answer]["frame"] == target


def test_frames_that_are_gone_are_told_and_the_others_stay(micro_store, every, monkeypatch):
    from conf.errors import UserError
    from data.render.frame_cache import FrameReader

    lost = every[0].scene_id
    stack = FrameReader.stack

    def partly(self, scene_id, frames):
        if scene_id == lost:
            raise UserError(f"the video of {scene_id} is gone")
        return stack(self, scene_id, frames)

    monkeypatch.setattr(FrameReader, "stack", partly)
    few = [every[0], next(i for i in every if i.scene_id != lost and i.family == "time")]
    frames, gone = shown.pictures(few, micro_store)
    assert gone == [f"the video of {lost} is gone"]
    assert frames
    assert not [name for name in frames if f"/{lost}/" in name]


@pytest.mark.parametrize(
    ("text", "verdict"),
    [
        ("Answer: {right}", "right"),
        ("Answer: {wrong}", "wrong"),
        ("I cannot tell.", "unread"),
        ("", "unread"),
    ],
)
def test_an_answer_is_judged_by_what_was_said(micro_store, every, text, verdict):
    item = every[0]
    wrong = next(letter for letter in "ABCD" if letter != item.letter)
    said = Said(text.format(right=item.letter, wrong=wrong), False)
    [entry] = shown.entries([item], {"one": {item.item_id: said}}, micro_store)
    [told] = entry["said"]
    assert (told["by"], told["verdict"]) == ("one", verdict)
    assert (told["letter"] is None) == (verdict == "unread")
    assert entry["truth"][0].startswith(f"{item.letter} is right: frame {item.target_frame}")


def test_a_megabyte_is_cut_with_a_note(micro_store, every):
    said = Said("Answer: A\n" + "word " * 200_000, True)
    [entry] = shown.entries(every[:1], {"one": {every[0].item_id: said}}, micro_store)
    text = entry["said"][0]["text"]
    assert len(text) < shown.TEXT + 200
    assert text.startswith("Answer: A\nword")
    assert "1,000,010 characters" in text


def test_what_is_embedded_reads_back_and_closes_no_script():
    value = {"said": "</script><script>alert(1)</script><!-- \u2028 & 'quotes' \"", "n": [1, None]}
    text = str(embedded(value))
    assert "<" not in text
    assert json.loads(text) == value


def test_confusion_counts_every_answer_once():
    pairs = [("A", "A"), ("A", "B"), ("B", None), ("D", "D"), ("D", "D")]
    counts = confusion(pairs)
    assert counts.sum() == len(pairs)
    assert counts[0].tolist() == [1, 1, 0, 0, 0]
    assert counts[1].tolist() == [0, 0, 0, 0, 1]
    assert np.trace(counts) == 3


def test_horizons_pool_their_subtypes():
    def cell(value, n):
        return Interval(value, 0.0, 1.0, n)

    found = by_horizon(
        {
            "time/in_2s": cell(0.25, 8),
            "window/G1_A_h16_easy": cell(0.5, 4),
            "window/G2_B_h16_hard": cell(1.0, 2),
            "window/G2_B_h8_hard": cell(1.0, 1),
            "time/in_1s": cell(0.5, 2),
            "event/contact_cross": cell(1.0, 9),
        }
    )
    assert list(found) == ["8 frames", "16 frames", "1 s", "2 s"]
    assert (found["16 frames"].value, found["16 frames"].n) == (pytest.approx(4 / 6), 6)
    assert all(i.low <= i.value <= i.high for i in found.values())
