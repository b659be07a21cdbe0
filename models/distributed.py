"""Several processes (ranks) that train one model."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, TypeVar

from conf.errors import UserError
from conf.runs import rank, world_size

if TYPE_CHECKING:
    import torch

PATIENCE = timedelta(days=30)
"""How long ranks wait while the main one builds and narrates."""

Made = TypeVar("Made")


@contextmanager
def main_first() -> Iterator[None]:
    """Run a block on the main rank first; the others wait as long as it takes, then run it too.

    Work that is kept on disk is thus done once, and every rank reads the result from there.
    """
    if world_size() == 1:
        yield
        return
    import torch

    # This also assigns each rank its GPU.
    rank_device()
    # A separate group with its own timeout: a rank that waits this long in a step has lost another.
    group = torch.distributed.new_group(backend="gloo", timeout=PATIENCE)
    if rank() > 0:
        torch.distributed.barrier(group)
    yield
    if rank() == 0:
        torch.distributed.barrier(group)
    torch.distributed.destroy_process_group(group)


def from_main(make: Callable[[], Made]) -> Made:
    """Return what `make` returns on the main rank, on every rank; the others wait for it."""
    if world_size() == 1:
        return make()
    import torch

    rank_device()
    group = torch.distributed.new_group(backend="gloo", timeout=PATIENCE)
    made = [make() if rank() == 0 else None]
    torch.distributed.broadcast_object_list(made, src=0, group=group)
    torch.distributed.destroy_process_group(group)
    return made[0]


def rank_device() -> torch.device:
    """Return this rank's GPU, or the CPU; the first call connects the ranks."""
    import torch
    from accelerate import PartialState

    return PartialState(cpu=not torch.cuda.is_available()).device


def accumulation_steps(batch: int, micro_batch: int) -> int:
    """Return the micro-batches that a rank takes of a step of `batch` samples over all ranks.

    Raises:
        UserError: not all of them would be full.
    """
    at_once = micro_batch * world_size()
    if batch % at_once:
        near = max(1, round(batch / at_once)) * at_once
        raise UserError(
            f"train.batch={batch} cannot be split over {world_size()} ranks in micro-batches of "
            f"train.micro_batch={micro_batch}: set train.batch to a multiple of {at_once}, such as "
            f"{near}, or start another number of ranks",
            code="uneven-batch",
        )
    return batch // at_once


def per_rank_batch(batch: int) -> int:
    """Return a rank's part of a batch over all ranks.

    Raises:
        UserError: the parts would not be equal.
    """
    if batch % world_size():
        raise UserError(
            f"train.batch={batch} cannot be split over {world_size()} ranks: set it to a multiple "
            f"of {world_size()}, or start another number of ranks",
            code="uneven-batch",
        )
    return batch // world_size()


def is_sharded() -> bool:
    """Whether the launcher shards the model over the ranks (FSDP)."""
    return os.environ.get("ACCELERATE_USE_FSDP") == "true"


def check_unsharded() -> None:
    """Raise UserError if the launcher is to shard a retriever."""
    if is_sharded():
        raise UserError(
            "FSDP does not shard a retriever: sentence-transformers reads each checkpoint as a "
            "whole model; start without --use_fsdp (and with --multi_gpu, on CPUs too)",
            code="unsupported-with-fsdp",
        )
