"""Collect a model's responses in an append-only file, from which a killed evaluation resumes."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from data.records import FrameRef, RetrievalQuery, SelectionItem
from evaluation.generators.response_schema import Record, read_record
from models.student.answer_parser import parse_choice
from models.student.generation import GeneratedText

Subject = SelectionItem | RetrievalQuery | FrameRef
"""What a response is about."""
SaveResponses = Callable[[list[tuple[Subject, GeneratedText]]], None]
"""Saves the responses of a batch as soon as it is finished."""
Respond = Callable[[list[Subject], SaveResponses], None]
"""Generates and saves the responses to subjects."""

RECORD_MODES = ("record", "constrained")
"""Modes that request the structured record."""


@dataclass(frozen=True)
class Answer:
    """A response to an item in a mode.

    Attributes:
        letter: The chosen letter; None if the response cannot be parsed.
        reason: Why the letter is None.
        valid: Whether the structured record is valid; None in modes without a record.
        cut: Whether generation stopped at the token limit.
    """

    item_id: str
    mode: str
    text: str
    letter: str | None
    reason: str | None
    right: bool
    valid: bool | None
    cut: bool

    @property
    def record(self) -> Record | None:
        """The structured record, if it is valid."""
        return read_record(self.text) if self.valid else None


@dataclass(frozen=True)
class FreeTextResponse:
    """A response without a letter, to the query or frame named `item_id`."""

    item_id: str
    mode: str
    text: str
    cut: bool


Response = Answer | FreeTextResponse


def score_response(item: SelectionItem, mode: str, generated: GeneratedText) -> Answer:
    """Parse a response to an item and compare its letter with the item's."""
    answer = parse_choice(generated.text, cut=generated.cut)
    return Answer(
        item.item_id,
        mode,
        generated.text,
        answer.letter,
        str(answer.reason) if answer.letter is None and answer.reason else None,
        right=answer.letter == item.letter,
        valid=read_record(generated.text) is not None if mode in RECORD_MODES else None,
        cut=generated.cut,
    )


def free_text_response(subject: Subject, mode: str, generated: GeneratedText) -> FreeTextResponse:
    return FreeTextResponse(subject.name, mode, generated.text, generated.cut)


class ResponseLog:
    """Responses in a file, one JSON line each, under keys of the settings that they depend on.

    `settings` has these by mode, as JSON: the model's revision, the benchmark, the prompt, the
    sampling, the seed. A line of the file records them once, with their key. Responses under other
    keys stay in the file and are not used. Only a response's text is read back; it is parsed and
    scored again.
    """

    def __init__(
        self,
        path: Path,
        settings: dict[str, dict[str, Any]],
        subjects: Sequence[Subject],
        score: Callable[[Subject, str, GeneratedText], Response] = score_response,
    ) -> None:
        self._path = path
        self.keys = {mode: _key(mode, of_mode) for mode, of_mode in settings.items()}
        self.score = score
        self._subject_of = {subject.name: subject for subject in subjects}
        rows = _read_rows(path)
        self.answers = self._answers(rows)
        recorded = {row.get("key") for row in rows if "asked" in row}
        heads = [
            {"key": key, "mode": mode, "asked": settings[mode]}
            for mode, key in self.keys.items()
            if key not in recorded
        ]
        # A kill may have left an incomplete last line: end it.
        torn = path.exists() and path.read_bytes()[-1:] not in (b"", b"\n")
        self._write([*([""] if torn else []), *map(json.dumps, heads)])

    def take_over(self, others: Iterable[Path]) -> int:
        """Add other files' responses under the same keys; return their number."""
        before = len(self.answers)
        for path in others:
            found = self._answers(_read_rows(path))
            self.append([answer for key, answer in found.items() if key not in self.answers])
        return len(self.answers) - before

    def _answers(self, rows: list[dict[str, Any]]) -> dict[tuple[str, str], Response]:
        """Score the rows under this log's keys; damaged ones are left out and generated again."""
        answers = {}
        for row in rows:
            try:
                name, mode = row["item_id"], row["mode"]
                if name in self._subject_of and row["key"] == self.keys.get(mode, ""):
                    generated = GeneratedText(row["text"], row["cut"])
                    answers[name, mode] = self.score(self._subject_of[name], mode, generated)
            except (ValueError, TypeError, KeyError, AttributeError):
                continue
        return answers

    def append(self, answers: list[Response]) -> None:
        self._write([json.dumps({**asdict(a), "key": self.keys[a.mode]}) for a in answers])
        self.answers |= {(a.item_id, a.mode): a for a in answers}

    def _write(self, lines: list[str]) -> None:
        """Append lines durably: they survive a crash of the machine."""
        with open(self._path, "a", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in lines)
            file.flush()
            os.fsync(file.fileno())


def _read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the JSON objects of a file, without lines that a kill cut off."""
    rows = []
    for line in path.read_bytes().splitlines() if path.exists() else []:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict):
            rows.append(row)
    return rows


def _key(mode: str, settings: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps([mode, settings], sort_keys=True).encode()).hexdigest()[:16]


def collect_responses(
    subjects: Sequence[Subject], mode: str, respond: Respond, log: ResponseLog, unit: str = "item"
) -> list[Response]:
    """Return the response to each subject in `mode`, and generate those that the log lacks."""
    missing = [s for s in subjects if (s.name, mode) not in log.answers]
    done = len(subjects) - len(missing)
    with tqdm(total=len(subjects), initial=done, desc=mode, unit=unit) as bar:

        def save(responses: list[tuple[Subject, GeneratedText]]) -> None:
            log.append([log.score(subject, mode, generated) for subject, generated in responses])
            bar.update(len(responses))

        if missing:
            respond(missing, save)
    return [log.answers[s.name, mode] for s in subjects]


def response_seed(seed: int, subject: Subject, mode: str) -> int:
    """Return the 32-bit sampling seed of a response, independent of the batch that it is in."""
    digest = hashlib.sha256(f"{seed} {mode} {subject.name}".encode()).digest()
    return int.from_bytes(digest[:4], "big")
