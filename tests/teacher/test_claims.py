"""Claims of rationales: false ones are contradicted, true ones are not.

facts.json has predicates, FACTS.
claims.txt has sentences about FACTS, each with its truth and the letter of its section.
claim_verdicts.jsonl has sentences about FACTS with the verdict on each claim.
prose.jsonl has rationales by a language model, with the predicates in their prompts.
"""

import json
from pathlib import Path
from random import Random

import pytest

from benchmarks.experiments.mutations import MUTATIONS, parse_predicates
from conf.schema import TeacherConfig
from teacher.narrator import write_rationale
from teacher.predicates import extract_predicates
from teacher.reading.phrases import PHRASES
from teacher.sections import SECTIONS
from teacher.validation.claim_extraction import extract_claims
from teacher.validation.validator import validate_rationale

HERE = Path(__file__).parent
SECTION = {"S": SECTIONS[0], "M": SECTIONS[1], "P": SECTIONS[2], "C": SECTIONS[3], "O": SECTIONS[4]}
RED, BLUE = "red metal cube", "blue rubber sphere"
FACTS = parse_predicates(json.loads((HERE / "facts.json").read_text()))
CASES = [line.split(" ", 2) for line in (HERE / "claims.txt").read_text().splitlines()]
VERDICTS = [json.loads(line) for line in (HERE / "claim_verdicts.jsonl").read_text().splitlines()]
PROSE = [json.loads(line) for line in (HERE / "prose.jsonl").read_text().splitlines()]


def contradicted(text, predicates):
    return [str(c) for c in extract_claims(text, predicates) if c.verdict == "contradicted"]


def verdicts(section, sentence):
    claims = extract_claims(f"{SECTION[section]}: {sentence}", FACTS)
    return {str(c): c.verdict for c in claims if c.kind != "mention"}


@pytest.mark.parametrize(("truth", "section", "sentence"), CASES)
def test_only_false_sentences_are_contradicted(truth, section, sentence):
    detected = contradicted(f"{SECTION[section]}: {sentence}", FACTS)
    assert bool(detected) == (truth == "false"), detected


@pytest.mark.parametrize("case", VERDICTS, ids=lambda case: case["sentence"])
def test_subject_and_polarity_of_claims(case):
    assert verdicts(case["section"], case["sentence"]) == case["claims"]


def test_ambiguous_pronoun_is_not_resolved():
    sentence = f"The {RED} is close to the {BLUE} and it is near the bottom."
    assert "contradicted" not in verdicts("P", sentence).values()


@pytest.mark.parametrize(
    ("section", "plain", "ambiguous"),
    [
        ("S", "The {0} is near the top.", "The {0} recalls somebody near the top."),
        ("S", "The {0} heads west.", "The {0} meets the {1} and heads west."),
        ("C", "Candidate B lacks the {0}.", "Candidate B lacks others, ones unlike the {0}."),
        ("C", "Candidate D agrees.", "Candidate D is off; with candidate B, everything agrees."),
    ],
)
def test_ambiguous_claims_are_not_contradicted(section, plain, ambiguous):
    detected = verdicts(section, plain.format(RED, BLUE))
    assert "contradicted" in detected.values()
    assert "contradicted" not in verdicts(section, ambiguous.format(RED, BLUE)).values()


def test_most_claims_of_true_sentences_are_supported():
    detected = [
        v for truth, s, text in CASES if truth == "true" for v in verdicts(s, text).values()
    ]
    assert detected.count("supported") > 0.9 * len(detected) > 200


def test_spans_of_claims():
    text = f"Scene parse: The {RED} is near the left.\nOutcome: B is right.\nAnswer: B"
    spans = {(c.kind, text[slice(*c.span)]) for c in extract_claims(text, FACTS)}
    assert ("region", "near the left") in spans
    assert ("mention", f"The {RED}") in spans
    assert ("agrees", "B") in spans


@pytest.fixture(scope="module")
def narrated(benchmark_store):
    """Training items of the benchmark with predicates and the narrator's rationales."""
    detected = []
    for item in benchmark_store.selection("train"):
        scene = benchmark_store.scene(item.scene_id)
        predicates = extract_predicates(item, scene, benchmark_store.scene)
        if predicates is not None:
            detected.append((item, predicates, write_rationale(predicates, item, seed=1)))
    assert len(detected) > 30
    return detected


@pytest.mark.slow
def test_no_claim_of_the_narrator_is_contradicted(narrated):
    for _, predicates, text in narrated:
        assert contradicted(text, predicates) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", MUTATIONS)
def test_false_word_of_the_narrator_is_contradicted(narrated, kind):
    detected = []
    for item, predicates, text in narrated:
        for false, _ in MUTATIONS[kind](text, predicates, Random(item.item_id)):
            detected.append(bool(contradicted(false, predicates)))
    assert sum(detected) >= 0.97 * len(detected) > 20


def test_no_true_claim_of_a_language_model_is_contradicted():
    for record in PROSE:
        assert contradicted(record["text"], parse_predicates(record["predicates"])) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["direction", "region", "speed", "color", "pair", "answer"])
def test_false_word_in_prose_is_contradicted(kind):
    detected = []
    for record in PROSE:
        predicates = parse_predicates(record["predicates"])
        edits = MUTATIONS[kind](record["text"], predicates, Random(record["item_id"]))
        detected += [bool(contradicted(text, predicates)) for text, _ in edits]
    assert sum(detected) >= 0.97 * len(detected) > 20


@pytest.mark.slow
def test_extraction_never_raises_and_is_deterministic():
    rng = Random(0)
    words = [*PHRASES, RED, BLUE, "the red cube", "A", "B", "Candidate D", "near the top", "both"]
    words += [*",.;:()—’'\n", "it", "they", "Outcome: ", "Answer: ", "\nPrediction: ", "", "“", "é"]
    for length in (0, 1, 2, 3, 5, 8, 20, 60, 200) * 40:
        body = " ".join(rng.choice(words) for _ in range(length))
        for section in SECTIONS:
            text = f"{section}: {body}"
            assert extract_claims(text, FACTS) == extract_claims(text, FACTS)
    for section in SECTIONS:
        extract_claims(f"{section}: " + f"the {RED} and A, " * 5000, FACTS)


@pytest.mark.slow
def test_validator_rejects_contradictions_and_returns_claims(narrated):
    cfg = TeacherConfig(name="template")
    item, predicates, text = narrated[0]
    verdict = validate_rationale(text, predicates, item, cfg)
    assert verdict.accepted
    assert {c.verdict for c in verdict.claims} <= {"supported", "unknown"}
    assert sum(c.verdict == "supported" for c in verdict.claims) > 20
    text, _ = next(MUTATIONS["color"](text, predicates, Random(0)))
    false = validate_rationale(text, predicates, item, cfg)
    assert not false.accepted
    assert {reason.split(":")[0] for reason in false.reasons} == {"contradicts"}
