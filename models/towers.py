"""Find the language tower of a vision-language model by its structure in transformers."""

from __future__ import annotations

import re
from typing import Any

import torch
from torch import nn
from transformers import PreTrainedConfig, PreTrainedModel

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
