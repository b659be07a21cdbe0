"""Cited rationales: slots filled with facts, and words around them that state nothing."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.data.records import LETTERS
from dynapix.teacher.cited_rationales import (
    CITED_VERSION,
    PREFIXES,
    CitationError,
    cited_schema,
    compose_rationale,
    list_facts,
)
from dynapix.teacher.journal import read_rationales
from dynapix.teacher.narrate import narrate_store
from dynapix.teacher.predicates.vocabulary import describe_item, name_vocabulary
from dynapix.teacher.prompts import build_messages
from dynapix.teacher.validation.claim_extraction import extract_claims
from dynapix.teacher.validation.sufficiency import measure_sufficiency
from dynapix.teacher.validation.validator import validate_rationale
from tests.teacher.faulty_server import FaultyServer, teacher_at
from tests.teacher.memory_store import MemoryStore
from tests.teacher.test_predicates import random_cases

CFG = TeacherConfig(name="template", min_words=20)
ARGUMENTS: dict[str, Any] = {"url": "http://a/v1", "model": "m"}
Cited = dict[str, list[dict[str, Any]]]


def cite_all(facts: dict[str, str]) -> Cited:
    """A response that cites every fact in a sentence of its own."""
    by_section = {
        name: [{"text": "Hence {}.", "facts": [key]} for key in facts if key[:1] == prefix]
        for name, prefix in PREFIXES.items()
    }
    analysis = [{"text": "{}", "facts": [letter]} for letter in LETTERS]
    ordered = {**by_section, "Candidate analysis": analysis}
    return {name: ordered[name][:8] for name in cited_schema()["required"]}


@pytest.mark.parametrize("relational", [False, True], ids=["paper", "relational"])
def test_cited_rationales_are_true_whatever_they_cite(relational: bool) -> None:
    for item, predicates in random_cases(40, relational):
        facts = list_facts(predicates, item)
        text = compose_rationale(json.dumps(cite_all(facts)), facts, predicates.answer)
        assert [r for r in validate_rationale(text, predicates, item, CFG).reasons
                if r != "too long"] == [], text  # fmt: skip
        if relational:
            claims = extract_claims(text, predicates)
            assert measure_sufficiency(text, claims, predicates) > 0.2


def test_slots_are_filled_in_order() -> None:
    facts = {"s1": "the red cube rests", "s2": "the ball rolls", **dict.fromkeys("mpr", ""),
             "m1": "m", "p1": "p", "r1": "r", "A": "a", "B": "b", "C": "c", "D": "d"}  # fmt: skip
    cited = cite_all({k: v for k, v in facts.items() if v})
    cited["Scene parse"] = [{"text": "since {}, and as {}", "facts": ["s2", "s1"]}]
    first, *_, last = compose_rationale(json.dumps(cited), facts, "C").splitlines()
    assert first == "Scene parse: Since the ball rolls, and as the red cube rests."
    assert last == "Answer: C"


def change(section: str, sentence: dict[str, Any]) -> Callable[[Cited], None]:
    def apply(cited: Cited) -> None:
        cited[section][0] = sentence

    return apply


@pytest.mark.parametrize(
    ("mutate", "reason"),
    [
        (change("Scene parse", {"text": "the red cube, {}", "facts": ["s1"]}), "outside slots"),
        (change("Scene parse", {"text": "{} near the left", "facts": ["s1"]}), "outside slots"),
        (change("Scene parse", {"text": "{} left", "facts": ["s1"]}), "outside slots: 'left'"),
        (change("Scene parse", {"text": "{} to the north", "facts": ["s1"]}), "outside slots"),
        (change("Prediction", {"text": "it is false that {}", "facts": ["p1"]}), "'false'"),
        (change("Prediction", {"text": "unless {}", "facts": ["p1"]}), "outside slots"),
        (change("Prediction", {"text": "twice {}", "facts": ["p1"]}), "'twice'"),
        (change("Prediction", {"text": "A agrees, {}", "facts": ["p1"]}), "outside slots"),
        (change("Prediction", {"text": "{} and {}", "facts": ["p1"]}), "2 slots for 1 facts"),
        *(
            (change("Outcome", {"text": text, "facts": ["r1"]}), "outside slots")
            for text in (
                "the crimson orb makes {}",
                "so the leader overtakes and {}",
                "it bounces, hence {}",
                "it vanishes, so {}",
                "the box is ahead, so {}",
                "{} (as B)",
                "{}, as in A",
            )
        ),
        (change("Prediction", {"text": "{}", "facts": ["p99"]}), "unknown fact: p99"),
        (change("Prediction", {"text": "{}", "facts": ["s1"]}), "not a cited rationale"),
        (change("Candidate analysis", {"text": "{}", "facts": ["B"]}), "candidates out of order"),
        (lambda cited: cited.pop("Outcome"), "not a cited rationale"),
        (lambda cited: cited.update(Extra=[]), "not a cited rationale"),
        (change("Outcome", {"text": "{x} {}", "facts": ["r1"]}), "not a cited rationale"),
        (change("Outcome", {"text": "so it is", "facts": ["r1"]}), "not a cited rationale"),
        (change("Outcome", {"text": f"so {'so ' * 20}{{}}", "facts": ["r1"]}), "not a cited"),
    ],
)
def test_response_that_states_more_than_its_facts_is_refused(
    mutate: Callable[[Cited], Any], reason: str
) -> None:
    item, predicates = next(random_cases(9))
    facts = list_facts(predicates, item)
    cited = cite_all(facts)
    mutate(cited)
    with pytest.raises(CitationError, match=reason.replace("'", ".")):
        compose_rationale(json.dumps(cited), facts, "A")
    with pytest.raises(CitationError, match="not JSON"):
        compose_rationale("Sure! {", facts, "A")


def test_the_schema_allows_no_sentence_without_a_slot() -> None:
    """A server that honours the schema then cannot return one."""
    for sentences in cited_schema()["properties"].values():
        pattern = re.compile(sentences["items"]["properties"]["text"]["pattern"])
        for text in ("{}", "so {} and {}", "{}{}{}", f"{'a' * 40}{{}}{'a' * 40}"):
            assert pattern.search(text)
        for text in ("", "it follows", "{}{}{}{}", "{", "{a}", "{}}", f"{'a' * 41}{{}}"):
            assert not pattern.search(text)


def test_server_is_asked_for_cited_rationales(
    store: MemoryStore, start_server: Callable[..., FaultyServer]
) -> None:
    server = start_server()
    cfg = teacher_at(server, form="cited", predicates="relational", min_words=20)
    for item in store.selection():
        predicates = describe_item(item, store, cfg)
        if predicates is not None:
            _, user = build_messages(predicates, item, cfg)
            response = json.dumps(cite_all(list_facts(predicates, item)))
            server.rationales[user["content"]] = response
    narration = narrate_store(store, cfg)
    assert narration.figures["accepted"] == 12
    assert all(r.predicates == name_vocabulary(cfg) for r in narration.rationales)
    assert all("{" not in r.text for r in narration.rationales)
    assert server.requests[0]["response_format"]["json_schema"]["schema"] == cited_schema()
    assert {r.grammar for r in narration.rationales} == {f"cited {CITED_VERSION}"}


def test_response_that_is_not_cited_is_rejected_with_the_reason(
    store: MemoryStore, start_server: Callable[..., FaultyServer]
) -> None:
    server = start_server()
    narrate_store(store, teacher_at(server, form="cited", attempts=1))
    rationales = read_rationales(store.folder / "rationales.jsonl")
    assert {r.reasons for r in rationales} == {("cited: not JSON",)}


def test_cited_form_needs_a_server_and_no_grammar() -> None:
    [problem] = TeacherConfig(name="t", form="cited").check("teacher.")
    assert "teacher.form=cited needs a server" in problem
    [problem] = TeacherConfig(name="t", form="cited", grammar=True, **ARGUMENTS).check("teacher.")
    assert "leave out grammar" in problem
