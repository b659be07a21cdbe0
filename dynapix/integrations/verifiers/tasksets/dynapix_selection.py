"""Selection items as a taskset of verifiers (`pip install 'dynapix[simulate,verifiers]'`):

    export PYTHONPATH="$(python -m dynapix.integrations.verifiers)"
    vf-eval dynapix-selection --env.taskset.benchmark tiny --env.agent.harness.id null \\
        --env.agent.runtime.type subprocess --client.base-url http://localhost:8000/v1 -m MODEL

The rewards are those of `train.reinforce`, with its weights. With `--env.taskset.seed 1`, the tasks
do not end: they are the items of the benchmark built with the seeds 1, 2, 3, ...
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import count
from pathlib import Path

import verifiers.v1 as vf

from dynapix.benchmark import Benchmark, Item, load
from dynapix.conf.compose import compose
from dynapix.conf.errors import UserError
from dynapix.conf.schema import BuildCommand, TeacherConfig
from dynapix.conf.schema.training import RewardWeights
from dynapix.data.build import ensure_benchmark
from dynapix.data.store import Store
from dynapix.teacher.predicates.facts import RelationalPredicates
from dynapix.teacher.predicates.vocabulary import describe_item
from dynapix.train.rewards import REWARDS, JudgedResponse, judge_response

WEIGHTS = RewardWeights()


class SelectionData(vf.TaskData):
    """An item: its prompt, and where the oracle's facts about it are."""

    store: str
    split: str
    answer: str
    family: str
    scene_id: str


class SelectionTask(vf.Task[SelectionData]):
    """Choose the future frame among four candidates."""

    @vf.reward(weight=WEIGHTS.answer)
    async def answer(self, trace: vf.Trace) -> float:
        return REWARDS["answer"](self._judge(trace))

    @vf.reward(weight=WEIGHTS.truth)
    async def truth(self, trace: vf.Trace) -> float:
        return REWARDS["truth"](self._judge(trace))

    @vf.reward(weight=WEIGHTS.following)
    async def following(self, trace: vf.Trace) -> float:
        return REWARDS["following"](self._judge(trace))

    @vf.reward(weight=WEIGHTS.no_numbers)
    async def no_numbers(self, trace: vf.Trace) -> float:
        return REWARDS["no_numbers"](self._judge(trace))

    @vf.reward(weight=WEIGHTS.form)
    async def form(self, trace: vf.Trace) -> float:
        return REWARDS["form"](self._judge(trace))

    def _judge(self, trace: vf.Trace) -> JudgedResponse:
        data = self.data
        return judge(data.store, data.split, str(data.id), trace.last_reply, trace.is_truncated)


class SelectionConfig(vf.TasksetConfig):
    """See `dynapix.load` for the settings without a description."""

    benchmark: str = "tiny"
    split: str = "train"
    store: str = "store"
    frames: int | None = None
    image_size: int | None = None
    mode: str = "reasoning"
    """`reasoning` asks for a rationale and the letter, `answer` for the letter alone."""
    seed: int | None = None
    """Seed of the first of endlessly many benchmarks, which are built in the folder `store` when
    they are needed. None gives the items of the benchmark that is already built."""
    workers: int = 1
    """Number of processes that build a benchmark."""


class SelectionTaskset(vf.Taskset[SelectionTask, SelectionConfig]):
    """The items of one benchmark, or of endlessly many."""

    def __init__(self, config: SelectionConfig) -> None:
        super().__init__(config)
        self.INFINITE = config.seed is not None

    def load(self) -> Iterator[SelectionTask]:
        """Yield a task for each item that the oracle can describe."""
        try:
            for bench in self._open_benchmarks():
                for item in bench.selection:
                    if find_predicates(bench.store, item) is not None:
                        yield SelectionTask(describe_task(item, bench, self.config.mode))
        except UserError as error:
            raise SystemExit(f"error: {error}") from None

    def _open_benchmarks(self) -> Iterator[Benchmark]:
        cfg = self.config
        shown = {"frames": cfg.frames, "image_size": cfg.image_size}
        if cfg.seed is None:
            yield load(cfg.benchmark, cfg.split, store=cfg.store, **shown)
            return
        for seed in count(cfg.seed):
            name = f"benchmark.name={cfg.benchmark}_seed{seed}"
            overrides = [f"benchmark={cfg.benchmark}", name, f"benchmark.seed={seed}"]
            preset = compose("data.build", BuildCommand, overrides).benchmark
            store = ensure_benchmark(preset, Path(cfg.store), cfg.workers)
            yield load(store.folder, cfg.split, **shown)


def describe_task(item: Item, bench: Benchmark, mode: str) -> SelectionData:
    """Return the data of an item, with the prompt of `Item.messages`."""
    [message] = item.messages(mode)
    return SelectionData(
        id=item.item_id,
        prompt=[vf.UserMessage(content=message["content"])],
        store=str(bench.store.folder),
        split=bench.split,
        answer=item.answer,
        family=item.family,
        scene_id=item.scene_id,
    )


def find_predicates(store: Store, item: Item) -> RelationalPredicates | None:
    """Return all predicates of an item; None if its prefix is too short."""
    return describe_item(item.record, store, TeacherConfig())


@lru_cache(maxsize=4)
def open_items(folder: str, split: str) -> tuple[Store, dict[str, Item]]:
    """Return a built benchmark, and its items by id."""
    bench = load(folder, split)
    return bench.store, {item.item_id: item for item in bench.selection}


@lru_cache(maxsize=256)
def judge(folder: str, split: str, item_id: str, text: str, truncated: bool) -> JudgedResponse:
    """Return what the oracle says of a response to an item, for all rewards once."""
    store, items = open_items(folder, split)
    predicates = find_predicates(store, items[item_id])
    return judge_response(text, truncated, items[item_id].record, predicates)


__all__ = ["SelectionTaskset"]
