"""What the tiny base says is measured against the oracle."""

from __future__ import annotations

import re

import pytest

from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.store import Store
from dynapix.models.student.responses import GeneratedText
from research.tiny_base import generated_answers
from research.tiny_base.samples import ItemSampler, split_items

pytestmark = pytest.mark.slow


@pytest.fixture
def measure(micro_store: Store, model, processor, student_cfg, monkeypatch: pytest.MonkeyPatch):
    """Measure answers that a function makes of the true ones."""
    frames = FrameReader(micro_store, student_cfg.image_size)
    items, _ = split_items(micro_store, frames)
    sampler = ItemSampler(items, frames, 4, 0)

    def measure_answers(change) -> dict[str, float]:
        true = [
            sampler.ask_question(item, kind, "held out")[1].answer
            for kind in (*generated_answers.SECTION_PREFIXES, "explain")
            for item in items[: generated_answers.BATCH]
        ]
        batches = iter(
            [
                true[k : k + generated_answers.BATCH]
                for k in range(0, len(true), generated_answers.BATCH)
            ]
        )
        monkeypatch.setattr(
            generated_answers,
            "generate",
            lambda *_: [GeneratedText(change(t)) for t in next(batches)],
        )
        return generated_answers.measure_generated_answers(
            model, processor, sampler, items[: generated_answers.BATCH], student_cfg, "fp32"
        )

    return measure_answers


def test_true_answers_are_right_in_every_respect(measure) -> None:
    measures = measure(lambda text: text)
    assert {
        "generated_region/predict",
        "generated_color/parse",
        "generated_moving/parse",
        "generated_heading/parse",
        "generated_name_precision/describe",
        "generated_outcome/explain",
        "generated_choice/explain",
    } <= measures.keys()
    assert {k: v for k, v in measures.items() if v < 1} == {}


def test_false_words_are_noticed(measure) -> None:
    metal = measure(lambda text: text.replace(" rubber ", " metal "))
    # Another object may have the false material, and then seems to be meant.
    assert metal["generated_material/parse"] < metal["generated_color/parse"]
    assert metal["generated_name_precision/parse"] < 0.8
    regions = measure(lambda text: text.replace("near the ", "not near the "))
    assert regions["generated_region/predict"] == 0


def test_false_motions_are_noticed(measure) -> None:
    moving = r"(is )?mov\w+ \w+ toward the \w+"
    still = measure(lambda text: re.sub(moving, "is stationary", text))
    assert still["generated_moving/parse"] < 0.6
    assert "generated_heading/parse" not in still
    opposite = {"north": "south", "south": "north", "east": "west", "west": "east"}
    turned = measure(lambda text: re.sub("|".join(opposite), lambda m: opposite[m.group()], text))
    assert turned["generated_heading/parse"] == 0
    assert turned["generated_moving/parse"] == 1


def test_objects_that_an_answer_lacks_are_noticed(measure) -> None:
    repeated = measure(lambda text: text.split(".")[0] + ".")
    assert repeated["generated_name_recall/parse"] < 0.8
    assert repeated["generated_name_precision/parse"] == 1


def test_false_and_missing_outcomes_are_noticed(measure) -> None:
    order = dict(zip("ABCD", "BCDA", strict=True))
    closest = re.compile(r"(?<=expected place in candidate )\w")
    false = measure(lambda text: closest.sub(lambda m: order[m.group()], text))
    assert false["generated_choice/explain"] == 0
    assert false["generated_outcome/explain"] == 1
    missing = measure(lambda text: text.partition("Outcome")[0])
    assert missing["generated_outcome/explain"] == 0
