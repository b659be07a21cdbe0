"""Counts of a model's parameters by tower: quantised, adapted and trained ones."""

from __future__ import annotations

import re

import pandas as pd
from torch import nn

from conf.errors import UserError
from models.compat import four_bit_entries

TOWERS = ["vision", "language", "embeddings and head"]
PROJECTION = "projection"
"""The module of a multi-vector retriever after its base, which is always trained whole."""


def count_towers(model: nn.Module) -> pd.DataFrame:
    """Count the parameters, and those that are 4-bit, LoRA or trainable, with a row for each tower.
    A 4-bit weight counts as the entries that it stands for."""
    rows = []
    for name, parameter in model.named_parameters():
        four_bit = four_bit_entries(parameter)
        entries = parameter.numel() if four_bit is None else four_bit
        lora, trainable = entries * ("lora_" in name), entries * parameter.requires_grad
        rows.append((_tower_of(name), entries, four_bit or 0, lora, trainable))
    columns = ["tower", "parameters", "4-bit", "LoRA", "trainable"]
    counts = pd.DataFrame(rows, columns=columns).groupby("tower").sum()
    return counts.reindex([*TOWERS, *counts.index.difference(TOWERS)], fill_value=0)


def _tower_of(name: str) -> str:
    if re.search(r"(^|\.)visual\.", name):
        return "vision"
    if re.fullmatch(r"\d+\.linear\.weight", name):
        return PROJECTION
    return "language" if re.search(r"(^|\.)layers\.\d+\.", name) else "embeddings and head"


def check_towers(towers: pd.DataFrame, preset: str, quantization: str, rank: int) -> None:
    """Raise UserError if a tower of a loaded model is quantised, adapted or trained that should not
    be, or the reverse.

    Args:
        preset: Name of the preset.
        quantization: nf4 or none.
        rank: Of the adapters; 0 for a whole model.
    """
    lora = rank > 0
    problems = []
    for name, counts in towers.iterrows():
        language, projection = name == "language", name == PROJECTION
        expected = {
            "4-bit": quantization == "nf4" and language,
            "LoRA": lora and language,
            "trainable": language or projection or not lora,
        }
        for kind, wanted in expected.items():
            if (counts[kind] > 0) != wanted:
                problems.append(f"{name} has {'no' if wanted else 'some'} {kind} parameters")
        others = counts["trainable"] - counts["LoRA"]
        if lora and not projection and others:
            problems.append(f"{name} trains {others} parameters that are not LoRA")
    if problems:
        raise UserError(
            f"the loaded model differs from preset {preset}: {'; '.join(problems)}. Check the "
            "quantization and lora.targets of the preset",
            code="other-parameters",
        )
