"""The items, frames and responses that the page shows."""

from __future__ import annotations

import base64
import io
from collections import defaultdict

import numpy as np
import pytest
from PIL import Image

from dynapix.data.records import LETTERS
from dynapix.evaluation.metrics.reasons import item_predicates, read_reasons
from dynapix.evaluation.reporting import item_results
from dynapix.evaluation.reporting.run_responses import nearest_candidates, parse_response


@pytest.fixture(scope="module")
def items(micro_store):
    return micro_store.selection("train")


@pytest.fixture(scope="module")
def responses(items):
    """The responses of two models that choose letters at random."""
    rng = np.random.default_rng(5)
    return {
        label: {
            i.item_id: parse_response(f"Answer: {rng.choice([*LETTERS])}", False) for i in items
        }
        for label in ("one", "other")
    }


def ids_by_verdict(items, responses):
    """Return the item ids by (family, subtype, model, whether the answer is correct)."""
    found = defaultdict(set)
    for item in items:
        for label, of_model in responses.items():
            correct = of_model[item.item_id].letter == item.letter
            found[item.family, item.subtype, label, correct].add(item.item_id)
    return found


def test_chosen_items_cover_correct_and_wrong_answers_of_every_subtype(items, responses):
    one = {"one": responses["one"]}
    expected = ids_by_verdict(items, one)
    chosen = item_results.choose_items(items, one, len(expected), 0)
    assert len({i.item_id for i in chosen}) == len(chosen) == len(expected)
    assert ids_by_verdict(chosen, one).keys() == expected.keys()
    both = item_results.choose_items(items, responses, len(expected), 0)
    covered = len(ids_by_verdict(both, responses))
    assert covered > 0.8 * len(ids_by_verdict(items, responses))
    assert item_results.choose_items(items, responses, len(expected), 0) == both
    assert item_results.choose_items(items, responses, len(expected), 1) != both
    everything = item_results.choose_items(items, responses, 10**6, 0)
    assert {i.item_id for i in everything} == {i.item_id for i in items}
    assert item_results.choose_items(items, responses, 0, 0) == []


def test_every_shown_frame_is_encoded_as_a_small_image(micro_store, items):
    few = [*items[:6], items[0]]
    frames, errors = item_results.encode_frames(few, micro_store)
    assert errors == []
    entries = list(item_results.page_entries(few, {}, micro_store, "micro", {}))
    names = {n for e in entries for n in (*e["prefix"], *(c["frame"] for c in e["candidates"]))}
    assert names == frames.keys()
    for url in frames.values():
        kind, _, content = url.partition(",")
        assert kind == "data:image/webp;base64"
        image = Image.open(io.BytesIO(base64.b64decode(content)))
        assert (image.format, image.width) == ("WEBP", item_results.FRAME_WIDTH)
        assert len(content) < 12_000
    target = f"{micro_store.name}/{few[0].scene_id}/{few[0].target_frame}"
    assert entries[0]["candidates"][few[0].answer]["frame"] == target


@pytest.mark.parametrize(
    ("text", "verdict"),
    [
        ("Answer: {right}", "correct"),
        ("Answer: {wrong}", "wrong"),
        ("I cannot tell.", "unparsed"),
        ("", "unparsed"),
    ],
)
def test_the_verdict_on_a_response_is_that_of_its_parsed_answer(micro_store, items, text, verdict):
    item = items[0]
    wrong = next(letter for letter in LETTERS if letter != item.letter)
    response = parse_response(text.format(right=item.letter, wrong=wrong), False)
    [entry] = item_results.page_entries(
        [item], {"one": {item.item_id: response}}, micro_store, "micro", {}
    )
    [shown] = entry["responses"]
    assert (shown["model"], shown["verdict"]) == ("one", verdict)
    assert (shown["letter"] is None) == (verdict == "unparsed")
    assert entry["truth"][0].startswith(f"{item.letter} is correct: frame {item.target_frame}")


def test_the_facts_of_an_item_contradict_no_claim_that_they_make(micro_store, items):
    described = {item: item_results.list_oracle_facts(item, micro_store) for item in items[:20]}
    assert any(described.values())
    for item, facts in described.items():
        assert bool(facts) == (item_predicates(item, micro_store) is not None)
        analysis = [fact for fact in facts if fact.startswith("candidate ")]
        text = "Candidate analysis: " + " ".join(f"C{fact[1:]}." for fact in analysis)
        reasons = read_reasons(item, text, None, micro_store)
        claims = reasons.claims["candidates"] if reasons else []
        assert bool(claims) == bool(facts)
        assert not any(claim.verdict == "contradicted" for claim in claims)


def test_tied_candidates_share_the_credit():
    tie = nearest_candidates([0.5, 0, 0.5, 0.25])
    assert [tie.credit(x) for x in LETTERS] == [0.5, 0, 0.5, 0]
    assert (tie.letter, tie.reason) == (None, "several")
    assert tie.text == "A 0.5000, B 0.0000, C 0.5000, D 0.2500"
