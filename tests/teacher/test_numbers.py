"""Detection of numbers in labelled sentences, in prose with inserted numbers, and in adversarial
text."""

from __future__ import annotations

import json
import random
import re
import sys
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import pytest

from dynapix.teacher.narrator import write_facts, write_rationale
from dynapix.teacher.numbers.detection import find_numbers
from tests.scaling import SIZE, is_linear
from tests.teacher.adversarial_text import PIECES, repeat_piece
from tests.teacher.test_predicates import random_cases

FOLDER = Path(__file__).parent / "sentences"


def sentences(kind: str) -> list[str]:
    """Return the sentences in a file of FOLDER, one per line."""
    path = FOLDER / f"{kind}.txt"
    # `splitlines` would also split sentences that contain other line separators.
    return path.read_text(encoding="utf-8").removesuffix("\n").split("\n")


def phrases_by_kind() -> dict[str, list[tuple[str, bool]]]:
    """Return the sentences of kinds.jsonl by kind, each with whether it states a number."""
    kinds: dict[str, list[tuple[str, bool]]] = {}
    for line in (FOLDER / "kinds.jsonl").read_text(encoding="utf-8").splitlines():
        entry = json.loads(line)
        kinds.setdefault(entry["kind"], []).append((entry["text"], entry["number"]))
    return kinds


POSITIVE, NEGATIVE = sentences("positive"), sentences("negative")
KINDS = phrases_by_kind()
NUMBER_PHRASES = """
[3]|[0.4] units|frame [63]|[1,200]|[12]-[40]|[30]%|the [2nd] collision|[3]D|v[2]|[½]|[¾]|r[²]
[③]|[Ⅳ]|[٣]|[五]|[𝟗]|[&#51;]|[&amp;#50;]|[&frac12;]|[5️⃣]|[🥈]|[🕒]|[⚃]
[two] spheres|[three]|[twenty-one]|[two hundred]|[zero]|[nil]|a [dozen]|[thousands]
[zero] point [five]|the [second] collision|the [third] region|the [first] collision|[nth]
[secondly]|[half]|[quarter]|[two]-[thirds]|[twice]|[double]|[threefold]|a [couple] of cubes
a [trio]|a [single] cube|[percent]|for some [seconds]|a [minute] later|a [few frames] later
[several times]|and [one] sphere|exactly [one] cube|only [once]|phase [II]|[iv]|[t w o]|[t-w-o]
[t_w_o]|[tw-o]|[tw o]|[th.ree]|[twooo]|[t**w**o]|**[two]**|[t<b>w</b>o]|[t\u200bw\u200bo]
[tw\u043e]|[\uff54\uff57\uff4f]|[\u24e3\u24e6\u24de]|[TWO]|[twoSpheres]|[twospheres]
[dos]|[deux]|[zwei]|[cinque]|[três]|[twee]|[два]|[пять]|[τρία]|[셋]
the [Vth] frame|a [quad]|[三个]|[几秒]
""".strip().replace("\n", "|")
"""Phrases that state a number, separated by "|"; the part to be detected is in brackets."""


@cache
def narrator_texts(count: int) -> list[str]:
    """Return texts of the built-in narrator in both vocabularies: rationales, and all facts."""
    cases = [*random_cases(count), *random_cases(count, relational=True)]
    return [
        text
        for item, predicates in cases
        for text in (write_rationale(predicates, item, seed=5), write_facts(predicates, item))
    ]


def free_texts() -> list[str]:
    """Return rationales in free prose."""
    return (FOLDER / "rationales.txt").read_text().strip().split("\n\n")


def spots(text: str) -> Iterator[int]:
    """Yield positions where a phrase can be inserted: white space and the ends of sentences."""
    yield from (m.start() for m in re.finditer(r"\s|(?<=\.)(?=\s)|\Z", text))


def detect(text: str) -> list[str]:
    return [text[start:stop] for start, stop in find_numbers(text)]


def assert_spans_are_valid(text: str) -> None:
    """Assert that spans are ordered, disjoint and inside the text, and numbers on their own."""
    last = 0
    for start, stop in find_numbers(text):
        assert last <= start < stop <= len(text)
        assert last < start or start == 0, ascii(text)
        assert find_numbers(text[start:stop]) == [(0, stop - start)], ascii(text[start:stop])
        last = stop


