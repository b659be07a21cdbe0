"""The teacher's client beside its server's own limit, and how soon a finished narration is resumed.

    python -m benchmarks.speed.teacher full http://127.0.0.1:8000/v1 MODEL --benchmark store/tiny
    python -m benchmarks.speed.teacher resume

`full` narrates the training items of a benchmark through the client, journal and validator
included, one answer an item, and gives the same chats to vLLM's own benchmark client and to bare
requests, in turns, each at the same number in flight and with the same longest answer: medians of
the rounds after the first, and of the client's tokens a second over the other's in each round. A
model that stops early by itself makes the answers differ in length: tokens a second say more then.

`resume` finds that nothing is left of a narration of 10,000 items, and times the part of it that
reads the journal, and what Python takes to start and import.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import cycle, islice
from pathlib import Path
from typing import Any

from conf.schema import TeacherConfig
from data.records import SelectionItem
from data.store import Store, open_store
from teacher.narrate import narrate_store
from teacher.predicates import predicates_of
from teacher.prompts import messages
from teacher.rationale_log import Journal, read_rationales

LIMIT = Path(__file__).with_name("vllm_limit.py")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(required=True)
    full = commands.add_parser("full", help="answers a second, beside the server's limit")
    full.add_argument("url")
    full.add_argument("model")
    full.add_argument("--benchmark", type=Path, default=Path("store/tiny"))
    full.add_argument("--items", type=int, default=512)
    full.add_argument("--in-flight", type=int, default=128)
    full.add_argument("--max-tokens", type=int, default=200)
    full.add_argument("--rounds", type=int, default=3)
    full.add_argument("--environment", type=Path, default=Path(".venv-vllm"))
    full.set_defaults(run=measure_full)
    resume = commands.add_parser("resume", help="seconds to find that nothing is left to do")
    resume.add_argument("--benchmark", type=Path, default=Path("store/tiny"))
    resume.add_argument("--items", type=int, default=10_000)
    resume.add_argument("--rounds", type=int, default=5)
    resume.set_defaults(run=measure_resume)
    args = parser.parse_args()
    args.run(args)


@dataclass
class Part:
    """Some items of a store, narrated into another folder."""

    store: Store
    items: list[SelectionItem]
    folder: Path

    def selection(self, split: str) -> list[SelectionItem]:
        return self.items

    def scene(self, scene_id: str) -> Any:
        return self.store.scene(scene_id)


def narratable(store: Store) -> Iterator[SelectionItem]:
    for item in store.selection("train"):
        if predicates_of(item, store.scene(item.scene_id), store.scene):
            yield item


def measure_full(args: argparse.Namespace) -> None:
    store = open_store(args.benchmark)
    items = list(islice(narratable(store), args.items))
    cfg = TeacherConfig(
        name="benchmark",
        url=args.url,
        model=args.model,
        attempts=1,
        max_tokens=args.max_tokens,
        concurrency=args.in_flight,
    )
    rates: dict[str, list[list[float]]] = {"client": [], "vllm": [], "bare": []}
    with limit(store, items, cfg, args.environment) as by_limit:
        for k in range(args.rounds + 1):
            rates["client"].append(by_client(store, items, cfg))
            for name, found in by_limit().items():
                rates[name].append(found)
            told = ", ".join(f"{name} {found[-1][0]:.2f}" for name, found in rates.items())
            print(f"round {k}, answers/s: {told}", flush=True)
    print(f"{len(items)} items, {args.in_flight} in flight, at most {args.max_tokens} tokens")
    for name, (_, *found) in rates.items():
        answers, tokens = (statistics.median(column) for column in zip(*found, strict=True))
        pairs = zip(rates["client"][1:], found, strict=True)
        ratio = statistics.median(own[1] / other[1] for own, other in pairs)
        print(f"{name:8} {answers:8.2f} answers/s {tokens:10,.0f} tokens/s   client: {ratio:.3f}")


def by_client(store: Store, items: list[SelectionItem], cfg: TeacherConfig) -> list[float]:
    with tempfile.TemporaryDirectory() as folder:
        since = time.perf_counter()
        narrate_store(Part(store, items, Path(folder)), cfg)
        took = time.perf_counter() - since
        answers = read_rationales(Path(folder) / "rationales.jsonl")
    assert len(answers) == len(items)
    return [len(answers) / took, sum(r.completion_tokens for r in answers) / took]


@contextmanager
def limit(
    store: Store, items: list[SelectionItem], cfg: TeacherConfig, environment: Path
) -> Iterator[Callable[[], dict[str, list[float]]]]:
    """A function that asks for the same by vLLM's client and by bare requests."""
    chats = [
        messages(predicates_of(i, store.scene(i.scene_id), store.scene), i, cfg) for i in items
    ]
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(chats, file)
        file.flush()
        asked = [file.name, cfg.url, cfg.model, str(cfg.concurrency), str(cfg.max_tokens)]
        python = environment.absolute() / "bin" / "python"
        with subprocess.Popen(
            [python, "-P", LIMIT, *asked], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:

            def once() -> dict[str, list[float]]:
                print(file=process.stdin, flush=True)
                return json.loads(process.stdout.readline())

            yield once


def measure_resume(args: argparse.Namespace) -> None:
    store = open_store(args.benchmark)
    with tempfile.TemporaryDirectory() as folder:
        part = finished_part(store, args.items, Path(folder))
        path = part.folder / "rationales.jsonl"
        print(f"{args.items} answers, {path.stat().st_size / 2**20:.1f} MiB")
        print(
            f"read and check the journal  {median(args.rounds, lambda: open_journal(path)):.2f} s"
        )
        template = TeacherConfig(name="template")
        took = median(args.rounds, lambda: narrate_store(part, template))
        print(f"find that nothing is left   {took:.2f} s")
        command = [sys.executable, "-c", "import teacher.narrate"]
        took = median(args.rounds, lambda: subprocess.run(command, check=True))
        print(f"start Python and import     {took:.2f} s")


def finished_part(store: Store, count: int, folder: Path) -> Part:
    """`count` items, those of the store under further names, each with its rationale."""
    there = list(narratable(store))
    items = [
        replace(item, item_id=f"{item.item_id}-{k}")
        for k, item in enumerate(islice(cycle(there), count))
    ]
    part = Part(store, items, folder)
    narrate_store(part, TeacherConfig(name="template"))
    return part


def open_journal(path: Path) -> None:
    with Journal(path):
        pass


def median(rounds: int, run: Callable[[], Any]) -> float:
    took = []
    for _ in range(rounds):
        since = time.perf_counter()
        run()
        took.append(time.perf_counter() - since)
    return statistics.median(took)


if __name__ == "__main__":
    main()
