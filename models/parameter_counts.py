"""Counts of a model's parameters by tower: quantised, adapted and trained ones."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass

import pandas as pd
from torch import nn

from conf.errors import UserError
from models.compat import four_bit_entries

TOWERS = ("vision", "language", "embeddings and head")
PROJECTION = "projection"
"""The module of a multi-vector retriever after its base, which is always trained whole."""


@dataclass
class Tower:
    """Parameters of one part of a model."""

    parameters: int = 0
    four_bit: int = 0
    lora: int = 0
    trainable: int = 0


def count_towers(model: nn.Module) -> dict[str, Tower]:
    """Count parameters by tower. A 4-bit weight counts as the entries that it stands for."""
    towers = {name: Tower() for name in TOWERS}
    for name, parameter in model.named_parameters():
        tower = towers.setdefault(_tower_of(name), Tower())
        four_bit = four_bit_entries(parameter)
        entries = parameter.numel() if four_bit is None else four_bit
        tower.parameters += entries
        tower.four_bit += four_bit or 0
        tower.lora += entries if "lora_" in name else 0
        tower.trainable += entries if parameter.requires_grad else 0
    return towers


def _tower_of(name: str) -> str:
    if re.search(r"(^|\.)visual\.", name):
        return "vision"
    if re.fullmatch(r"\d+\.linear\.weight", name):
        return PROJECTION
    return "language" if re.search(r"(^|\.)layers\.\d+\.", name) else "embeddings and head"


def check_towers(towers: dict[str, Tower], preset: str, quantization: str, rank: int) -> None:
    """Compare a loaded model with its preset.

    Args:
        preset: Name of the preset.
        quantization: nf4 or none.
        rank: Of the adapters; 0 for a whole model.

    Raises:
        UserError: a tower is quantised, adapted or trained that should not be, or the reverse.
    """
    nf4, lora = quantization == "nf4", rank > 0
    problems = []
    for name, tower in towers.items():
        language, projection = name == "language", name == PROJECTION
        for what, actual, expected in (
            ("4-bit", tower.four_bit > 0, nf4 and language),
            ("LoRA", tower.lora > 0, lora and language),
            ("trainable", tower.trainable > 0, language or projection or not lora),
        ):
            if actual != expected:
                problems.append(f"{name} has {'some' if actual else 'no'} {what} parameters")
        if lora and not projection and tower.trainable != tower.lora:
            problems.append(f"{name} trains {tower.trainable - tower.lora} that are not LoRA")
    if problems:
        raise UserError(
            f"the loaded model differs from preset {preset}: {'; '.join(problems)}. Check the "
            "quantization and lora.targets of the preset",
            code="other-parameters",
        )


def format_towers(towers: dict[str, Tower]) -> str:
    """Return a table with a row for each tower."""
    table = pd.DataFrame.from_dict({name: asdict(t) for name, t in towers.items()}, orient="index")
    return table.rename(columns={"four_bit": "4-bit"}).map("{:,}".format).to_string()
