"""Compare the outputs of a merged model with those of the trained model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from dynapix.conf.errors import UserError
from dynapix.conf.schema import BenchmarkConfig
from dynapix.data.build import ensure_benchmark
from dynapix.data.store import Store


@dataclass(frozen=True)
class ModelOutputs:
    """The outputs of a model for held-out items or queries, by name.

    Attributes:
        values: Tensors, such as logits.
        choices: The index of what the model chooses for each item or query.
        scales: Tensors to whose size a difference is relative; by default, the values themselves.
    """

    values: dict[str, list[torch.Tensor]]
    choices: dict[str, list[int]] = field(default_factory=dict)
    scales: dict[str, list[torch.Tensor]] = field(default_factory=dict)


def compare_outputs(before: ModelOutputs, after: ModelOutputs) -> dict[str, float]:
    """Return the root mean square of the differences between values, relative to that of their
    scales (`<name>_difference`), and the share of equal choices (`<name>_agreement`)."""
    measured: dict[str, float] = {}
    for name, values in before.values.items():
        changes = [b - a for b, a in zip(values, after.values[name], strict=True)]
        scale = root_mean_square(before.scales.get(name, values))
        measured[f"{name}_difference"] = root_mean_square(changes) / scale
    for name, choices in before.choices.items():
        equal = [b == a for b, a in zip(choices, after.choices[name], strict=True)]
        measured[f"{name}_agreement"] = sum(equal) / len(equal)
    return measured


def root_mean_square(tensors: Sequence[torch.Tensor]) -> float:
    total = sum(float(t.square().sum()) for t in tensors)
    return (total / sum(t.numel() for t in tensors)) ** 0.5


def require_benchmark(cfg: BenchmarkConfig, root: Path, workers: int) -> Store:
    """Open the benchmark on which a merged model is compared with the trained model.

    Raises:
        UserError: The benchmark is missing. An export does not build it.
    """
    if not (folder := root / cfg.store_name).exists():
        raise UserError(
            f"{folder} is missing, and the export compares the merged with the trained model on "
            "its held-out scenes: build it with python -m data.build, or set verify=false",
            code="missing-benchmark",
        )
    return ensure_benchmark(cfg, root, workers)
