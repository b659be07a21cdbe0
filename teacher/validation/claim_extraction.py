"""Extracts the claims of a rationale, and compares each with the predicates.

A claim is a statement that predicates can confirm or refute, such as the region of an object. If
the text is ambiguous, the predicates must contradict every interpretation to contradict the claim.
The package `teacher.reading` describes the steps.
"""

from __future__ import annotations

from dynapix.teacher.predicates.facts import Predicates
from dynapix.teacher.reading.candidates import CandidateReader, read_answer
from dynapix.teacher.reading.claims import CUT, EITHER, TARGET, Claim, IndexedPredicates
from dynapix.teacher.reading.scenes import SceneReader
from dynapix.teacher.reading.tagging import Tag, find_tags
from dynapix.teacher.sections import split_sections

MOMENTS = {
    "Scene parse": CUT,
    "Motion analysis": EITHER,
    "Prediction": TARGET,
    "Outcome": TARGET,
}
"""The moment that the present tense of a section refers to."""


def extract_claims(text: str, predicates: Predicates) -> tuple[Claim, ...]:
    """Return the claims of a rationale in text order, each with its verdict; never raises."""
    indexed = IndexedPredicates(predicates)
    names = [*indexed.objects, *indexed.extras]
    known: list[str] = []
    claims: list[Claim] = []
    for name, start, stop in split_sections(text):
        if name == "Answer":
            claims += read_answer(text, start, stop)
            continue
        scene = SceneReader(indexed, MOMENTS.get(name, EITHER), known)
        candidates = CandidateReader(indexed, name == "Candidate analysis", known)
        for tags in _split_sentences(find_tags(text, start, stop, names)):
            names_candidate = any(tag.name == "candidate" for tag in tags)
            if name == "Candidate analysis" or (name == "Outcome" and names_candidate):
                claims += candidates.read(tags)
            else:
                claims += scene.read(tags)
    claims.sort(key=lambda claim: claim.span)
    return tuple(map(indexed.judge, claims))


def _split_sentences(section: list[Tag]) -> list[list[Tag]]:
    sentences: list[list[Tag]] = [[]]
    for tag in section:
        sentences[-1].append(tag)
        if tag.name == "stop":
            sentences.append([])
    return [s for s in sentences if any(tag.name != "stop" for tag in s)]
