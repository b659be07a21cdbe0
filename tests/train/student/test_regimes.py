"""The responses of each regime, and that they stay correct if the candidates are permuted."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from dynapix.conf.schema import SftCommand, SftTrainConfig, TeacherConfig
from dynapix.conf.schema.training import REGIMES
from dynapix.data.records import LETTERS
from dynapix.data.store import Store
from dynapix.models.student.answer_parser import parse_choice
from dynapix.models.student.collator import encode
from dynapix.models.student.prompts import answer_line, choose_instruction
from dynapix.models.tiny_qwen3_vl import build_processor
from dynapix.teacher.narrate import ensure_rationales
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.sections import SECTIONS, split_sections
from dynapix.teacher.validation.claim_extraction import extract_claims
from dynapix.teacher.validation.validator import validate_rationale
from dynapix.train.student.dataset import (
    SupervisedItem,
    load_datasets,
    supervised_items,
    tokenizer_corpus,
)
from dynapix.train.student.samples import StudentDataset

TEACHER = TeacherConfig(name="template")
COT = [r for r in REGIMES if r != "answer_only"]


def items_of(store: Store, regime: str) -> dict[str, list[SupervisedItem]]:
    rationales = {r.item_id: r for r in ensure_rationales(store, TEACHER)}
    return supervised_items(store, store.selection("train"), rationales, regime, TEACHER)


@pytest.mark.parametrize("regime", COT)
def test_a_regime_leaves_out_only_the_part_that_it_names(micro_store, regime) -> None:
    supervised = items_of(micro_store, regime)["reasoning"]
    assert supervised
    left_out = {"Candidate analysis"} if regime == "cot_no_candidate_analysis" else set()
    for s in supervised:
        headings = [name for name, _, _ in split_sections(s.response)]
        assert headings == [*(name for name in SECTIONS if name not in left_out), "Answer"]
        for name, start, stop in split_sections(s.rationale):
            if name not in ("Answer", *left_out):
                assert s.rationale[start:stop].strip() in s.response
        lines = s.response.splitlines()
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
        assert choose_instruction(s.mode, regime) != choose_instruction("answer", regime)


def test_permuted_responses_are_correct(micro_store) -> None:
    """For every item and several epochs, the validator accepts the permuted rationale, the match
    lines agree with the predicates, and the answer is still the target frame."""
    by_mode = items_of(micro_store, "cot")
    orders = set()
    for s in by_mode["reasoning"] + by_mode["answer"]:
        target = s.item.candidates[s.item.answer]
        for epoch in range(4):
            permuted = s.permuted(0, epoch)
            item = permuted.item
            assert item.candidates[item.answer] == target
            assert sorted(item.candidates, key=repr) == sorted(s.item.candidates, key=repr)
            assert parse_choice(permuted.response).letter == LETTERS[item.candidates.index(target)]
            orders.add(tuple(s.item.candidates.index(c) for c in item.candidates))
            if s.mode == "reasoning":
                scene = micro_store.scene(item.scene_id)
                predicates = extract_predicates(item, scene, micro_store.scene)
                checked = validate_rationale(permuted.rationale, predicates, item, TEACHER)
                assert checked.reasons == ()
                matching = [line for line in permuted.matches if " matches: " in line]
                assert [line.split()[1] for line in matching] == [item.letter]
                assert [line.split()[1] for line in permuted.matches] == list(LETTERS)
                analysis = "Candidate analysis: " + "\n".join(permuted.matches)
                verdicts = {c.verdict for c in extract_claims(analysis, predicates)}
                assert "contradicted" not in verdicts
                assert "supported" in verdicts
    assert len(orders) == 24


def test_an_order_depends_on_seed_epoch_and_item(micro_store, frames, student_cfg) -> None:
    supervised = items_of(micro_store, "answer_only")["answer"]

    def orders(s: SupervisedItem, seed: int = 0) -> list[list[int]]:
        permuted = [s.permuted(seed, epoch).item.candidates for epoch in range(8)]
        return [[s.item.candidates.index(c) for c in candidates] for candidates in permuted]

    first, second, *_ = map(orders, supervised)
    assert first == orders(supervised[0])
    assert len(set(map(tuple, first))) > 1
    assert first != orders(supervised[0], seed=1)
    assert first != second
    for permute in (True, False):
        seed = 0 if permute else None
        dataset = StudentDataset(
            [s.lazy_sample(frames, student_cfg.frames, seed) for s in supervised]
        )
        dataset.set_epoch(1)
        for k, s in enumerate(supervised):
            expected = s.permuted(0, 1) if permute else s
            assert dataset[k].response == expected.response


def test_repeated_answers_have_orders_of_their_own(micro, micro_store, student_cfg) -> None:
    train = SftTrainConfig(answers=3, permute_candidates=True, validation_items=8)
    cfg = SftCommand(benchmark=micro, student=student_cfg, teacher=TEACHER, train=train)
    rationales = list(ensure_rationales(micro_store, TEACHER))
    repeated, validation = load_datasets(cfg, micro_store, rationales)
    once = load_datasets(replace(cfg, train=replace(train, answers=1)), micro_store, rationales)
    counts = Counter(s.item_id.partition("/")[0] for s in repeated.samples)
    for item_id, count in Counter(s.item_id for s in once[0].samples).items():
        # An item without a rationale has answers only.
        assert counts[item_id] == count + 2
    assert {m: len(d) for m, d in validation.items()} == {m: len(d) for m, d in once[1].items()}
    letters = [
        [s.render(0).response for s in repeated.samples if s.item_id.endswith(f"/{k}")]
        for k in (1, 2)
    ]
    assert letters[0] != letters[1]


@pytest.mark.parametrize("patch", [16, 12])
def test_estimated_lengths_differ_as_the_numbers_of_tokens(
    micro_store, frames, student_cfg, patch: int
) -> None:
    """The estimate leaves out what all prompts have, so the differences between samples count."""
    processor = build_processor(tokenizer_corpus(micro_store, []), 1024, 96, patch)
    by_mode = items_of(micro_store, "cot")
    supervised = by_mode["reasoning"][:3] + by_mode["answer"][:3]
    samples = [s.lazy_sample(frames, count) for count in (4, 5, 12) for s in supervised]
    data = StudentDataset(samples)
    unrendered = StudentDataset([replace(sample, render=None) for sample in samples])
    estimates = np.array(unrendered.lengths(processor, student_cfg.image_size))
    size = student_cfg.max_length
    tokens = np.array([len(encode(sample, processor, size).input_ids) for sample in data])
    assert np.ptp(tokens) > 200
    # Timestamps can differ by a few tokens.
    assert np.ptp(estimates - tokens) <= 4
