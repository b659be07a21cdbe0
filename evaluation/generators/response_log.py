"""Collect a model's responses in an append-only file, so that a killed evaluation can resume."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from dynapix.conf.files import read_json_lines
from dynapix.conf.runs import rank
from dynapix.data.records import FrameRef, RetrievalQuery, SelectionItem
from dynapix.evaluation.generators.response_schema import is_valid_record
from dynapix.models.distributed import share_from_main
from dynapix.models.fingerprints import settings_key
from dynapix.models.student.answer_parser import parse_choice
from dynapix.models.student.prompts import Sample
from dynapix.models.student.responses import GeneratedText

Subject = SelectionItem | RetrievalQuery | FrameRef
"""The item, query or frame that a prompt is about."""
SampleOf = Callable[[Subject], Sample]
"""Returns the prompt for a subject."""
SaveResponses = Callable[..., None]
"""Saves a list of subjects with their finished responses: all responses of a local batch, or one
response of a server. With `servers`, shows a text about the servers in the progress bar."""
Respond = Callable[[list[Subject], SaveResponses], None]
"""Generates the responses to subjects and saves them."""

RECORD_MODES = ("record", "constrained")
"""Modes in which the prompt requests the structured record of `response_schema`."""


@dataclass(frozen=True)
class ModelResponse:
    """A model's response to a subject, generated in one mode.

    Attributes:
        item_id: Name of the item, query or frame.
        truncated: Whether generation stopped at the token limit.
    """

    item_id: str
    mode: str
    text: str
    truncated: bool


@dataclass(frozen=True)
class Answer(ModelResponse):
    """A response to a selection item.

    Attributes:
        letter: The chosen letter; None if the response cannot be parsed.
        reason: Why the response could not be parsed; None if it was.
        right: Whether `letter` is the letter of the target.
        valid: Whether the structured record is valid; None in modes without a record.
    """

    letter: str | None
    reason: str | None
    right: bool
    valid: bool | None


def score_response(subject: Subject, mode: str, generated: GeneratedText) -> ModelResponse:
    """Return the response to a subject. If the subject is a selection item, the letter is parsed
    and compared with the correct one."""
    text, truncated = generated.text, generated.truncated
    if not isinstance(subject, SelectionItem):
        return ModelResponse(subject.name, mode, text, truncated)
    parsed = parse_choice(text, truncated=truncated)
    letter, is_right = parsed.letter, parsed.letter == subject.letter
    reason = str(parsed.reason) if letter is None and parsed.reason else None
    valid = is_valid_record(text) if mode in RECORD_MODES else None
    return Answer(subject.name, mode, text, truncated, letter, reason, is_right, valid)


class ResponseLog:
    """A JSON Lines file of responses.

    A response is stored with a key: the hash of its mode and of the settings that it depends on. A
    line with the field `asked` records these settings for each key. Responses with other keys stay
    in the file and are not used. Texts are parsed and scored again when they are read.

    Args:
        settings: By mode, what `evaluation.generators.generator.response_settings` returns.
        subjects: Subjects whose responses are read.
    """

    def __init__(
        self, path: Path, settings: dict[str, dict[str, Any]], subjects: Sequence[Subject]
    ) -> None:
        self._path = path
        self.keys = {mode: settings_key([mode, values]) for mode, values in settings.items()}
        self._subject_of = {subject.name: subject for subject in subjects}
        rows = list(read_json_lines(path)) if path.exists() else []
        self.responses = self._score(rows)
        recorded = {row.get("key") for row in rows if "asked" in row}
        headers = [
            {"key": key, "mode": mode, "asked": settings[mode]}
            for mode, key in self.keys.items()
            if key not in recorded
        ]
        # If the process was killed, the last line may be incomplete: terminate that line.
        is_incomplete = path.exists() and path.read_bytes()[-1:] not in (b"", b"\n")
        self._write([*([""] if is_incomplete else []), *map(json.dumps, headers)])

    def add_from(self, others: Iterable[Path]) -> int:
        """Copy the responses with matching keys that are only in other logs; return their count."""
        before = len(self.responses)
        for path in others:
            found = self._score(read_json_lines(path))
            self.append([r for key, r in found.items() if key not in self.responses])
        return len(self.responses) - before

    def _score(self, rows: Iterable[dict[str, Any]]) -> dict[tuple[str, str], ModelResponse]:
        """Score the rows that hold responses to this log's subjects with this log's keys. Return
        them by (name of the subject, mode). Damaged rows are skipped."""
        responses = {}
        for row in rows:
            try:
                name, mode = row["item_id"], row["mode"]
                if name in self._subject_of and row["key"] == self.keys.get(mode, ""):
                    generated = GeneratedText(row["text"], row["truncated"])
                    responses[name, mode] = score_response(self._subject_of[name], mode, generated)
            except (ValueError, TypeError, KeyError, AttributeError):
                continue
        return responses

    def append(self, responses: list[ModelResponse]) -> None:
        self._write([json.dumps({**asdict(r), "key": self.keys[r.mode]}) for r in responses])
        self.responses |= {(r.item_id, r.mode): r for r in responses}

    def _write(self, lines: list[str]) -> None:
        """Append lines and flush them to the disk, so that they survive a crash of the machine. The
        main rank writes."""
        if rank() > 0:
            return
        with open(self._path, "a", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in lines)
            file.flush()
            os.fsync(file.fileno())


def collect_responses(
    subjects: Sequence[Subject], mode: str, respond: Respond, log: ResponseLog, unit: str = "item"
) -> list[ModelResponse]:
    """Generate the responses that are missing from the log, and return the response to each
    subject. `unit` is what the progress bar counts. The ranks of a launcher share the work; only
    the main rank returns responses."""
    names = share_from_main([s.name for s in subjects if (s.name, mode) not in log.responses])
    subject_of = {subject.name: subject for subject in subjects}
    missing = [subject_of[name] for name in names]
    done = len(subjects) - len(missing)
    is_main = rank() == 0
    with tqdm(total=len(subjects), initial=done, desc=mode, unit=unit, disable=not is_main) as bar:

        def save(generated: list[tuple[Subject, GeneratedText]], servers: str = "") -> None:
            if servers:
                bar.set_postfix_str(servers)
            log.append([score_response(subject, mode, text) for subject, text in generated])
            bar.update(len(generated))

        if missing:
            respond(missing, save)
    return [log.responses[s.name, mode] for s in subjects] if is_main else []


def response_seed(seed: int, subject: Subject, mode: str) -> int:
    """Return the 32-bit sampling seed of a response. It does not depend on the batch."""
    digest = hashlib.sha256(f"{seed} {mode} {subject.name}".encode()).digest()
    return int.from_bytes(digest[:4], "big")