def test_recall_and_precision_on_unseen_sentences() -> None:
    """The sentences were written by somebody who had not seen the rules."""
    positive, negative = sentences("unseen_positive"), sentences("unseen_negative")
    detected = sum(bool(find_numbers(sentence)) for sentence in positive)
    false_alarms = sum(bool(find_numbers(sentence)) for sentence in negative)
    assert min(len(positive), len(negative)) >= 150
    assert detected / len(positive) >= 0.97
    assert detected / (detected + false_alarms) >= 0.95


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_kind_of_phrase(kind: str) -> None:
    """Phrases that are hard to tell apart, because some of their kind state a number."""
    wrong = [text for text, is_number in KINDS[kind] if bool(find_numbers(text)) != is_number]
    assert wrong == []


def test_every_positive_sentence_is_detected():
    assert len(POSITIVE) >= 150
    assert [text for text in POSITIVE if not find_numbers(text)] == []


def test_no_negative_sentence_is_detected():
    assert len(NEGATIVE) >= 150
    assert [(text, detect(text)) for text in NEGATIVE if find_numbers(text)] == []


@pytest.mark.parametrize(
    ("text", "stated"),
    [
        ("a twenty-one b", "twenty-one"),
        ("x t<b>w</b>o y", "t<b>w</b>o"),
        ("say &#51; now", "&#51;"),
        ("é, then zwölf", "zwölf"),
        ("a few frames later", "few frames"),
        ("two hundred", "two hundred"),
        ("the 5️⃣ key", "5️⃣"),
        ("\ufdfa, \u0301 t\u200bw\u200bo!", "t\u200bw\u200bo"),
    ],
)
def test_spans_index_the_original(text, stated):
    (span,) = find_numbers(text)
    assert text[slice(*span)] == stated


@pytest.mark.parametrize(
    ("text", "stated"),
    [("The wider one moves.", ""), ("There is a bluer one.", ""), ("They shed one.", "one")],
)
def test_one_is_a_pronoun_after_an_adjective_with_an_article(text, stated):
    assert "".join(text[slice(*span)] for span in find_numbers(text)) == stated


@pytest.mark.parametrize("phrase", NUMBER_PHRASES.split("|"))
def test_inserted_number_is_detected(phrase):
    plain = phrase.replace("[", "").replace("]", "")
    parts = [m.span(1) for m in re.finditer(r"\[(.*?)\]", phrase)]
    # Each bracket before a part shifts it by one.
    parts = [(start - 2 * k - 1, stop - 2 * k - 1) for k, (start, stop) in enumerate(parts)]
    for text in (narrator_texts(2)[-1], random.Random(phrase).choice(free_texts())):
        for spot in spots(text):
            changed = f"{text[:spot]} {plain}{text[spot:]}"
            spans = find_numbers(changed)
            for start, stop in parts:
                first, last = spot + 1 + start, spot + 1 + stop
                assert any(a <= first and last <= b for a, b in spans), ascii(changed[spot:][:60])


def test_prose_without_numbers():
    for text in (*narrator_texts(40), *free_texts()):
        assert detect(text) == []


def test_spans_of_random_text_are_valid():
    rng = random.Random(0)
    hard = [text for phrases in KINDS.values() for text, _ in phrases]
    words = " ".join((*POSITIVE, *NEGATIVE, *hard)).split(" ")
    letters = [*"aonetwIVXi <>&;#*_`~|!@$-.,'()\n0123", "\u200b", "\u0301", "\ud800", "\U0001f1e6"]
    for _ in range(800):
        pieces = [
            rng.choice((rng.choice(letters), rng.choice(words), chr(rng.randrange(0x110000)), " "))
            for _ in range(rng.randrange(60))
        ]
        assert_spans_are_valid("".join(pieces))
        assert_spans_are_valid(" ".join(rng.choices(words, k=20)))


@pytest.mark.slow
def test_no_character_raises():
    for start in range(0, sys.maxunicode + 1, 1 << 12):
        find_numbers("".join(map(chr, range(start, start + (1 << 12)))))


@pytest.mark.parametrize("piece", PIECES, ids=ascii)
def test_time_is_linear_in_adversarial_text(piece):
    assert is_linear(find_numbers, partial(repeat_piece, piece))
    text = repeat_piece(piece, SIZE)
    assert all(0 <= start < stop <= len(text) for start, stop in find_numbers(text))


def test_quadratic_time_is_detected():
    search = re.compile("a+$").search
    assert not is_linear(search, lambda size: "a" * size + "b", size=1000)
