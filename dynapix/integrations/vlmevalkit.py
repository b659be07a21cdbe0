"""Selection items as a table for VLMEvalKit, which needs nothing of DynaPix to read it:

    bench = dynapix.load("tiny", image_size=336)
    write_table(bench, "LMUData/DynaPix")

A prompt is that of `Item.messages`. docs/evaluation.md has the class that reads the table.
"""

from __future__ import annotations

import base64
import csv
import hashlib
import io
from pathlib import Path
from typing import Any

from dynapix.benchmark import Benchmark
from dynapix.conf.errors import UserError
from dynapix.conf.files import write_bytes
from dynapix.data.publish.folders import Shard, describe_file, write_folder
from dynapix.integrations import TOKENS

TABLE, IMAGES, PLACEHOLDER = "selection.tsv", "images", "<image>"
VERSION = "1"
"""Changes whenever the same benchmark would give another table."""


def write_table(benchmark: Benchmark, folder: str | Path, mode: str = "reasoning") -> Path:
    """Write selection.tsv and its images to a folder, unless they are there, and return its path.

    Columns: index (the item's id), question (the prompt, with `<image>` for each image), image_path
    (the images in this order, relative to the folder), answer, category (the family), l2-category
    (the subtype), scene_id, split.

    Args:
        mode: `reasoning` asks for a rationale and the letter, `answer` for the letter alone.

    Raises:
        UserError: The folder contains something else, or the mode is unknown.
    """
    if mode not in TOKENS:
        raise UserError(f"mode={mode}: choose {' or '.join(TOKENS)}", code="unknown-option")
    plan = {
        "benchmark": benchmark.store.identity,
        "settings": [benchmark.split, benchmark.frames, benchmark.image_size, mode],
        "version": VERSION,
    }

    def write(unfinished: Path) -> list[Shard]:
        (unfinished / IMAGES).mkdir(exist_ok=True)
        rows = []
        for item in benchmark.selection:
            [message] = item.messages(mode)
            question, images = write_prompt(message["content"], unfinished)
            rows.append(
                {
                    "index": item.item_id, "question": question, "image_path": images,
                    "answer": item.answer, "category": item.family,
                    "l2-category": item.subtype, "scene_id": item.scene_id,
                    "split": benchmark.split,
                }
            )  # fmt: skip
        text = io.StringIO()
        table = csv.DictWriter(text, list(rows[0]), delimiter="\t", lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
        write_bytes(unfinished / TABLE, text.getvalue().encode())
        return [describe_file(unfinished, unfinished / TABLE)]

    write_folder(Path(folder), plan, write)
    return Path(folder) / TABLE


def write_prompt(parts: list[dict[str, Any]], folder: Path) -> tuple[str, list[str]]:
    """Write the images of a chat message to a folder, each once. Return the text, with a
    placeholder for each image, and their relative paths."""
    text, names = "", []
    for part in parts:
        if part["type"] == "text":
            text += part["text"]
            continue
        png = base64.b64decode(part["image_url"]["url"].partition(",")[2])
        name = f"{IMAGES}/{hashlib.sha256(png).hexdigest()[:32]}.png"
        if not (folder / name).exists():
            write_bytes(folder / name, png)
        text += PLACEHOLDER
        names.append(name)
    return text, names
