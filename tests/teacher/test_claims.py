"""Claims of rationales: true claims are not contradicted; false ones are, or their sentence is
unreadable.

facts.json: the predicates of an item, FACTS.
claims.txt: sentences about FACTS. A line has "true" or "false", the letter of a section (a key of
SECTION) and the sentence.
claim_verdicts.jsonl: sentences about FACTS, each with its claims and their verdicts.
paraphrases.jsonl: rationales of the narrator about the items of `marked_items`, paraphrased. A
false one has one false statement, of the named kind. Each part has wordings of its own.
prose.jsonl: rationales written by a language model, with the predicates that it was given.
"""

import json
import re
from collections import Counter
from dataclasses import replace
from itertools import product
from math import dist
from pathlib import Path
from random import Random

import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.extraction import EVENT_MOMENTS
from dynapix.teacher.predicates.facts import REGIONS
from dynapix.teacher.predicates.relations import DISPLACED, describe_distance
from dynapix.teacher.predicates.vocabulary import choose_vocabulary
from dynapix.teacher.reading.tagging import PHRASES_BY_FIRST_WORD
from dynapix.teacher.sections import SECTIONS
from dynapix.teacher.validation.claim_extraction import extract_claims
from dynapix.teacher.validation.mutations import MUTATIONS, RELATION_MUTATIONS
from dynapix.teacher.validation.validator import validate_rationale
from research.experiments.mutations import is_contradicted, parse_predicates, read_rationales
from tests.teacher.marked import marked_items
from tests.teacher.test_predicates import random_cases

HERE = Path(__file__).parent
SECTION = {"S": SECTIONS[0], "M": SECTIONS[1], "P": SECTIONS[2], "C": SECTIONS[3], "O": SECTIONS[4]}
RED, BLUE = "red metal cube", "blue rubber sphere"
FACTS = parse_predicates(json.loads((HERE / "facts.json").read_text()))
CASES = [line.split(" ", 2) for line in (HERE / "claims.txt").read_text().splitlines()]
VERDICTS = [json.loads(line) for line in (HERE / "claim_verdicts.jsonl").read_text().splitlines()]
PARAPHRASES = [json.loads(x) for x in (HERE / "paraphrases.jsonl").read_text().splitlines()]
PROSE = list(read_rationales(HERE / "prose.jsonl"))


def contradicted(text, predicates):
    """Return the claims of a rationale that its predicates contradict."""
    return [str(c) for c in extract_claims(text, predicates) if c.verdict == "contradicted"]


def verdicts(section, sentence):
    """Return the verdict on each claim of a sentence about FACTS, without mentions of objects."""
    claims = extract_claims(f"{SECTION[section]}: {sentence}", FACTS)
    return {str(c): c.verdict for c in claims if c.kind != "mention"}


@pytest.mark.parametrize(("truth", "section", "sentence"), CASES)
def test_only_false_sentences_are_contradicted(truth, section, sentence):
    claims = extract_claims(f"{SECTION[section]}: {sentence}", FACTS)
    detected = [str(claim) for claim in claims if claim.verdict == "contradicted"]
    if truth == "true":
        assert detected == []
    else:
        assert detected or any(claim.kind == "unreadable" for claim in claims)


def test_few_true_paraphrases_are_rejected_and_few_false_ones_accepted():
    """The wordings of the first two parts are known to the reader. Of the last one, not all are:
    there, it misses the goal of 5% for true texts, and meets that of 10% for false ones."""
    items = {item.item_id: (item, predicates) for item, predicates in marked_items()}
    for part, rejected in (("development", 0.05), ("held out", 0.05), ("last", 0.3)):
        accepted = {True: [], False: []}
        for case in (case for case in PARAPHRASES if case["part"] == part):
            item, predicates = items[case["item"]]
            cfg = TeacherConfig(name="t", predicates=case["predicates"], min_words=20)
            vocabulary = choose_vocabulary(predicates, cfg)
            result = validate_rationale(case["text"], vocabulary, item, cfg)
            reasons = [reason for reason in result.reasons if reason != "too long"]
            accepted[case["truth"]].append(not reasons)
        assert len(accepted[True]) == len(accepted[False]) == 40
        assert sum(accepted[True]) > (1 - rejected) * 40
        assert sum(accepted[False]) < 0.1 * 40


