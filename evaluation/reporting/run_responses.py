"""The responses of models and the choices of retrievers, read from the folders of their runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from data.records import LETTERS
from evaluation.reporting.runs import FinishedRun, json_lines, reading
from models.student.answer_parser import ParsedAnswer, Reason, parse_choice


@dataclass(frozen=True)
class TextResponse:
    """A model's response to an item; `truncated` if generation stopped before its end."""

    text: str
    truncated: bool

    @cached_property
    def answer(self) -> ParsedAnswer:
        return parse_choice(self.text, cut=self.truncated)

    def credit(self, letter: str) -> float:
        """1 if the response is `letter`, else 0."""
        return float(self.answer.letter == letter)


@dataclass(frozen=True)
class SimilarityResponse:
    """A retriever's scores of an item's candidates by letter; None where a score is missing."""

    scores: Mapping[str, float | None]
    truncated: bool = False

    @property
    def text(self) -> str:
        return ", ".join(
            f"{letter} {'no score' if score is None else f'{score:.4f}'}"
            for letter, score in self.scores.items()
        )

    @property
    def answer(self) -> ParsedAnswer:
        nearest = self._nearest
        return ParsedAnswer(nearest) if len(nearest) == 1 else ParsedAnswer(None, Reason.SEVERAL)

    def credit(self, letter: str) -> float:
        """1/m if `letter` is one of the m candidates with the highest score, else 0."""
        return (letter in self._nearest) / max(1, len(self._nearest))

    @property
    def _nearest(self) -> str:
        known = {x: score for x, score in self.scores.items() if score is not None}
        return "".join(x for x, score in known.items() if score == max(known.values()))


Responses = Mapping[str, TextResponse | SimilarityResponse]
"""Responses by item."""
Variant = tuple[str, str | None]
"""The mode of a model, or the name of an embedder, and the control."""


def read_responses(run: FinishedRun) -> dict[Variant, Responses]:
    """The responses that a run's report is about, by variant and item.

    Responses under other settings, and lines torn by a kill, are left out.

    Raises:
        UserError: the report or the responses are missing or of another version.
    """
    return _read_scores(run) if run.kind == "similarity" else _read_texts(run)


def _read_scores(run: FinishedRun) -> dict[Variant, Responses]:
    responses: dict[Variant, dict[str, SimilarityResponse]] = {}
    with reading(run.folder, "scores.jsonl"):
        for row in json_lines(run.folder / "scores.jsonl"):
            scores = SimilarityResponse(dict(zip(LETTERS, row["scores"], strict=True)))
            responses.setdefault((row["by"], None), {})[row["item_id"]] = scores
    return responses


def _read_texts(run: FinishedRun) -> dict[Variant, Responses]:
    with reading(run.folder):
        variants = {key: (mode, control) for mode, control, key in run.report["asked"]}
    responses: dict[Variant, dict[str, TextResponse]] = {v: {} for v in variants.values()}
    with reading(run.folder, "answers.jsonl"):
        for row in json_lines(run.folder / "answers.jsonl"):
            if "text" in row and row["key"] in variants:
                response = TextResponse(str(row["text"]), bool(row["cut"]))
                responses[variants[row["key"]]][row["item_id"]] = response
    return responses
