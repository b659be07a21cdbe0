"""Credit for claims: the parts of the tokens sum to the reward."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from transformers import PreTrainedTokenizerBase

from dynapix.conf.schema import TeacherConfig
from dynapix.data.store import Store
from dynapix.teacher.narrator import write_match_lines, write_rationale
from dynapix.teacher.predicates.facts import REGIONS
from dynapix.teacher.predicates.vocabulary import describe_item
from dynapix.train.on_policy.claim_credit import credit_tokens, find_spans
from dynapix.train.rewards import JudgedResponse, credit_claims, judge_response, reward_truth

TEACHER = TeacherConfig(name="template", predicates="relational")


def responses(store: Store) -> Iterator[JudgedResponse]:
    """Narrations, the same with false regions, with each sentence twelve times, and cut off."""
    for item in store.selection("train")[:5]:
        facts = describe_item(item, store, TEACHER)
        if facts is None:
            continue
        text = "\n".join([write_rationale(facts, item, 0), *write_match_lines(facts, item)])
        false = text.replace(REGIONS[1][1], REGIONS[0][0]).replace("will be", "will not be")
        name = facts.objects[0].object
        often = text + f"\nOutcome: {f'The {name} is near the top. ' * 12}"
        for each in (text, false, often, text[:300], "Prediction: é → ∞.", ""):
            yield judge_response(each, False, item, facts)


def sampled_ids(text: str, tokenizer: PreTrainedTokenizerBase) -> list[list[int]]:
    """Tokens of a text: those of the tokenizer with the end of a turn, and those of each letter."""
    encode = lambda part: tokenizer(part, add_special_tokens=False)["input_ids"]  # noqa: E731
    return [[*encode(text), tokenizer.eos_token_id], [k for x in text for k in encode(x)]]


def test_the_credits_of_tokens_sum_to_the_reward(micro_store: Store, processor) -> None:
    signs = set()
    for response in responses(micro_store):
        credits = credit_claims(response)
        signs |= {credit > 0 for _, credit in credits}
        for ids in sampled_ids(response.text, processor.tokenizer):
            found = credit_tokens(response, ids, processor.tokenizer)
            assert found.shape == (len(ids),)
            assert found.sum().item() == pytest.approx(reward_truth(response), abs=1e-5)
            # Tokens without a claim get nothing.
            starts, stops = find_spans(response.text, ids, processor.tokenizer)
            for start, stop, credit in zip(starts, stops, found, strict=True):
                claimed = any(c.span[0] < stop and c.span[1] > start for c, _ in credits)
                assert claimed or credit == 0
    assert signs == {True, False}


def test_a_false_claim_costs_its_tokens(micro_store: Store, processor) -> None:
    checked = 0
    for response in responses(micro_store):
        credits = credit_claims(response)
        ids, _ = sampled_ids(response.text, processor.tokenizer)
        found = credit_tokens(response, ids, processor.tokenizer)
        starts, stops = find_spans(response.text, ids, processor.tokenizer)
        for k, (claim, credit) in enumerate(credits):
            inside = (starts < claim.span[1]) & (stops > claim.span[0])
            others = [c.span for c, _ in credits[:k] + credits[k + 1 :]]
            if not any(((starts < b) & (stops > a) & inside).any() for a, b in others):
                assert torch.sign(found[inside]).unique().tolist() == [1 if credit > 0 else -1]
                checked += 1
    assert checked > 100


def test_spans_cover_a_text(processor) -> None:
    text = "The red cube is naïve → near the top."
    for ids in sampled_ids(text, processor.tokenizer):
        starts, stops = find_spans(text, ids, processor.tokenizer)
        assert starts[0] == 0
        assert stops[-1] == len(text)
        assert torch.equal(starts[1:], stops[:-1])
