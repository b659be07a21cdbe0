"""Find the towers of a vision-language model, and count their parameters: all, 4-bit, LoRA and
trainable ones."""

from __future__ import annotations

import re
from typing import Any

import pandas as pd
import torch
from torch import nn
from transformers import PreTrainedConfig, PreTrainedModel

from dynapix.conf.errors import UserError
from dynapix.models.compat import four_bit_entries

TOWERS = ["vision", "language", "embeddings and head"]
VISION = re.compile(
    r"(^|\.)(visual|vision_\w+|image_tower|connector|aligner|(multi_modal|mm)_projector)\."
)
"""Names of vision towers, and of what projects their outputs to the language tower."""
PROJECTION = "projection"
"""The projection of a multi-vector retriever's token states, all of whose weights are trained."""
LAYER = re.compile(r"(?P<layers>.*\blayers)\.\d+\.(?P<linear>.*)")
"""Name of a module within a layer of a tower."""


def find_language_tower(model: PreTrainedModel) -> str:
    """Return the name of a model's language tower (its text decoder, without the head)."""
    tower = model.get_decoder()
    if tower is model:
        # A model with an image tower and a text tower, such as CLIP, has no decoder.
        tower = getattr(model, "text_model", model)
    return next(name for name, module in model.named_modules() if module is tower)


def choose_lora_targets(model: PreTrainedModel) -> str:
    """Return a regular expression of the full names of the linear layers in the language tower's
    layers: its attention and feed-forward projections."""
    tower = find_language_tower(model)
    prefix = f"{tower}." if tower else ""
    linear: dict[str, set[str]] = {}
    for name, module in model.named_modules():
        found = LAYER.fullmatch(name.removeprefix(prefix))
        if name.startswith(prefix) and isinstance(module, nn.Linear) and found:
            linear.setdefault(found["layers"], set()).add(found["linear"])
    return "|".join(
        re.escape(prefix + layers) + rf"\.\d+\.({'|'.join(map(re.escape, sorted(names)))})"
        for layers, names in sorted(linear.items())
    )


def find_unquantized(auto_class: Any, config: PreTrainedConfig, **origin: Any) -> list[str]:
    """Return the names of the modules that are not quantised: the largest ones that do not contain
    the language tower, such as the vision tower and the head.

    Args:
        auto_class: The class of transformers that loads the model.
        origin: Its arguments about code from the model's repository.
    """
    with torch.device("meta"):
        model = auto_class.from_config(config, **origin)
    tower = find_language_tower(model)
    path = [""]
    for part in tower.split("."):
        path.append(f"{path[-1]}.{part}".strip("."))
    # The children of the modules on the path to the tower, except this path.
    return [
        name
        for name, _ in model.named_modules()
        if name not in path and name.rpartition(".")[0] in path[:-1]
    ]


def count_parameters(model: nn.Module) -> pd.DataFrame:
    """Return a table with a row per tower and the columns parameters, 4-bit, LoRA and trainable.

    Packed 4-bit parameters are counted by the number of weights that they contain.
    """
    rows = []
    for name, parameter in model.named_parameters():
        four_bit = four_bit_entries(parameter)
        entries = parameter.numel() if four_bit is None else four_bit
        lora, trainable = entries * ("lora_" in name), entries * parameter.requires_grad
        rows.append((tower_of(name), entries, four_bit or 0, lora, trainable))
    columns = ["tower", "parameters", "4-bit", "LoRA", "trainable"]
    counts = pd.DataFrame(rows, columns=columns).groupby("tower").sum()
    return counts.reindex([*TOWERS, *counts.index.difference(TOWERS)], fill_value=0)


def tower_of(name: str) -> str:
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
