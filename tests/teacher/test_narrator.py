"""The validator accepts rationales of the built-in narrator, and rejects them when broken."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.validation.validator import WORD, validate_rationale
from tests.children import run_child
from tests.teacher import synthetic
from tests.teacher.test_predicates import random_cases

CFG = TeacherConfig(name="template")


def test_every_rationale_is_accepted():
    vocabulary, lengths = set(), []
    for item, predicates in random_cases(250):
        text = write_rationale(predicates, item, seed=3)
        assert validate_rationale(text, predicates, item, CFG).reasons == ()
        lengths.append(len(WORD.findall(text)))
        vocabulary |= {w.lower() for w in WORD.findall(text)}
    assert len(lengths) > 200
    assert 100 <= np.median(lengths) <= 180
    assert len(vocabulary) <= 250


def test_length_is_valid_for_sparse_and_crowded_scenes():
    still = synthetic.scene([(0, 0)], [(0, 0)])
    grid = [(x, y) for x in (-0.6, 0.0, 0.6) for y in (-0.25, 0.25)]
    crowded = synthetic.scene(grid, [(0.3 * -x, -y) for x, y in grid])
    for scene in (still, crowded):
        item = synthetic.item((100, 70, 80, 90), stop=20)
        predicates = extract_predicates(item, scene, None)
        if predicates is None:
            continue
        for seed in range(30):
            text = write_rationale(predicates, item, seed)
            assert validate_rationale(text, predicates, item, CFG).reasons == ()


def test_text_varies_with_the_seed_and_is_reproducible():
    item, predicates = next(random_cases(9))
    texts = {write_rationale(predicates, item, seed) for seed in range(8)}
    assert len(texts) > 4
    assert write_rationale(predicates, item, 0) == write_rationale(predicates, item, 0)
    assert len({write_rationale(predicates, item, 0, attempt) for attempt in range(4)}) > 1


def test_text_is_the_same_in_another_process():
    code = (
        "from tests.teacher.test_predicates import random_cases\n"
        "from dynapix.teacher.narrator import write_rationale\n"
        "item, predicates = next(random_cases(9))\n"
        "print(write_rationale(predicates, item, 5))"
    )
    item, predicates = next(random_cases(9))
    result = run_child([sys.executable, "-c", code], check=True)
    assert result.stdout.strip() == write_rationale(predicates, item, 5)


def change_letter(text, item):
    return text[:-1] + "ABCD"[(item.answer + 1) % 4]


def drop_section(section):
    def drop(text, item):
        return "\n".join(line for line in text.splitlines() if not line.startswith(section))

    return drop


def swap_sections(text, item):
    lines = text.splitlines()
    return "\n".join([lines[1], lines[0], *lines[2:]])


@pytest.mark.parametrize(
    ("mutate", "reason"),
    [
        (lambda t, i: t.replace("The ", "The two ", 1), "number: 'two'"),
        (lambda t, i: t.replace(" near", " 3 px near", 1), "number: '3'"),
        (drop_section("Prediction"), "missing section: Prediction"),
        (drop_section("Outcome"), "missing section: Outcome"),
        (drop_section("Answer"), "no answer"),
        (lambda t, i: t.replace("Answer: ", "Answer:"), "unclear answer"),
        (lambda t, i: t.replace("Answer: ", "Answer:\n\n"), "unclear answer"),
        (
            lambda t, i: re.sub(r"[Cc]andidate A[^.]*\.", "A wrong layout is seen.", t),
            "candidate not analysed: A",
        ),
        (change_letter, "wrong answer"),
        (lambda t, i: t[: len(t) // 2], "no answer"),
        (lambda t, i: t[:-1] + "none", "unclear answer"),
        (lambda t, i: t.replace("Outcome: ", "Outcome: " + "still " * 200), "too long"),
        (lambda t, i: "Answer: " + i.letter, "too short"),
        (lambda t, i: "Sure! " + t.replace("Scene", "\nScene", 1), "text before the sections"),
        (lambda t, i: t + "\n" + t.splitlines()[-1], "repeated section"),
        (swap_sections, "sections out of order"),
        (lambda t, i: "", "missing section: Scene parse"),
        (lambda t, i: "This text has no heading.", "missing section: Outcome"),
        (
            lambda t, i: t.replace("Candidate D", "It").replace("candidate D", "it"),
            "candidate not analysed: D",
        ),
    ],
)
def test_broken_rationale_is_rejected(mutate, reason):
    for item, predicates in random_cases(6):
        text = write_rationale(predicates, item, 0)
        verdict = validate_rationale(mutate(text, item), predicates, item, CFG)
        assert not verdict.accepted
        assert any(r.startswith(reason) for r in verdict.reasons), verdict.reasons


@pytest.mark.parametrize(
    ("fewest", "most", "reasons"),
    [(0, 0, ()), (1, 1, ("too short",)), (-1, -1, ("too long",)), (-1, 1, ())],
)
def test_the_bounds_of_the_length_are_valid_lengths(fewest, most, reasons):
    """The arguments are the bounds relative to the number of words of a rationale."""
    item, predicates = next(random_cases(9))
    text = write_rationale(predicates, item, 0)
    words = len(WORD.findall(text))
    cfg = replace(CFG, min_words=words + fewest, max_words=words + most)
    assert validate_rationale(text, predicates, item, cfg).reasons == reasons