def test_unreadable_sentences_are_rejected_unless_told_otherwise():
    item, predicates = next(random_cases(9))
    text = write_rationale(predicates, item, seed=1)
    text = text.replace("\nPrediction:", " Its motion seems rather graceful.\nPrediction:")
    strict, lenient = (TeacherConfig(name="template", strict=strict) for strict in (True, False))
    reasons = validate_rationale(text, predicates, item, strict).reasons
    assert [reason.split(":")[0] for reason in reasons] == ["unreadable"]
    assert "graceful" in reasons[0]
    assert validate_rationale(text, predicates, item, lenient).accepted


@pytest.mark.parametrize("moment", EVENT_MOMENTS.values())
def test_the_moment_of_an_event_does_not_change_what_is_claimed(moment):
    """Although "when" often begins a condition, and "starts" a clause about the past."""
    for section, sentence in (("P", f"the {RED} will be {region}.") for region in REGIONS[0]):
        collision, event = (
            list(verdicts(section, f"{words}, {sentence}".capitalize()).values())
            for words in ("at the collision", moment)
        )
        assert event == collision
        assert event


def test_claims_about_a_name_that_two_objects_share_are_unknown():
    """The text does not tell which of them it means."""
    [red] = [o for o in FACTS.objects if o.object == RED]
    elsewhere = next(o.region for o in FACTS.objects if o.region != red.region)
    text = f"{SECTION['S']}: The {RED} is {elsewhere}."
    twins = replace(FACTS, objects=(*FACTS.objects, replace(red, region=elsewhere)))
    for predicates, verdict in ((FACTS, "contradicted"), (twins, "unknown")):
        [region] = [c for c in extract_claims(text, predicates) if c.kind == "region"]
        assert region.verdict == verdict


@pytest.mark.parametrize("case", VERDICTS, ids=lambda case: case["sentence"])
def test_claims_of_a_sentence_and_their_verdicts(case):
    assert verdicts(case["section"], case["sentence"]) == case["claims"]


@pytest.mark.parametrize(
    ("section", "plain", "ambiguous"),
    [
        ("S", "The {0} is near the top.", "The {0} recalls somebody near the top."),
        ("S", "The {0} heads west.", "The {0} meets the {1}, heading west."),
        ("P", "The {0} is near the bottom.", "The {0} is by the {1} and it is near the bottom."),
        ("C", "Candidate B lacks the {0}.", "Candidate B lacks others, ones unlike the {0}."),
        ("C", "Candidate D agrees.", "Candidate D is off; with candidate B, everything agrees."),
    ],
)
def test_ambiguous_claims_are_not_contradicted(section, plain, ambiguous):
    detected = verdicts(section, plain.format(RED, BLUE))
    assert "contradicted" in detected.values()
    assert "contradicted" not in verdicts(section, ambiguous.format(RED, BLUE)).values()


@pytest.mark.parametrize("verb", ["stops", "slows", "settles", "comes to rest"])
def test_place_where_an_object_stops_is_not_a_claim(verb):
    for sentence in (
        f"The {RED} {verb} near the top, the {BLUE} stays.",
        f"It {verb} near the top.",
    ):
        assert not any("near the top" in claim for claim in verdicts("P", sentence))


def test_most_claims_of_true_sentences_are_supported():
    detected = [
        verdict
        for truth, s, text in CASES
        if truth == "true"
        for claim, verdict in verdicts(s, text).items()
        if claim != "unreadable"
    ]
    assert detected.count("supported") > 0.9 * len(detected) > 400


