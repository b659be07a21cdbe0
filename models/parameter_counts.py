"""A model's parameters by tower: what is quantised, adapted and trained in each."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields

from torch import nn

from conf.errors import UserError
from conf.schema import RetrieverConfig, StudentConfig

TOWERS = ("vision", "language", "embeddings and head")
PROJECTION = "projection"
"""Of a multi-vector retriever: no tower of its base's, so it is always trained, and whole."""


@dataclass
class Tower:
    """Parameters of one part of a model."""

    parameters: int = 0
    four_bit: int = 0
    lora: int = 0
    trainable: int = 0


def count_towers(model: nn.Module) -> dict[str, Tower]:
    """Parameters by tower. A 4-bit weight counts as the entries it stands for, not its bytes."""
    towers = {name: Tower() for name in TOWERS}
    for name, parameter in model.named_parameters():
        tower = towers.setdefault(_tower_of(name), Tower())
        entries, four_bit = _entries(parameter)
        tower.parameters += entries
        tower.four_bit += entries if four_bit else 0
        tower.lora += entries if "lora_" in name else 0
        tower.trainable += entries if parameter.requires_grad else 0
    return towers


def _entries(parameter: nn.Parameter) -> tuple[int, bool]:
    """How many entries a parameter stands for, and whether it holds them in 4 bits."""
    if type(parameter).__name__ != "Params4bit":
        return parameter.numel(), False
    if parameter.quant_state is not None:
        return parameter.quant_state.shape.numel(), True
    # Weights are packed as they are loaded; on the meta device they keep their own shape.
    return parameter.numel(), parameter.is_meta


def _tower_of(name: str) -> str:
    if re.search(r"(^|\.)visual\.", name):
        return "vision"
    if re.fullmatch(r"\d+\.linear\.weight", name):
        return PROJECTION
    return "language" if re.search(r"(^|\.)layers\.\d+\.", name) else "embeddings and head"


def check_towers(towers: dict[str, Tower], cfg: StudentConfig | RetrieverConfig) -> None:
    """Hold what was loaded against what the preset says.

    Raises:
        UserError: a tower is quantised, adapted or trained that should not be, or is not that
            should.
    """
    nf4, lora = cfg.quantization == "nf4", cfg.lora.rank > 0
    problems = []
    for name, tower in towers.items():
        language, projection = name == "language", name == PROJECTION
        for what, found, wanted in (
            ("4-bit", tower.four_bit > 0, nf4 and language),
            ("LoRA", tower.lora > 0, lora and language),
            ("trainable", tower.trainable > 0, language or projection or not lora),
        ):
            if found != wanted:
                problems.append(f"{name} has {'some' if found else 'no'} {what} parameters")
        if lora and not projection and tower.trainable != tower.lora:
            problems.append(f"{name} trains {tower.trainable - tower.lora} that are not LoRA")
    if problems:
        raise UserError(
            f"the loaded model is not what preset {cfg.name} says: {'; '.join(problems)}. Look at "
            "the quantization and lora.targets of the preset"
        )


def tower_table(towers: dict[str, Tower]) -> str:
    columns = [f.name for f in fields(Tower)]
    lines = [f"{'':<22}" + "".join(f"{c.replace('four_bit', '4-bit'):>14}" for c in columns)]
    for name, tower in towers.items():
        lines.append(f"{name:<22}" + "".join(f"{getattr(tower, c):>14,}" for c in columns))
    return "\n".join(lines)
