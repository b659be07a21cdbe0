"""Several processes (ranks) that train one model."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, TypeVar

from conf.errors import UserError
from conf.runs import rank, world_size

if TYPE_CHECKING:
    import torch
    from accelerate import PartialState
    from torch import distributed
    from torch.nn import Parameter


Input, Output = TypeVar("Input"), TypeVar("Output")


@contextmanager
def main_first() -> Iterator[None]:
    """Run a block on the main rank first, and on the other ranks after the main rank has finished.

    Work whose result the main rank writes to disk is thus done only once.
    """
    if world_size() == 1:
        yield
        return
    from torch import distributed

    with _patient_group() as group:
        if rank() > 0:
            distributed.barrier(group)
        yield
        if rank() == 0:
            distributed.barrier(group)


@contextmanager
def _patient_group() -> Iterator[distributed.ProcessGroup]:
    """Yield a group of all ranks whose operations may wait for days. The timeout of the default
    group suits training steps."""
    from torch import distributed

    _get_state()
    group = distributed.new_group(backend="gloo", timeout=timedelta(days=30))
    yield group
    distributed.destroy_process_group(group)


def map_over_ranks(
    function: Callable[[Input], Output], inputs: Sequence[Input]
) -> Iterator[Output]:
    """Yield the result of a function for each input, in order. The ranks compute one result each at
    a time, and all of them yield all results. All ranks must have the same inputs."""
    if world_size() == 1:
        yield from map(function, inputs)
        return
    from torch import distributed

    with _patient_group() as group:
        for first in range(0, len(inputs), world_size()):
            own = inputs[first + rank() : first + rank() + 1]
            results: list[list[Output]] = [[] for _ in range(world_size())]
            distributed.all_gather_object(results, [*map(function, own)], group)
            for result in results:
                yield from result


def share_from_main(value: Input) -> Input:
    """Return the main rank's value on all ranks."""
    if world_size() == 1:
        return value
    from torch import distributed

    shared = [value]
    with _patient_group() as group:
        distributed.broadcast_object_list(shared, 0, group)
    return shared[0]


def rank_device() -> torch.device:
    """Return this rank's GPU, or the CPU."""
    return _get_state().device


def _get_state() -> PartialState:
    """Return accelerate's state of this rank. The first call initialises torch.distributed."""
    import torch
    from accelerate import PartialState

    return PartialState(cpu=not torch.cuda.is_available())


def average_gradients(parameters: Iterable[Parameter]) -> None:
    """Replace the gradients by their means over all ranks.

    A gradient that only some ranks have is 0 on the others; one that no rank has stays None, so
    that the optimizer leaves its parameter unchanged.
    """
    if world_size() == 1:
        return
    import torch
    from torch import distributed

    _get_state()
    parameters = [*parameters]
    device = parameters[0].device
    present = torch.tensor([float(p.grad is not None) for p in parameters], device=device)
    distributed.all_reduce(present)
    trained = [p for p, ranks in zip(parameters, present.tolist(), strict=True) if ranks]
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in trained]
    joined = torch.cat([g.flatten() for g in gradients])
    distributed.all_reduce(joined)
    means = (joined / world_size()).split([p.numel() for p in trained])
    for parameter, mean in zip(trained, means, strict=True):
        parameter.grad = mean.view_as(parameter)


def end_ranks() -> None:
    """Wait for all ranks, and end their communication. A rank that exits without this can abort the
    others."""
    if world_size() > 1:
        from torch import distributed

        distributed.barrier()
        distributed.destroy_process_group()


def split_batch(batch: int, micro_batch: int = 1, key: str = "train.batch") -> int:
    """Return the number of micro-batches per rank of a step of `batch` samples over all ranks.

    Args:
        key: The setting of `batch`, for the error message.

    Raises:
        UserError: The batch cannot be split into full micro-batches, equally many on each rank.
    """
    ranks, samples = world_size(), micro_batch * world_size()
    if batch % samples:
        parts = f" in micro-batches of train.micro_batch={micro_batch}" if micro_batch > 1 else ""
        multiple = max(1, round(batch / samples)) * samples
        remedies = [f"{key} to a multiple of {samples}, such as {multiple}"]
        if smaller := [n for n in range(1, micro_batch) if batch % (n * ranks) == 0]:
            remedies.insert(0, f"train.micro_batch to {max(smaller)}")
        raise UserError(
            f"{key}={batch} cannot be split over {ranks} ranks{parts}: set "
            f"{' or '.join(remedies)}, or change the number of ranks",
            code="uneven-batch",
        )
    return batch // samples


def is_sharded() -> bool:
    """Return whether the launcher shards the model over the ranks (FSDP)."""
    return os.environ.get("ACCELERATE_USE_FSDP") == "true"
