"""Count a model's parameters by tower: all, 4-bit, LoRA and trainable ones."""

from __future__ import annotations

import re

import pandas as pd
from torch import nn

from conf.errors import UserError
from models.compat import four_bit_entries

TOWERS = ["vision", "language", "embeddings and head"]
VISION = re.compile(
    r"(^|\.)(visual|vision_\w+|image_tower|connector|aligner|(multi_modal|mm)_projector)\."
)
"""Names of vision towers, and of what projects their outputs to the language tower."""
PROJECTION = "projection"
"""The projection of a multi-vector retriever's token states, all of whose weights are trained."""


def count_parameters(model: nn.Module) -> pd.DataFrame:
    """Return a table with a row per tower and the columns parameters, 4-bit, LoRA and trainable.

    Packed 4-bit parameters are counted by the number of weights that they contain.
    """
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
    if VISION.search(name):
        return "vision"
    if re.fullmatch(r"\d+\.linear\.weight", name):
        return PROJECTION
    return "language" if re.search(r"(^|\.)layers\.\d+\.", name) else "embeddings and head"


def check_parameter_counts(towers: pd.DataFrame, preset: str, quantization: str, rank: int) -> None:
    """Raise UserError unless exactly the towers that a preset's quantisation (nf4 or none) and rank
    (0 without adapters) imply are quantised, adapted and trained."""
    lora = rank > 0
    problems = []
    for name, counts in towers.iterrows():
        language, projection = name == "language", name == PROJECTION
        # The projection of a saved retriever with a single vector is frozen like its backbone.
        trains = language or (projection and counts["trainable"] > 0) or not lora
        expected = {
            "4-bit": quantization == "nf4" and language,
            "LoRA": lora and language,
            "trainable": trains,
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
