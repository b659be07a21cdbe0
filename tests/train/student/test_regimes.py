"""Each regime's responses, which stay right in every order of the candidates."""

from __future__ import annotations

from functools import partial

import pytest

from conf.schema import TeacherConfig
from conf.schema.training import REGIMES
from data.records import LETTERS
from data.store import Store
from models.student.answer_parser import parse_choice
from models.student.prompts import answer_line, instruction
from teacher.narrate import ensure_rationales
from teacher.predicates import extract_predicates
from teacher.sections import SECTIONS, split_sections
from teacher.validation.claim_extraction import extract_claims
from teacher.validation.validator import validate_rationale
from train.common.held_out import HELD_OUT, held_out_scenes
from train.student.dataset import Supervised, load_supervised, supervised_items
from train.student.lazy_samples import LazySample, StudentDataset

TEACHER = TeacherConfig(name="template")
COT = [r for r in REGIMES if r not in ("answer_only", "describe")]


def items_of(store: Store, regime: str) -> dict[str, list[Supervised]]:
    rationales = {r.item_id: r for r in ensure_rationales(store, TEACHER)}
    return supervised_items(store, store.selection("train"), rationales, regime)


@pytest.mark.parametrize("regime", COT)
def test_a_regime_leaves_out_its_part_only(micro_store, regime) -> None:
    supervised = items_of(micro_store, regime)["reasoning"]
    assert supervised
    for s in supervised:
        text = s.response
        headings = [name for name, _, _ in split_sections(text)]
        left_out = {"Candidate analysis"} if regime == "cot_no_candidate_analysis" else set()
        assert headings == [*(name for name in SECTIONS if name not in left_out), "Answer"]
        for name, start, stop in split_sections(s.rationale):
            if name not in ("Answer", *left_out):
                assert s.rationale[start:stop].strip() in text
        lines = text.splitlines()
        candidates = [line.split()[1] for line in lines if line.startswith("Candidate ") and
                   not line.startswith("Candidate analysis")]  # fmt: skip
        assert candidates == ([] if regime == "cot_no_match_layout" else list(LETTERS))
        assert lines[-1] == answer_line(s.item.letter)


@pytest.mark.parametrize("regime", [*COT, "answer_only"])
def test_both_modes_are_trained_with_the_same_answer(micro_store, regime) -> None:
    by_mode = items_of(micro_store, regime)
    answers = {s.item.item_id: s for s in by_mode["answer"]}
    assert all(s.response == answer_line(s.item.letter) for s in answers.values())
    assert {i.item_id for i in micro_store.selection("train")} == answers.keys()
    for s in by_mode["reasoning"]:
        assert parse_choice(s.response).letter == answers[s.item.item_id].item.letter
        assert instruction(s.mode, regime) != instruction("answer", regime)


def test_responses_are_right_in_every_epochs_order(micro_store) -> None:
    """For every item in the orders of several epochs, the validator accepts the rationale, the
    match lines agree with the predicates, and the answer is the same frame."""
    by_mode = items_of(micro_store, "cot")
    orders = set()
    for s in by_mode["reasoning"] + by_mode["answer"]:
        right = s.item.candidates[s.item.answer]
        for epoch in range(4):
            permuted = s.permuted(0, epoch)
            item = permuted.item
            assert item.candidates[item.answer] == right
            assert sorted(item.candidates, key=repr) == sorted(s.item.candidates, key=repr)
            assert parse_choice(permuted.response).letter == LETTERS[item.candidates.index(right)]
            orders.add(tuple(s.item.candidates.index(c) for c in item.candidates))
            if s.mode == "reasoning":
                predicates = extract_predicates(
                    item, micro_store.scene(item.scene_id), micro_store.scene
                )
                assert (
                    validate_rationale(permuted.rationale, predicates, item, TEACHER).reasons == ()
                )
                matching = [line for line in permuted.matches if " matches: " in line]
                assert [line.split()[1] for line in matching] == [item.letter]
                assert [line.split()[1] for line in permuted.matches] == list(LETTERS)
                analysis = "Candidate analysis: " + "\n".join(permuted.matches)
                verdicts = {c.verdict for c in extract_claims(analysis, predicates)}
                assert "contradicted" not in verdicts
                assert "supported" in verdicts
    assert len(orders) == 24


def test_an_order_depends_on_seed_epoch_and_item(micro_store) -> None:
    first, second = items_of(micro_store, "answer_only")["answer"][:2]

    def orders(s: Supervised, seed: int = 0) -> list[list[int]]:
        permuted = [s.permuted(seed, epoch).item.candidates for epoch in range(8)]
        return [[s.item.candidates.index(c) for c in candidates] for candidates in permuted]

    assert orders(first) == orders(first)
    assert len(set(map(tuple, orders(first)))) > 1
    assert orders(first) != orders(first, seed=1)
    assert orders(first) != orders(second)


def test_samples_follow_the_epoch(micro_store, frames, student_cfg) -> None:
    supervised = items_of(micro_store, "answer_only")["answer"]
    count = student_cfg.frames
    lazy = [
        LazySample(s.text, 1, partial(load_supervised, s, frames, count, 0)) for s in supervised
    ]
    dataset = StudentDataset(lazy)
    responses = []
    for epoch in range(4):
        dataset.set_epoch(epoch)
        responses.append([dataset[k].response for k in range(len(dataset))])
        assert responses[-1] == [s.permuted(0, epoch).response for s in supervised]
    assert responses[0] != responses[1]
    unpermuted = load_supervised(supervised[0], frames, count, None, 3)
    assert unpermuted.response == supervised[0].response


class Names:
    """A store of scene names only."""

    def __init__(self, names: list[str]) -> None:
        self.names = names

    def scene_ids(self, split: str) -> list[str]:
        return self.names


def test_whether_a_scene_is_held_out_depends_on_its_name_only() -> None:
    names = [f"s0-{k:06d}" for k in range(2000)]
    held_out = held_out_scenes(Names(names))
    assert len(held_out) == pytest.approx(HELD_OUT * len(names), rel=0.15)
    assert held_out_scenes(Names(names[:500])) == held_out & set(names[:500])
    assert len(held_out_scenes(Names(names[:1]))) == 1
