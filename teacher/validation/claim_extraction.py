"""Reads what a rationale claims of the scene and of the candidates, by closed vocabulary.

Each claim is held against the predicates. What the words leave open is not guessed at: a claim is
contradicted only where the predicates say otherwise in any reading.
"""

from __future__ import annotations

from teacher.predicates import Predicates
from teacher.reading.candidates import CandidateReader
from teacher.reading.grounding import CUT, EITHER, TARGET, Claim, Ground
from teacher.reading.scenes import SceneReader
from teacher.reading.tagging import Tag, tags
from teacher.sections import split_sections

MOMENTS = {
    "Scene parse": CUT,
    "Motion analysis": EITHER,
    "Prediction": TARGET,
    "Outcome": TARGET,
}
"""What the present tense of a section speaks of."""

MAX_SENTENCE_TAGS = 250
"""Tags of a sentence, beyond which it is cut."""


def extract_claims(text: str, predicates: Predicates) -> tuple[Claim, ...]:
    """The claims of a rationale in order, each with its verdict; never raises."""
    ground = Ground(predicates)
    found: list[Claim] = []
    for name, start, stop in split_sections(text):
        if name == "Answer":
            found += _answer(text, start, stop)
            continue
        scene = SceneReader(text, ground, MOMENTS.get(name, EITHER))
        candidates = CandidateReader(text, ground, lasting=name == "Candidate analysis")
        for sentence in _sentences(tags(text, start, stop)):
            if name == "Candidate analysis" or (
                name == "Outcome" and any(t.tag == "candidate" for t in sentence)
            ):
                found += candidates.read(sentence)
            else:
                found += scene.read(sentence)
    found.sort(key=lambda claim: claim.span)
    return tuple(claim._replace(verdict=ground.verdict(claim)) for claim in found)


def _answer(text: str, start: int, stop: int) -> list[Claim]:
    letter = text[start:stop].strip()
    if len(letter) != 1:
        return []
    at = text.index(letter, start)
    return [Claim("agrees", (), "", True, TARGET, letter, (at, at + 1))]


def _sentences(found: list[Tag]) -> list[list[Tag]]:
    """Sentences, the longest parted: the readers look ahead, and their time is to stay linear."""
    sentences: list[list[Tag]] = [[]]
    for tag in found:
        sentences[-1].append(tag)
        if tag.tag == "stop" or len(sentences[-1]) >= MAX_SENTENCE_TAGS:
            sentences.append([])
    return [s for s in sentences if s]
