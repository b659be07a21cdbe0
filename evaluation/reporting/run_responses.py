"""The responses of students and the choices of retrievers, read from the folders of runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from dynapix.conf.errors import UserError
from dynapix.conf.files import read_json_lines
from dynapix.data.records import LETTERS
from dynapix.evaluation.metrics.results import SelectionReport, variant_name
from dynapix.models.student.answer_parser import ParseFailure, parse_choice


@dataclass(frozen=True)
class ItemResponse:
    """A model's response to an item.

    Attributes:
        text: The response, or the scores of a retriever.
        letters: The chosen letters: several for tied scores, none for an unparsed response.
        reason: What is wrong with the response, such as tied scores; None for a valid response.
        truncated: Whether generation stopped at the token limit.
    """

    text: str
    letters: str
    reason: str | None = None
    truncated: bool = False

    @property
    def letter(self) -> str | None:
        """The chosen letter; None if there is none or more than one."""
        return self.letters if len(self.letters) == 1 else None

    def credit(self, letter: str) -> float:
        """Return 1/m if `letter` is one of the m chosen letters, else 0."""
        return (letter in self.letters) / max(1, len(self.letters))


FAILED = ItemResponse("", "", "no scores")
"""The response to an item for which the `predict` of `dynapix.evaluate` failed."""
Responses = Mapping[str, ItemResponse]
"""Responses by item id."""


def read_responses(folder: Path, kind: str, report: SelectionReport) -> dict[str, Responses]:
    """Return the responses of a run by `SelectionResult.key` and item id.

    Responses that were generated with other settings than those of the run's report are left out,
    and so are damaged lines.

    Args:
        folder: The run's folder.
        kind: select or similarity.

    Raises:
        UserError: The responses are missing or of another version.
    """
    variants = {key: variant_name(mode, control) for mode, control, key in report.asked}
    responses: dict[str, dict[str, ItemResponse]] = {}
    file = "scores.jsonl" if kind == "similarity" else "answers.jsonl"
    with reading(folder, file):
        for row in read_json_lines(folder / file):
            if kind == "similarity":
                scores = row["scores"]
                response = FAILED if scores is None else nearest_candidates(scores)
                variant = row["by"]
            elif "text" in row and row["key"] in variants:
                variant = variants[row["key"]]
                response = parse_response(str(row["text"]), bool(row["truncated"]))
            else:
                continue
            responses.setdefault(variant, {})[row["item_id"]] = response
    return responses


def nearest_candidates(scores: Sequence[float]) -> ItemResponse:
    """Return the choice of a retriever: the letters of the candidates with the highest score."""
    by_letter = dict(zip(LETTERS, scores, strict=True))
    letters = "".join(x for x, score in by_letter.items() if score == max(scores))
    text = ", ".join(f"{x} {score:.4f}" for x, score in by_letter.items())
    return ItemResponse(text, letters, None if len(letters) == 1 else str(ParseFailure.SEVERAL))


def parse_response(text: str, truncated: bool) -> ItemResponse:
    answer = parse_choice(text, truncated=truncated)
    reason = answer.reason and str(answer.reason)
    return ItemResponse(text, answer.letter or "", reason, truncated)


@contextmanager
def reading(folder: Path, file: str = "report.json") -> Iterator[None]:
    """Turn an error in the block, which reads `file` of a run, into a UserError that names it."""
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{folder / file} is missing, damaged or of another version ({type(error).__name__}: "
            f"{str(error).partition(chr(10))[0]}): delete {folder} and run its command again, or "
            "leave the run out with runs=[...]",
            code="damaged-file",
        ) from error
