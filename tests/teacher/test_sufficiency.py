"""How well a rationale's prediction decides its item."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.vocabulary import choose_vocabulary
from dynapix.teacher.servers.responses import Response
from dynapix.teacher.validation.claim_extraction import extract_claims
from dynapix.teacher.validation.grader import RationaleGrader
from dynapix.teacher.validation.sufficiency import find_predicted, measure_sufficiency
from tests.teacher import synthetic
from tests.teacher.test_predicates import random_cases


def sufficiency_of(prediction: str, pixels: list[tuple[float, float]]) -> float:
    """The sufficiency of a prediction about a cube that the candidates show at these pixels; the
    first is the target."""
    steps = np.array([synthetic.on_ground(pixel)[:2] for pixel in pixels])
    still = synthetic.scene([(0.0, 0.0), steps[0]], [(0, 0), (0, 0)])
    positions, image = still.positions.copy(), still.image_positions.copy()
    for frame, pixel in zip((60, 70, 80, 90), pixels, strict=True):
        positions[frame, 1, :2], image[frame, 1] = synthetic.on_ground(pixel)[:2], pixel
    scene = replace(still, positions=positions, image_positions=image, collisions=())
    predicates = extract_predicates(synthetic.item((60, 70, 80, 90)), scene, None)
    first, second = (o.noun_phrase for o in scene.objects)
    text = f"Prediction: {prediction.format(b=first, a=second)}\nOutcome: none."
    return measure_sufficiency(text, extract_claims(text, predicates), predicates)


PIXELS = [(100, 60), (100, 160), (400, 60), (120, 250)]


@pytest.mark.parametrize(
    ("prediction", "expected"),
    [
        ("The {a} will be near the top-left.", 1.0),
        ("The {a} will be left of the {b}.", 1 / 3),
        ("The {a} will be left of the {b}. The {a} will be above the {b}.", 1.0),
        ("The {a} will not be left of the {b}.", 0.0),
        ("The {a} will be right of the {b}.", 0.0),
        ("The {b} will be near the center.", 1 / 4),
        ("Nothing is known.", 1 / 4),
        ("The {a} will be near the right.", 1 / 4),
    ],
)  # fmt: skip
def test_sufficiency_is_the_chance_of_a_reader_who_knows_only_the_prediction(
    prediction: str, expected: float
) -> None:
    assert sufficiency_of(prediction, PIXELS) == pytest.approx(expected)


def test_only_the_prediction_counts() -> None:
    for item, predicates in random_cases(20, relational=True):
        text = write_rationale(predicates, item, 0)
        claims = extract_claims(text, predicates)
        without = "\n".join(x for x in text.splitlines() if not x.startswith("Prediction"))
        assert find_predicted(text, claims)
        assert measure_sufficiency(without, extract_claims(without, predicates), predicates) == 0.25


def test_a_rationale_that_does_not_decide_a_decidable_item_is_insufficient() -> None:
    """The paper's words decide fewer items than relations."""
    reasons = {"paper": set(), "relational": set()}
    for item, predicates in random_cases(60, relational=True):
        for vocabulary, found in reasons.items():
            cfg = TeacherConfig(name="t", predicates=vocabulary, sufficient=True)
            text = write_rationale(choose_vocabulary(predicates, cfg), item, 0)
            graded = RationaleGrader(cfg).grade(Response(text), predicates, item, 0)
            assert graded.accepted == (graded.sufficiency == 1)
            assert graded.undecided == ("undecided" in graded.reasons)
            found |= {(item.item_id, reason) for reason in graded.reasons}
    insufficient = {i for i, reason in reasons["paper"] if reason == "insufficient"}
    assert insufficient
    assert not {i for i, reason in reasons["relational"] if reason == "insufficient"}
