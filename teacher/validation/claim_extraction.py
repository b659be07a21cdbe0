"""Extracts the claims of a rationale with a closed vocabulary, and checks them.

An ambiguous claim is contradicted only if the predicates contradict every reading of it.
"""

from __future__ import annotations

from teacher.predicates import Predicates
from teacher.reading.candidates import CandidateReader
from teacher.reading.grounding import CUT, EITHER, TARGET, Claim, Ground
from teacher.reading.scenes import SceneReader
from teacher.reading.tagging import Sentence, Tag, find_tags
from teacher.sections import split_sections

MOMENTS = {
    "Scene parse": CUT,
    "Motion analysis": EITHER,
    "Prediction": TARGET,
    "Outcome": TARGET,
}
"""The moment that a section's present tense refers to."""

MAX_SENTENCE_TAGS = 250
"""Tags after which a sentence is split."""


def extract_claims(text: str, predicates: Predicates) -> tuple[Claim, ...]:
    """The claims of a rationale in order, each with its verdict; never raises."""
    ground = Ground(predicates)
    claims: list[Claim] = []
    for name, start, stop in split_sections(text):
        if name == "Answer":
            claims += _extract_answer(text, start, stop)
            continue
        scene = SceneReader(ground, MOMENTS.get(name, EITHER))
        candidates = CandidateReader(ground, lasting=name == "Candidate analysis")
        for tags in _split_sentences(find_tags(text, start, stop)):
            names_candidate = any(tag.tag == "candidate" for tag in tags)
            if name == "Candidate analysis" or (name == "Outcome" and names_candidate):
                claims += candidates.read(Sentence(text, tags))
            else:
                claims += scene.read(Sentence(text, tags))
    claims.sort(key=lambda claim: claim.span)
    return tuple(claim._replace(verdict=ground.verdict(claim)) for claim in claims)


def _extract_answer(text: str, start: int, stop: int) -> list[Claim]:
    letter = text[start:stop].strip()
    if len(letter) != 1:
        return []
    position = text.index(letter, start)
    return [Claim("agrees", (), "", True, TARGET, letter, (position, position + 1))]


def _split_sentences(section: list[Tag]) -> list[list[Tag]]:
    """Sentences of at most MAX_SENTENCE_TAGS tags. Readers look ahead to the end of a sentence, so
    this bound keeps their time linear in the length of the text."""
    sentences: list[list[Tag]] = [[]]
    for tag in section:
        sentences[-1].append(tag)
        if tag.tag == "stop" or len(sentences[-1]) >= MAX_SENTENCE_TAGS:
            sentences.append([])
    return [s for s in sentences if s]
