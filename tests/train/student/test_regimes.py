"""What each regime has a student write, and that it stays right in every order of candidates."""

from __future__ import annotations

from dataclasses import replace

import pytest

from conf.schema import SftTrainConfig, TeacherConfig
from conf.schema.training import REGIMES
from data.records import LETTERS
from data.store import Store
from models.student.answer_parser import parse_choice
from models.student.prompts import answer_line, instruction, response
from teacher.narrate import ensure_rationales
from teacher.predicates import extract_predicates
from teacher.sections import SECTIONS, split_sections
from teacher.validation.claim_extraction import extract_claims
from teacher.validation.validator import validate_rationale
from train.student.dataset import HELD_OUT, Supervised, held_out_scenes, supervised_items
from train.student.lazy_samples import Samples

TEACHER = TeacherConfig(name="template")
ASKED = [r for r in REGIMES if r not in ("answer_only", "describe")]


def made(store: Store, regime: str, seed: int | None = None) -> dict[str, list[Supervised]]:
    rationales = {r.item_id: r for r in ensure_rationales(store, TEACHER)}
    train = SftTrainConfig(regime=regime)
    return supervised_items(store, store.selection("train"), rationales, train, seed)


def told(s: Supervised) -> str:
    return response(s.rationale, s.matches, s.item.letter, s.mode, s.regime)


@pytest.mark.parametrize("regime", ASKED)
def test_a_regime_is_the_whole_without_its_part(micro_store, regime) -> None:
    asked = made(micro_store, regime)["reasoning"]
    assert asked
    for s in asked:
        text = told(s)
        headings = [name for name, _, _ in split_sections(text)]
        left_out = {"Candidate analysis"} if regime == "cot_no_candidate_analysis" else set()
        assert headings == [*(name for name in SECTIONS if name not in left_out), "Answer"]
        for name, start, stop in split_sections(s.rationale):
            if name not in ("Answer", *left_out):
                assert s.rationale[start:stop].strip() in text
        lines = text.splitlines()
        told_of = [line.split()[1] for line in lines if line.startswith("Candidate ") and
                   not line.startswith("Candidate analysis")]  # fmt: skip
        assert told_of == ([] if regime == "cot_no_match_layout" else list(LETTERS))
        assert lines[-1] == answer_line(s.item.letter)


@pytest.mark.parametrize("regime", [*ASKED, "answer_only"])
def test_both_modes_are_trained_and_answer_alike(micro_store, regime) -> None:
    asked = made(micro_store, regime)
    answers = {s.item.item_id: s for s in asked["answer"]}
    assert all(told(s) == answer_line(s.item.letter) for s in answers.values())
    assert {i.item_id for i in micro_store.selection("train")} == answers.keys()
    for s in asked["reasoning"]:
        assert parse_choice(told(s)).letter == answers[s.item.item_id].item.letter
        assert instruction(s.mode, regime) != instruction("answer", regime)


def test_what_is_supervised_is_right_in_every_epochs_order(micro_store) -> None:
    """Every item, in the orders of several epochs: the rationale stands before the validator, the
    matches hold against the predicates, and the answer is the same frame."""
    asked = made(micro_store, "cot", seed=0)
    orders = set()
    for s in asked["reasoning"] + asked["answer"]:
        right = s.item.candidates[s.item.answer]
        for epoch in range(4):
            shown = s.in_epoch(epoch)
            item = shown.item
            assert item.candidates[item.answer] == right
            assert sorted(item.candidates, key=repr) == sorted(s.item.candidates, key=repr)
            assert parse_choice(told(shown)).letter == LETTERS[item.candidates.index(right)]
            orders.add(tuple(s.item.candidates.index(c) for c in item.candidates))
            if s.mode == "reasoning":
                predicates = extract_predicates(
                    item, micro_store.scene(item.scene_id), micro_store.scene
                )
                assert validate_rationale(shown.rationale, predicates, item, TEACHER).reasons == ()
                matching = [line for line in shown.matches if " matches: " in line]
                assert [line.split()[1] for line in matching] == [item.letter]
                assert [line.split()[1] for line in shown.matches] == list(LETTERS)
                analysis = "Candidate analysis: " + "\n".join(shown.matches)
                verdicts = {c.verdict for c in extract_claims(analysis, predicates)}
                assert "contradicted" not in verdicts
                assert "supported" in verdicts
    assert len(orders) == 24


def test_an_order_is_of_its_seed_epoch_and_item(micro_store) -> None:
    first, second = made(micro_store, "answer_only", seed=0)["answer"][:2]
    orders = [first.in_epoch(e).item.candidates for e in range(8)]
    assert orders == [first.in_epoch(e).item.candidates for e in range(8)]
    assert len(set(orders)) > 1
    other = replace(first, seed=1)
    assert orders != [other.in_epoch(e).item.candidates for e in range(8)]

    def places(s: Supervised) -> list[list[int]]:
        shown = [s.in_epoch(e).item.candidates for e in range(8)]
        return [[s.item.candidates.index(c) for c in order] for order in shown]

    assert places(first) != places(second)
    assert made(micro_store, "answer_only")["answer"][0].in_epoch(3).item == first.item


def test_an_epoch_reaches_the_samples(micro_store, frames, student_cfg) -> None:
    asked = made(micro_store, "answer_only", seed=0)["answer"]
    samples = Samples([s.planned(frames, student_cfg) for s in asked])
    shown = []
    for epoch in range(4):
        samples.set_epoch(epoch)
        shown.append([samples[k].response for k in range(len(samples))])
        assert shown[-1] == [told(s.in_epoch(epoch)) for s in asked]
    assert shown[0] != shown[1]


class Names:
    """All of a store that says which scenes are held out."""

    def __init__(self, names: list[str]) -> None:
        self.names = names

    def scene_ids(self, split: str) -> list[str]:
        return self.names


def test_a_scene_is_held_out_whatever_else_a_store_holds() -> None:
    names = [f"s0-{k:06d}" for k in range(2000)]
    held_out = held_out_scenes(Names(names))
    assert len(held_out) == pytest.approx(HELD_OUT * len(names), rel=0.15)
    assert held_out_scenes(Names(names[:500])) == held_out & set(names[:500])
    assert len(held_out_scenes(Names(names[:1]))) == 1
