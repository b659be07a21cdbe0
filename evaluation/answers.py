"""Ask a student for its answers, and keep every one: an append-only file that a killed evaluation
goes on from."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from torch import nn
from tqdm import tqdm
from transformers import ProcessorMixin

from conf.runs import write_text
from conf.schema import StudentConfig
from data.frames import Frames
from data.records import SelectionItem
from train.choice import parse
from train.collate import Collator
from train.conversation import selection_sample
from train.generate import generate, new_tokens


@dataclass(frozen=True)
class Answer:
    """What a student said to one item in one mode. `letter` is None where no choice could be
    read, and `reason` then says why."""

    item_id: str
    mode: str
    text: str
    letter: str | None
    reason: str | None
    right: bool


class AnswerLog:
    """The answers in a file, one JSON line each, below a line that says what was `measured`.

    Answers of other weights or to other items are no answers to these: the file begins anew. Only
    what was said is taken from it; what is right is judged again.
    """

    def __init__(self, path: Path, measured: str, items: Sequence[SelectionItem]) -> None:
        self._path = path
        self.answers: dict[tuple[str, str], Answer] = {}
        item_of = {item.item_id: item for item in items}
        text = path.read_text(errors="replace") if path.exists() else ""
        head, *lines = text.splitlines() or [""]
        top = json.dumps({"measured": measured})
        for line in lines if head == top else []:
            try:
                row = json.loads(line)
                answer = judge(item_of[row["item_id"]], row["mode"], row["text"])
            except (ValueError, TypeError, KeyError):
                # Torn by a kill: that item is asked again.
                continue
            self.answers[answer.item_id, answer.mode] = answer
        write_text(path, "".join([f"{top}\n", *map(_line, self.answers.values())]))

    def append(self, answers: list[Answer]) -> None:
        with open(self._path, "a") as file:
            file.writelines(map(_line, answers))
        self.answers |= {(a.item_id, a.mode): a for a in answers}


def _line(answer: Answer) -> str:
    return json.dumps(asdict(answer)) + "\n"


def ask_all(
    model: nn.Module,
    processor: ProcessorMixin,
    items: list[SelectionItem],
    mode: str,
    regime: str,
    frames: Frames,
    cfg: StudentConfig,
    precision: str,
    batch: int,
    log: AnswerLog,
    control: str | None = None,
) -> list[Answer]:
    """Every item's answer in `mode`, as a student of `regime` is asked, its prefix shown as a
    `control` asks, greedily decoded; items that the log holds are not asked."""
    waiting = [i for i in items if (i.item_id, mode) not in log.answers]
    limit = new_tokens(mode, cfg)
    collator = Collator(processor, cfg.max_length)
    with tqdm(total=len(items), initial=len(items) - len(waiting), desc=mode, unit="item") as bar:
        for group in _groups(waiting, batch):
            inputs = collator(
                [selection_sample(i, mode, regime, frames, cfg, control=control) for i in group]
            )
            texts = generate(model, processor, inputs, limit, precision)
            log.append([judge(i, mode, t) for i, t in zip(group, texts, strict=True)])
            bar.update(len(group))
    return [log.answers[i.item_id, mode] for i in items]


def judge(item: SelectionItem, mode: str, text: str) -> Answer:
    """What a text says to an item, and whether that is right."""
    choice = parse(text)
    reason = str(choice.reason) if choice.letter is None and choice.reason else None
    return Answer(item.item_id, mode, text, choice.letter, reason, choice.letter == item.letter)


def _groups(items: list[SelectionItem], size: int) -> Iterator[list[SelectionItem]]:
    for start in range(0, len(items), size):
        yield items[start : start + size]
