"""Several ranks train one model: who prepares for all, and what each takes of a step."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TypeVar

from conf.errors import UserError
from conf.runs import rank, world_size

PATIENCE = timedelta(days=30)
"""How long ranks wait while the main one builds and narrates."""

Made = TypeVar("Made")


def from_main(make: Callable[[], Made]) -> Made:
    """What `make` gives on the main rank, on every one; the others wait for it as long as it takes.
    Alone, a process just makes it."""
    if world_size() == 1:
        return make()
    import torch
    from accelerate import PartialState

    # Gives a rank its GPU too.
    PartialState(cpu=not torch.cuda.is_available())
    # A group of its own: ranks that wait in a step so long have lost another.
    waiting = torch.distributed.new_group(backend="gloo", timeout=PATIENCE)
    made = [make() if rank() == 0 else None]
    torch.distributed.broadcast_object_list(made, src=0, group=waiting)
    torch.distributed.destroy_process_group(waiting)
    return made[0]


@contextmanager
def main_first() -> Iterator[None]:
    """Run a block on the main rank first; the others wait as long as it takes, then run it too.

    Work that is kept on disk is thus done once, and every rank reads the result from there.
    """
    if world_size() == 1:
        yield
        return
    import torch
    from accelerate import PartialState

    # This also assigns each rank its GPU.
    PartialState(cpu=not torch.cuda.is_available())
    # A separate group with its own timeout: a rank that waits this long in a step has lost another.
    group = torch.distributed.new_group(backend="gloo", timeout=PATIENCE)
    if rank() > 0:
        torch.distributed.barrier(group)
    yield
    if rank() == 0:
        torch.distributed.barrier(group)
    torch.distributed.destroy_process_group(group)


def accumulation_steps(batch: int, micro_batch: int) -> int:
    """How many micro-batches a rank takes of a step of `batch` samples over all ranks.

    Raises:
        UserError: they cannot all be full.
    """
    at_once = micro_batch * world_size()
    if batch % at_once:
        near = max(1, round(batch / at_once)) * at_once
        raise UserError(
            f"train.batch={batch} cannot be split over {world_size()} ranks in micro-batches of "
            f"train.micro_batch={micro_batch}: set train.batch to a multiple of {at_once}, such as "
            f"{near}, or start another number of ranks"
        )
    return batch // at_once


def per_rank_batch(batch: int) -> int:
    """A rank's part of a batch over all ranks.

    Raises:
        UserError: they cannot have equal parts.
    """
    if batch % world_size():
        raise UserError(
            f"train.batch={batch} cannot be split over {world_size()} ranks: set it to a multiple "
            f"of {world_size()}, or start another number of ranks"
        )
    return batch // world_size()


def is_sharded() -> bool:
    """Whether a launcher was told to give each rank a part of the model."""
    return os.environ.get("ACCELERATE_USE_FSDP") == "true"


def check_unsharded() -> None:
    """Raises UserError where a launcher was told to shard what it cannot: a retriever."""
    if is_sharded():
        raise UserError(
            "FSDP does not shard a retriever: sentence-transformers reads each checkpoint as a "
            "whole model; leave --use_fsdp away (and give --multi_gpu, on CPUs too)"
        )