def test_spans_are_the_words_of_claims():
    text = f"Scene parse: The {RED} is near the left.\nOutcome: B is right.\nAnswer: B"
    spans = {(c.kind, text[slice(*c.span)]) for c in extract_claims(text, FACTS)}
    assert ("region", "near the left") in spans
    assert ("mention", f"The {RED}") in spans
    assert ("agrees", "B") in spans


@pytest.fixture(scope="module")
def rationales(benchmark_store):
    """The item id, text and predicates of each rationale, by who wrote it."""
    folder = benchmark_store.folder
    return {
        "narrator": list(read_rationales(folder)),
        "relational": list(read_rationales(folder, relational=True)),
        "prose": PROSE,
    }


@pytest.mark.slow
@pytest.mark.parametrize("source", ["narrator", "relational", "prose"])
def test_no_true_claim_is_contradicted(rationales, source):
    assert len(rationales[source]) > 30
    for _, text, predicates in rationales[source]:
        assert contradicted(text, predicates) == []
        if source != "prose":
            assert "unreadable" not in {claim.kind for claim in extract_claims(text, predicates)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "kind"),
    [
        *(("narrator", kind) for kind in MUTATIONS),
        # The other words are too rare in free prose.
        *(("prose", kind) for kind in MUTATIONS if kind not in ("time", "candidate")),
    ],
)
def test_false_word_is_contradicted(rationales, source, kind):
    detected = [
        is_detected(false, span, predicates)
        for item_id, text, predicates in rationales[source]
        for false, span in MUTATIONS[kind](text, predicates, Random(item_id))
    ]
    assert sum(detected) >= 0.97 * len(detected) > 20


def is_detected(text, span, predicates):
    """Return whether a claim is contradicted, or the sentence with the span is unreadable."""
    return any(
        claim.verdict == "contradicted"
        or (claim.kind == "unreadable" and claim.span[0] <= span[1] and span[0] < claim.span[1])
        for claim in extract_claims(text, predicates)
    )


@pytest.mark.slow
def test_most_sentences_of_prose_are_read(rationales):
    sentences = unreadable = 0
    for _, text, predicates in rationales["prose"]:
        sentences += len(re.findall(r"[.!?](?=\s)", text))
        unreadable += sum(claim.kind == "unreadable" for claim in extract_claims(text, predicates))
    assert unreadable < 0.55 * sentences


