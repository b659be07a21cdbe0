"""The built-in narrator passes the validator, and the validator catches what is broken."""

import re
import subprocess
import sys

import numpy as np
import pytest

from conf.schema import TeacherConfig
from teacher.narrator import write_description, write_rationale
from teacher.numbers import find_numbers
from teacher.predicates import extract_predicates
from teacher.validation.validator import WORD, validate_rationale, word_count
from tests.teacher import synthetic
from tests.teacher.test_predicates import cases

CFG = TeacherConfig(name="template")


def test_every_narration_is_accepted():
    words, vocabulary, lengths = 0, set(), []
    for item, predicates in cases(250):
        text = write_rationale(predicates, item, seed=3)
        assert validate_rationale(text, predicates, item, CFG).reasons == ()
        lengths.append(word_count(text))
        vocabulary |= {w.lower() for w in WORD.findall(text)}
        words += 1
    assert words > 200
    assert 100 <= np.median(lengths) <= 180
    assert len(vocabulary) <= 250


def test_sparse_scenes_are_long_enough_and_crowded_ones_short_enough():
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


def test_seeds_vary_and_repeat():
    item, predicates = next(cases(9))
    texts = {write_rationale(predicates, item, seed) for seed in range(8)}
    assert len(texts) > 4
    assert write_rationale(predicates, item, 0) == write_rationale(predicates, item, 0)
    assert len({write_rationale(predicates, item, 0, attempt) for attempt in range(4)}) > 1


def test_another_process_narrates_alike():
    code = (
        "from tests.teacher.test_predicates import cases; from teacher.narrator import narrate;"
        "i, p = next(cases(9)); print(narrate(p, i, 5))"
    )
    item, predicates = next(cases(9))
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == write_rationale(predicates, item, 5)


def test_descriptions_have_no_candidates_and_no_numbers():
    scene = synthetic.random_scene(np.random.default_rng(2))
    text = write_description(scene, 0, 20, 70, 0)
    headings = [line.split(":")[0] for line in text.splitlines()]
    assert headings == ["Scene parse", "Motion analysis", "Prediction", "Outcome"]
    assert not find_numbers(text)
    assert "andidate" not in text
    assert text == write_description(scene, 0, 20, 70, 0)


def other_letter(text, item):
    return text[:-1] + "ABCD"[(item.answer + 1) % 4]


def without(section):
    def drop(text, item):
        return "\n".join(line for line in text.splitlines() if not line.startswith(section))

    return drop


def swap(text, item):
    lines = text.splitlines()
    return "\n".join([lines[1], lines[0], *lines[2:]])


@pytest.mark.parametrize(
    ("mutate", "reason"),
    [
        (lambda t, i: t.replace("The ", "The two ", 1), "number: 'two'"),
        (lambda t, i: t.replace(" near", " 3 px near", 1), "number: '3'"),
        (without("Prediction"), "missing section: Prediction"),
        (without("Outcome"), "missing section: Outcome"),
        (without("Answer"), "no answer"),
        (lambda t, i: t.replace("Answer: ", "Answer:"), "unclear answer"),
        (lambda t, i: t.replace("Answer: ", "Answer:\n\n"), "unclear answer"),
        (
            lambda t, i: re.sub(r"[Cc]andidate A[^.]*\.", "A wrong layout is seen.", t),
            "candidate not analysed: A",
        ),
        (other_letter, "wrong answer"),
        (lambda t, i: t[: len(t) // 2], "no answer"),
        (lambda t, i: t[:-1] + "none", "unclear answer"),
        (lambda t, i: t.replace("Outcome: ", "Outcome: " + "still " * 200), "too long"),
        (lambda t, i: "Answer: " + i.letter, "too short"),
        (lambda t, i: "Sure! " + t.replace("Scene", "\nScene", 1), "text before the sections"),
        (lambda t, i: t + "\n" + t.splitlines()[-1], "repeated section"),
        (swap, "sections out of order"),
        (lambda t, i: "", "missing section: Scene parse"),
        (lambda t, i: "No heading stands anywhere in this.", "missing section: Outcome"),
        (
            lambda t, i: t.replace("Candidate D", "It").replace("candidate D", "it"),
            "candidate not analysed: D",
        ),
    ],
)
def test_a_broken_rationale_is_rejected(mutate, reason):
    for item, predicates in cases(6):
        text = write_rationale(predicates, item, 0)
        verdict = validate_rationale(mutate(text, item), predicates, item, CFG)
        assert not verdict.accepted
        assert any(r.startswith(reason) for r in verdict.reasons), verdict.reasons
