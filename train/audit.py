"""What was loaded and what will be seen, printed and checked before a run's first step."""

from __future__ import annotations

import re

from torch import nn
from transformers import ProcessorMixin

from conf.schema import StudentConfig
from train.backbone import check_towers, count_towers, tower_table
from train.collate import IGNORED, Collator
from train.conversation import Sample


def audit(
    model: nn.Module,
    processor: ProcessorMixin,
    cfg: StudentConfig,
    sample: Sample,
    collator: Collator,
) -> str:
    """Parameter counts by tower, the grids that frames become, and a decoded sample whose
    supervised part stands between >>> and <<<.

    Raises:
        UserError: the counts are not what the preset says.
    """
    towers = count_towers(model)
    check_towers(towers, cfg)
    batch = collator([sample])
    ids = batch["input_ids"][0]
    supervised = int((batch["labels"] != IGNORED).sum())
    prompt, response = ids[: len(ids) - supervised], ids[len(ids) - supervised :]
    decode = processor.tokenizer.decode
    return "\n".join(
        [
            f"audit of {cfg.name} ({cfg.quantization}, {'LoRA' if cfg.lora else 'whole'})",
            tower_table(towers),
            f"frames of {cfg.image_size} x {cfg.image_size} px become {grids(batch, processor)}",
            f"a sample of {len(ids)} tokens, {supervised} of them supervised:",
            f"{squeeze(decode(prompt))}>>>{squeeze(decode(response))}<<<",
        ]
    )


def grids(batch: dict, processor: ProcessorMixin) -> str:
    """The vision tokens of a batch in words, frames x rows x columns."""
    merge = processor.image_processor.merge_size
    told = []
    for name, what in (("video_grid_thw", "a video"), ("image_grid_thw", "an image")):
        if name in batch:
            time, height, width = batch[name][0].tolist()
            rows, columns = height // merge, width // merge
            told.append(f"{what} of {time} x {rows} x {columns} tokens")
    return " and ".join(told)


def squeeze(text: str) -> str:
    """A decoded text with each run of vision tokens as one."""
    return re.sub(r"(<\|(image|video)_pad\|>)+", r"\1...", text)
