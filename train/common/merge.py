"""Writes a trained student or retriever merged into its base, and measures how far the merged
weights are from the adapters over their 4-bit base."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch

from conf.errors import UserError

log = logging.getLogger(__name__)

Measured = dict[str, float]


@dataclass(frozen=True)
class ModelOutputs:
    """What a model returns for held-out items.

    Attributes:
        values: Tensors by name, such as logits.
        choices: What the model chooses for each item, by name.
        scales: By name, the tensors whose size a difference is relative to; by default the values.
    """

    values: dict[str, list[torch.Tensor]]
    choices: dict[str, list[int]] = field(default_factory=dict)
    scales: dict[str, list[torch.Tensor]] = field(default_factory=dict)


class Merge(Protocol):
    """How a kind of model is merged; see `train.student.merge` and `train.retriever.merge`."""

    product: str
    max_difference: float

    def held_out(self, store: Path, workers: int) -> Any:
        """Items of held-out training scenes.

        Raises:
            UserError: The benchmark is missing.
        """

    def trained_outputs(self, items: Any) -> ModelOutputs:
        """Outputs of the adapters over their 4-bit base."""

    def write(self, folder: Path, format: str) -> None:
        """Write the merged model, its weights in `format` (bf16 or fp32)."""

    def merged_outputs(self, folder: Path, items: Any) -> ModelOutputs:
        """Outputs of the merged model in a folder, loaded as anyone loads it."""


def write_merged(
    merge: Merge, folder: Path, format: str, store: Path | None, workers: int
) -> Measured:
    """Write a merged model and compare its outputs with those of the trained one, on held-out items
    of the benchmark in `store`; None does not compare them.

    Raises:
        UserError: They differ too much, or the benchmark is missing.
    """
    if store is None:
        merge.write(folder, format)
        return {}
    items = merge.held_out(store, workers)
    log.info("running the trained %s", merge.product)
    before = merge.trained_outputs(items)
    log.info("merging")
    merge.write(folder, format)
    log.info("running the merged %s", merge.product)
    measured = compare(before, merge.merged_outputs(folder, items))
    for name, value in measured.items():
        # The negation also refuses NaN.
        if name.endswith("_difference") and not value <= merge.max_difference:
            raise UserError(
                f"the {name.replace('_', ' ')} of the merged {merge.product} is {value:.3g} of its "
                f"size, more than {merge.max_difference}; nothing was exported. Try format=fp32 or "
                "format=adapter",
                code="merge-difference",
            )
    return measured


def compare(before: ModelOutputs, after: ModelOutputs) -> Measured:
    """Root mean square differences relative to the size of the values (`<name>_difference`), and
    the share of equal choices (`<name>_agreement`)."""
    measured: Measured = {}
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


def check_benchmark(folder: Path) -> None:
    """Raise UserError if the benchmark on which merged weights are compared is missing."""
    if not folder.exists():
        raise UserError(
            f"{folder} is missing, and the export compares the merged weights with the trained "
            "ones on its held-out items: build it with python -m data.build, or set verify=false",
            code="missing-benchmark",
        )
