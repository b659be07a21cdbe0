"""How many prefixes or frames of a retriever's step pass at once, chosen as
`train.common.memory_probe` does."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from conf.schema import ContrastiveTrainConfig
from data.records import RetrievalQuery
from models.memory import is_out_of_memory, peak_bytes, reset_peak
from models.retriever.embedder import Retriever
from train.common import memory_probe
from train.retriever.batches import Batch, batch_of
from train.retriever.inputs import RetrieverInputs
from train.retriever.loss import RankingLoss

TIMED = 64
"""Prefixes and frames that a size is timed by: enough to tell which is faster."""


def settle(
    train: ContrastiveTrainConfig,
    folder: Path,
    model: Retriever,
    inputs: RetrieverInputs,
    ranking: type[RankingLoss],
    queries: Sequence[RetrievalQuery],
) -> ContrastiveTrainConfig:
    """The settings with a number for `mini_batch` and a truth for `gradient_checkpointing`: what
    was given, what a run's folder notes, or what a probe of the training queries leads to."""

    def trial(share: int) -> MiniBatches:
        return MiniBatches(model, inputs, ranking, queries, train, share)

    size = train.mini_batch
    if train.mini_batch_tokens is not None:
        # As many of the longest as fill a mini-batch that is counted in tokens.
        names = batch_of(
            queries, train.hard_negatives, train.distinct_frames, train.shared_prefixes
        )
        size = max(1, train.mini_batch_tokens // max(inputs.prefix_lengths(names)))
    asked = memory_probe.Choice(size, train.gradient_checkpointing)
    spare = memory_probe.spare_beside(train.reuse_features)
    found = memory_probe.decide(
        asked, train.batch, folder, model[0].model, trial, "mini-batch", spare
    )
    return replace(
        train,
        mini_batch=train.mini_batch if train.mini_batch_tokens is not None else found.micro_batch,
        gradient_checkpointing=found.gradient_checkpointing,
    )


def lower(train: ContrastiveTrainConfig) -> str:
    """By which keys a run that was out of memory takes less of it."""
    sized = "mini_batch" if train.mini_batch_tokens is None else "mini_batch_tokens"
    found = f"{sized}, which is {getattr(train, sized)} and changes no gradient"
    return memory_probe.lowered(f"train.{found}", train)


class MiniBatches:
    """Trials by the two passes that a step makes of its mini-batches."""

    def __init__(
        self,
        model: Retriever,
        inputs: RetrieverInputs,
        ranking: type[RankingLoss],
        queries: Sequence[RetrievalQuery],
        train: ContrastiveTrainConfig,
        share: int,
    ) -> None:
        self._model, self._inputs, self._ranking = model, inputs, ranking
        self._train, self._share = train, share
        self._queries = queries
        whole = self._batch(queries)
        lengths = inputs.prefix_lengths(whole)
        groups = whole.groups(0, len(lengths))
        self._longest = [groups[k] for k in sorted(range(len(groups)), key=lambda k: -lengths[k])]

    def bytes(self, mini_batch: int, recompute: bool) -> int | None:
        """Of prefixes, which are longer than frames."""
        memory_probe.switch(self._model[0].model, recompute)
        batch = self._batch([query for group in self._longest[:mini_batch] for query in group])
        given = self._inputs.on_device(self._inputs.of_prefixes(batch, 0, len(batch.prefixes)))
        held = reset_peak(self._model.device)
        try:
            self._pass(given, "query")
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            return None
        return max(0, peak_bytes(self._model.device) - held)

    def seconds(self, mini_batch: int, recompute: bool) -> float:
        memory_probe.switch(self._model[0].model, recompute)
        count = min(self._share, max(TIMED, mini_batch))
        # Queries stand builder by builder: these are of all.
        batch = self._batch(self._queries[:: max(1, len(self._queries) // count)][:count])
        # The first of all warms up.
        self._timed(*next(self._parts(batch, mini_batch)))
        spent = sum(self._timed(*part) for part in self._parts(batch, mini_batch))
        return spent * self._share / len(batch.queries)

    def _parts(self, batch: Batch, size: int) -> Iterator[tuple[dict[str, Any], str]]:
        """The mini-batches of a batch, made when they are taken, and their tasks."""
        for make, count, task in (
            (self._inputs.of_prefixes, len(batch.prefixes), "query"),
            (self._inputs.of_frames, len(batch.frames), "document"),
        ):
            for start in range(0, count, size):
                made = make(batch, start, min(start + size, count))
                yield self._inputs.on_device(made), task

    def _batch(self, queries: Sequence[RetrievalQuery]) -> Batch:
        train = self._train
        return batch_of(queries, train.hard_negatives, train.distinct_frames, train.shared_prefixes)

    def _timed(self, given: dict[str, Any], task: str) -> float:
        started = time.perf_counter()
        with torch.no_grad():
            self._embedded(given, task)
        self._pass(given, task)
        return time.perf_counter() - started

    def _pass(self, given: dict[str, Any], task: str) -> None:
        try:
            self._embedded(given, task).float().sum().backward()
        finally:
            self._model.zero_grad()
        if self._model.device.type == "cuda":
            torch.cuda.synchronize(self._model.device)

    def _embedded(self, given: dict[str, Any], task: str) -> torch.Tensor:
        bf16 = self._train.precision == "bf16"
        with torch.autocast(self._model.device.type, torch.bfloat16, enabled=bf16):
            # The forward pass changes what it is given.
            return self._ranking.embed(self._model, dict(given), task)
