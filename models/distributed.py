"""Several processes (ranks) that train one model."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from functools import cache
from typing import TYPE_CHECKING, TypeVar

from dynapix.conf.errors import UserError
from dynapix.conf.runs import rank, world_size

if TYPE_CHECKING:
    import torch
    from accelerate import PartialState
    from torch import distributed


Input, Output = TypeVar("Input"), TypeVar("Output")

STEP_TIMEOUT = timedelta(hours=2)
"""How long a rank waits for the others in a training step. Between two steps, the main rank saves
and evaluates, which can take longer than 10 minutes, torch's default on GPUs."""


@contextmanager
def main_first() -> Iterator[None]:
    """Run a block on the main rank first, and on the other ranks after the main rank has finished.

    Work whose result the main rank writes to disk is thus done only once.
    """
    if world_size() == 1:
        yield
        return
    from torch import distributed

    group = patient_group()
    if rank() > 0:
        distributed.barrier(group)
    yield
    if rank() == 0:
        distributed.barrier(group)


@cache
def patient_group() -> distributed.ProcessGroup:
    """Return a group of all ranks for tensors on CPUs, whose operations may wait for days. All
    ranks make the first call together."""
    from torch import distributed

    _get_state()
    return distributed.new_group(backend="gloo", timeout=timedelta(days=30))


def map_over_ranks(
    function: Callable[[Input], Output], inputs: Sequence[Input]
) -> Iterator[Output]:
    """Yield the result of a function for each input, in order. The ranks compute one result each at
    a time, and all of them yield all results. All ranks must have the same inputs."""
    if world_size() == 1:
        yield from map(function, inputs)
        return
    from torch import distributed

    for first in range(0, len(inputs), world_size()):
        own = inputs[first + rank() : first + rank() + 1]
        results: list[list[Output]] = [[] for _ in range(world_size())]
        distributed.all_gather_object(results, [*map(function, own)], patient_group())
        for result in results:
            yield from result


def share_from_main(value: Input) -> Input:
    """Return the main rank's value on all ranks."""
    if world_size() == 1:
        return value
    from torch import distributed

    shared = [value]
    distributed.broadcast_object_list(shared, 0, patient_group())
    return shared[0]


def rank_device() -> torch.device:
    """Return this rank's GPU with its number, or the CPU."""
    import torch

    # The state makes the rank's GPU the current one.
    device = _get_state().device
    return torch.device("cuda", torch.cuda.current_device()) if device.type == "cuda" else device


def _get_state() -> PartialState:
    """Return accelerate's state of this rank. The first call initialises torch.distributed."""
    import torch
    from accelerate import PartialState

    return PartialState(cpu=not torch.cuda.is_available(), timeout=STEP_TIMEOUT)


def end_ranks() -> None:
    """Wait for all ranks, and end their communication. A rank that exits without this can abort the
    others."""
    if world_size() > 1:
        from torch import distributed

        distributed.barrier(patient_group())
        distributed.destroy_process_group()
        patient_group.cache_clear()


def split_batch(batch: int, micro_batch: int = 1, key: str = "train.batch") -> int:
    """Return the number of micro-batches per rank of a step of `batch` samples over all ranks.

    Args:
        key: The setting of `batch`, for the error message.

    Raises:
        UserError: The batch cannot be split into full micro-batches, equally many on each rank.
    """
    samples = micro_batch * world_size()
    if batch % samples:
        parts = f" in micro-batches of train.micro_batch={micro_batch}" if micro_batch > 1 else ""
        raise UserError(
            f"{key}={batch} cannot be split over {world_size()} ranks{parts}: set {key} to a "
            f"multiple of {samples}, or change the number of ranks or train.micro_batch",
            code="uneven-batch",
        )
    return batch // samples


def is_sharded() -> bool:
    """Return whether the launcher shards the model over the ranks (FSDP)."""
    return os.environ.get("ACCELERATE_USE_FSDP") == "true"


def lacks_weights() -> bool:
    """Return whether this rank gets the weights of a model that is sharded from the main rank, and
    loads none itself. The first rank of a machine loads them, as transformers expects."""
    return (
        is_sharded()
        and os.environ.get("FSDP_CPU_RAM_EFFICIENT_LOADING") == "true"
        and os.environ["LOCAL_RANK"] != "0"
    )
