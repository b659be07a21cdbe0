"""The responses of models and the choices of retrievers, read from the folders of their runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from conf.runs import read_json_lines
from data.records import LETTERS
from evaluation.metrics.results import variant_name
from evaluation.reporting.runs import FinishedRun, reading
from models.student.answer_parser import Reason, parse_choice


@dataclass(frozen=True)
class ItemResponse:
    """What a model answered to an item.

    Attributes:
        text: The response, or the scores of a retriever.
        letters: The chosen letters: several for tied scores, none for an unparsed response.
        reason: Why the letter is unknown.
        truncated: Whether generation stopped before the end of the text.
    """

    text: str
    letters: str
    reason: str | None = None
    truncated: bool = False

    @property
    def letter(self) -> str | None:
        """The letter, if it is the only one."""
        return self.letters if len(self.letters) == 1 else None

    def credit(self, letter: str) -> float:
        """1/m if `letter` is one of the m chosen letters, else 0."""
        return (letter in self.letters) / max(1, len(self.letters))


Responses = Mapping[str, ItemResponse]
"""Responses by item."""


def read_responses(run: FinishedRun) -> dict[str, Responses]:
    """The responses that a run's report is about, by `SelectionResult.key` and item.

    Responses under other settings, and lines torn by a kill, are left out.

    Raises:
        UserError: the report or the responses are missing or of another version.
    """
    return _read_scores(run) if run.kind == "similarity" else _read_texts(run)


def _read_scores(run: FinishedRun) -> dict[str, Responses]:
    responses: dict[str, dict[str, ItemResponse]] = {}
    with reading(run.folder, "scores.jsonl"):
        for row in read_json_lines(run.folder / "scores.jsonl"):
            scores = dict(zip(LETTERS, row["scores"], strict=True))
            responses.setdefault(row["by"], {})[row["item_id"]] = nearest_candidates(scores)
    return responses


def nearest_candidates(scores: Mapping[str, float | None]) -> ItemResponse:
    """The candidates with the highest score; a score is None if it is missing."""
    known = [score for score in scores.values() if score is not None]
    letters = "".join(x for x, score in scores.items() if known and score == max(known))
    reason = None if len(letters) == 1 else str(Reason.SEVERAL)
    shown = {x: "no score" if score is None else f"{score:.4f}" for x, score in scores.items()}
    return ItemResponse(", ".join(f"{x} {score}" for x, score in shown.items()), letters, reason)


def _read_texts(run: FinishedRun) -> dict[str, Responses]:
    with reading(run.folder):
        variants = {key: variant_name(mode, control) for mode, control, key in run.report["asked"]}
    responses: dict[str, dict[str, ItemResponse]] = {v: {} for v in variants.values()}
    with reading(run.folder, "answers.jsonl"):
        for row in read_json_lines(run.folder / "answers.jsonl"):
            if "text" in row and row["key"] in variants:
                response = parse_response(str(row["text"]), bool(row["cut"]))
                responses[variants[row["key"]]][row["item_id"]] = response
    return responses


def parse_response(text: str, truncated: bool) -> ItemResponse:
    answer = parse_choice(text, cut=truncated)
    reason = answer.reason and str(answer.reason)
    return ItemResponse(text, answer.letter or "", reason, truncated)
