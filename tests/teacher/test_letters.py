"""Letters of candidates: their detection, and their replacement for another order of candidates."""

from itertools import permutations

import numpy as np
import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.candidate_letters import find_letters, relabel_text, reorder_candidates
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.validation.validator import validate_rationale

ORDERS = list(permutations(range(4)))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("Candidate A agrees. A collision follows.", "A"),
        ("A shows the cube near the top. A red cube rests.", "A"),
        ("Outcome: A slowly moving sphere leaves.", ""),
        ("A wrongly puts the cube near the left; A and C differ.", "AAC"),
        ("Unlike B, A keeps the layout of A's neighbour D.", "BAAD"),
        ("Answer: A", "A"),
        ("A, B, and D show other objects.\nA glossy metal cube is missing from (C).", "ABDC"),
        ("Of candidates A and D, A alone agrees.\n\nAnswer: D", "ADAD"),
        ("A is right. A pair meets. A mass of objects. A can be ruled out.", "AA"),
        ("A now has it near the top; A likewise. A nearby cube. A therefore differs.", "AAA"),
        ("A bounces less than B; A has it near the top - A metal sphere has it not.", "ABA"),
    ],
)
def test_letters_are_distinguished_from_the_article(text, named):
    assert "".join(text[start:stop] for start, stop in find_letters(text)) == named


def test_relabelling_composes():
    text = "Candidate A lacks the cube. B and C differ. A contact follows. Answer: D"
    assert relabel_text(text, range(4)) == text
    for first in ORDERS:
        back = [first.index(k) for k in range(4)]
        assert relabel_text(relabel_text(text, first), back) == text
        for second in ORDERS[::5]:
            both = [first[k] for k in second]
            assert relabel_text(relabel_text(text, first), second) == relabel_text(text, both)


@pytest.mark.parametrize("space", [" ", "\n"])
def test_candidates_stay_in_the_order_of_their_letters(space: str) -> None:
    shown = ["a cube. It rests.", "no cube.", "a sphere.", "a cube, and agrees."]

    def write(shown: list[str], answer: str) -> str:
        sentences = [f"Candidate {k} shows {s}" for k, s in zip("ABCD", shown, strict=True)]
        outcome = f"Candidate {answer} agrees.\nAnswer: {answer}"
        return (
            f"Prediction: A cube.\nCandidate analysis: {space.join(sentences)}\nOutcome: {outcome}"
        )

    for order in ORDERS:
        reordered = write([shown[old] for old in order], "ABCD"[order.index(3)])
        assert relabel_text(write(shown, "D"), order) == reordered


def test_an_analysis_that_jumps_between_candidates_keeps_its_order() -> None:
    text = "Candidate analysis: Candidate A agrees. Candidate A fits. Unlike it, B, C and D differ."
    swapped = (
        "Candidate analysis: Candidate B agrees. Candidate B fits. Unlike it, A, C and D differ."
    )
    assert relabel_text(text, [1, 0, 2, 3]) == swapped


def test_relabelled_rationale_is_valid_for_the_reordered_item(micro_store):
    cfg, rng = TeacherConfig(name="template"), np.random.default_rng(0)
    answers_moved = 0
    for item in micro_store.selection():
        scene = micro_store.scene(item.scene_id)
        predicates = extract_predicates(item, scene, micro_store.scene)
        if predicates is None:
            continue
        text = write_rationale(predicates.without_relations(), item, seed=0)
        assert validate_rationale(text, predicates, item, cfg).accepted
        order = rng.permutation(4).tolist()
        other = reorder_candidates(item, order)
        assert [other.candidates[k] for k in range(4)] == [item.candidates[k] for k in order]
        facts = extract_predicates(other, scene, micro_store.scene)
        verdict = validate_rationale(relabel_text(text, order), facts, other, cfg)
        assert verdict.accepted, verdict.reasons
        assert verdict.answer == other.letter
        answers_moved += other.letter != item.letter
    assert answers_moved > 20
