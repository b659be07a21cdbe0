"""Ask a model for its answers, and keep every one: an append-only file that a killed evaluation
goes on from."""

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
"""What a model is asked about."""
SaveResponses = Callable[[list[tuple[Subject, GeneratedText]]], None]
"""Takes what was said to some things as soon as it is there."""
Respond = Callable[[list[Subject], SaveResponses], None]
"""Has a model answer and keeps what it says."""

RECORD_MODES = ("record", "constrained")
"""Modes in which the structured record is asked for."""


@dataclass(frozen=True)
class Answer:
    """What a model said to one item in one mode. `letter` is None where no choice could be read,
    and `reason` then says why; `valid` is whether the structured record is as it was asked for,
    None where none was; `cut` whether the model was stopped before its end."""

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
        """The structured record, where it is valid."""
        return read_record(self.text) if self.valid else None


@dataclass(frozen=True)
class FreeTextResponse:
    """What a model said where no letter is asked for, about the query or frame of that name."""

    item_id: str
    mode: str
    text: str
    cut: bool


Response = Answer | FreeTextResponse


def score_response(item: SelectionItem, mode: str, written: GeneratedText) -> Answer:
    """What a text says to an item, and whether that is right."""
    choice = parse_choice(written.text, cut=written.cut)
    valid = read_record(written.text) is not None if mode in RECORD_MODES else None
    return Answer(
        item.item_id,
        mode,
        written.text,
        choice.letter,
        str(choice.reason) if choice.letter is None and choice.reason else None,
        choice.letter == item.letter,
        valid,
        written.cut,
    )


def free_text_response(thing: Subject, mode: str, written: GeneratedText) -> FreeTextResponse:
    """A text as it was written, which nothing judges."""
    return FreeTextResponse(thing.name, mode, written.text, written.cut)


class ResponseLog:
    """The answers in a file, one JSON line each, by what they are answers to.

    `asked` says it of each mode, in plain values: the model's revision, the items, the prompt, how
    tokens are drawn, the seed. A line of its own tells it once, under a key that the answers bear.
    Answers under other keys stay in the file and are no answers to these. Only what was said is
    taken from a line; what it says and whether that is right is `judged` again.
    """

    def __init__(
        self,
        path: Path,
        asked: dict[str, dict[str, Any]],
        things: Sequence[Subject],
        judged: Callable[[Subject, str, GeneratedText], Response] = score_response,
    ) -> None:
        self._path = path
        self.keys = {mode: _key(mode, what) for mode, what in asked.items()}
        self.judged = judged
        self._thing_of = {thing.name: thing for thing in things}
        read = self._read(path)
        self.answers = {(a.item_id, a.mode): a for a, _ in read if a}
        told = {row.get("key") for _, row in read if "asked" in row}
        heads = [
            json.dumps({"key": key, "mode": mode, "asked": asked[mode]})
            for mode, key in self.keys.items()
            if key not in told
        ]
        # What a kill tore in the midst of a line ends there.
        torn = path.exists() and path.read_bytes()[-1:] not in (b"", b"\n")
        self._write([*([""] if torn else []), *heads])

    def take_over(self, others: Iterable[Path]) -> int:
        """Keep also what other files hold of answers to the same, which are not asked again; how
        many these are."""
        before = len(self.answers)
        for path in others:
            found = [answer for answer, _ in self._read(path) if answer]
            self.append([a for a in found if (a.item_id, a.mode) not in self.answers])
        return len(self.answers) - before

    def _read(self, path: Path) -> list[tuple[Response | None, dict[str, Any]]]:
        """The objects in a file's lines, each with the answer where it is one to what is asked.
        What a kill tore is left out: that is asked again."""
        found = []
        for line in path.read_bytes().splitlines() if path.exists() else []:
            try:
                row, answer = json.loads(line), None
                thing = None if "asked" in row else self._thing_of.get(row["item_id"])
                if thing and self._bears_key(row):
                    answer = self.judged(thing, row["mode"], GeneratedText(row["text"], row["cut"]))
                found.append((answer, row))
            except (ValueError, TypeError, KeyError, AttributeError):
                continue
        return found

    def _bears_key(self, row: dict[str, Any]) -> bool:
        return row["mode"] in self.keys and row["key"] == self.keys[row["mode"]]

    def append(self, answers: list[Response]) -> None:
        self._write([json.dumps({**asdict(a), "key": self.keys[a.mode]}) for a in answers])
        self.answers |= {(a.item_id, a.mode): a for a in answers}

    def _write(self, lines: list[str]) -> None:
        """Add lines, which no failure of the machine takes away again."""
        with open(self._path, "a", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in lines)
            file.flush()
            os.fsync(file.fileno())


def _key(mode: str, asked: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps([mode, asked], sort_keys=True).encode()).hexdigest()[:16]


def collect_responses(
    things: Sequence[Subject], mode: str, say: Respond, log: ResponseLog, unit: str = "item"
) -> list[Response]:
    """What is said to each in `mode`; what the log holds is not asked."""
    waiting = [t for t in things if (t.name, mode) not in log.answers]
    with tqdm(total=len(things), initial=len(things) - len(waiting), desc=mode, unit=unit) as bar:

        def keep(said: list[tuple[Subject, GeneratedText]]) -> None:
            log.append([log.judged(thing, mode, written) for thing, written in said])
            bar.update(len(said))

        if waiting:
            say(waiting, keep)
    return [log.answers[t.name, mode] for t in things]


def response_seed(seed: int, thing: Subject, mode: str) -> int:
    """The seed (32 bits) of the answer that is drawn for a thing in a mode."""
    digest = hashlib.sha256(f"{seed} {mode} {thing.name}".encode()).digest()
    return int.from_bytes(digest[:4], "big")