def add_rare_statements(text, predicates):
    """Add true statements that few rationales have: extremes, what is between what, what covers
    what and what is out of sight to the prediction, what objects pass and which edges they reach to
    the motion analysis, and how far off candidates show the objects to the candidate analysis."""
    true = sorted(predicates.target.statements)
    extremes = [f" The {s.objects[0]} will be {s.value}." for s in true if s.kind == "extreme"]
    between = [
        " The {} will be between the {} and the {}.".format(*s.objects)
        for s in true
        if s.kind == "between"
    ]
    covers = [
        f" The {s.objects[0]} will be {s.value} the {s.objects[1]}."
        for s in true
        if s.kind == "cover"
    ]
    unseen = [f" The {s.objects[0]} will be out of sight." for s in true if s.kind == "sight"]
    edges = [f" The {s.objects[0]} {s.value}." for s in true if s.kind == "edge"]
    passed = [
        f" The {s.objects[0]} {s.value} the {s.objects[1]}." for s in true if s.kind == "passing"
    ]
    target = predicates.target.places.image
    off = [
        f" Candidate {view.letter} has the {name} {extent} off."
        for view in predicates.views
        for name in target.keys() & view.places.image.keys()
        if (extent := describe_distance(dist(view.places.image[name], target[name])))
    ]
    text = text.replace("\nOutcome:", f"{''.join(sorted(off))}\nOutcome:")
    text = text.replace("\nPrediction:", f"{''.join(edges + passed)}\nPrediction:")
    return text.replace(
        "\nCandidate analysis:",
        f"{''.join(extremes + between + covers + unseen)}\nCandidate analysis:",
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", RELATION_MUTATIONS)
def test_false_relation_is_contradicted(rationales, kind):
    detected = [
        is_contradicted(false, predicates)
        for item_id, text, predicates in rationales["relational"]
        for false, _ in RELATION_MUTATIONS[kind](
            add_rare_statements(text, predicates), predicates, Random(item_id)
        )
    ]
    assert sum(detected) >= 0.99 * len(detected)
    assert len(detected) > (1 if kind == "edge" else 5)


@pytest.mark.slow
def test_extraction_never_raises_and_is_deterministic():
    rng = Random(0)
    words = [
        *PHRASES_BY_FIRST_WORD,
        RED,
        BLUE,
        "the red cube",
        "A",
        "B",
        "Candidate D",
        "near the top",
        "both",
    ]
    words += [*",.;:()—’'\n", "it", "they", "Outcome: ", "Answer: ", "\nPrediction: ", "", "“", "é"]
    bodies = [
        " ".join(rng.choices(words, k=length)) for length in (0, 1, 2, 3, 5, 8, 20, 60, 200) * 40
    ]
    for section, body in product(SECTIONS, [*bodies, f"the {RED} and A, " * 5000]):
        text = f"{section}: {body}"
        assert extract_claims(text, FACTS) == extract_claims(text, FACTS)


def test_validator_rejects_contradictions():
    cfg = TeacherConfig(name="template")
    item, predicates = next(random_cases(9))
    text = write_rationale(predicates, item, seed=1)
    claims = validate_rationale(text, predicates, item, cfg).claims
    assert sum(claim.verdict == "supported" for claim in claims) > 20
    text, _ = next(MUTATIONS["color"](text, predicates, Random(0)))
    reasons = validate_rationale(text, predicates, item, cfg).reasons
    assert {reason.split(":")[0] for reason in reasons} == {"contradicts"}


NEARNESS = {"right against": "supported", "near": "unknown", "well apart from": "contradicted"}
"""Words for a gap, with their verdicts of two objects that are against each other."""


def verdicts_of(section: str, text: str, predicates, kind: str) -> set[str]:
    claims = extract_claims(f"{SECTION[section]}: {text}", predicates)
    return {claim.verdict for claim in claims if claim.kind == kind}


def test_what_holds_more_strictly_or_later_is_not_contradicted() -> None:
    """A reader of 600 contradicted claims found that such ones were true."""
    found = Counter()
    for _, predicates in random_cases(400, relational=True):
        for kind, names, value in predicates.target.statements:
            if kind == "gap" and value == "against":
                for words, verdict in NEARNESS.items():
                    text = f"The {names[0]} will be {words} the {names[1]}."
                    assert verdicts_of("P", text, predicates, kind) == {verdict}
                    found["near"] += 1
        meetings = [*predicates.courses, *predicates.contacts]
        known = {frozenset(m.objects) for m in meetings}
        for pair in predicates.later:
            if frozenset(pair) not in known:
                text = f"The {pair[0]} and the {pair[1]} are about to meet."
                assert verdicts_of("M", text, predicates, "meeting") == {"unknown"}
                found["later"] += 1
        for m in (m for m in meetings if m.when == "imminent"):
            text = f"Contact between the {m.objects[0]} and the {m.objects[1]} comes"
            assert verdicts_of("M", f"{text} soon.", predicates, "time") == {"unknown"}
            assert verdicts_of("M", f"{text} later.", predicates, "time") == {"contradicted"}
            found["soon"] += 1
        for name, place in [*predicates.target.places.image.items()][:1]:
            for view in predicates.views:
                text = f"The {name} is closest to its expected place in candidate {view.letter}."
                distance = dist(view.places.image.get(name, (9, 9)), place)
                is_close = distance < DISPLACED
                is_right = view.letter == predicates.answer
                verdict = "supported" if is_right else "unknown" if is_close else "contradicted"
                assert verdicts_of("O", text, predicates, "agrees") == {verdict}
                found["closest"] += is_close and not is_right
    assert all(found[kind] > 2 for kind in ("near", "later", "soon", "closest")), found
