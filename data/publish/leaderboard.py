"""The table behind a leaderboard on the Hugging Face hub, whose `eval.yaml` describes a task of
inspect_ai with one text and one image per question.

The image is a sheet: the frames of the prefix in the order of time, each under its time, and the
four candidates, each under its letter. `inspect eval hf/ORGANISATION/NAME` asks these questions.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from typing import Any

import yaml
from PIL import Image, ImageDraw, ImageFont

from dynapix.data.frames.frame_cache import FrameReader, encode_png
from dynapix.data.records import LETTERS, SelectionItem, sample_prefix_frames

EVAL_FILE = "eval.yaml"
COLUMNS, CELL_WIDTH, CAPTION, GAP = 4, 336, 24, 4
"""Cells in a row of a sheet, the maximum width of a cell's frame, the height of its caption and the
width of the gap between cells in pixels."""
INSTRUCTION = (
    "The image shows frames of a video in the order of time, each under its time in seconds, and "
    "then four candidates, A to D. {question} Explain what will happen. End with a line "
    '"Answer:" and the letter.'
)
PATTERN = r"(?i)answer:\s*[*_(]*([A-D])\b"
"""Finds the letter in a response. The hub allows only scorers of inspect_ai itself."""


def write_question(item: SelectionItem, frames: FrameReader, count: int) -> dict[str, Any]:
    """Return an item's row: its text, its sheet as a data URI, and the letter of the answer.

    Args:
        count: Number of frames of the prefix.
    """
    fps = frames.scene(item.scene_id).fps
    indices = sample_prefix_frames(item.prefix_start, item.prefix_stop, count)
    prefix = [(f"{k / fps:.2f} s", frames.image(item.scene_id, k)) for k in indices]
    candidates = [
        (letter, frames.image(c.scene_id, c.frame))
        for letter, c in zip(LETTERS, item.candidates, strict=True)
    ]
    png = base64.b64encode(encode_png(draw_sheet(prefix, candidates))).decode()
    return {
        "item_id": item.item_id,
        "scene_id": item.scene_id,
        "family": item.family,
        "subtype": item.subtype,
        "question": INSTRUCTION.format(question=item.question),
        "image": f"data:image/png;base64,{png}",
        "answer": item.letter,
    }


def draw_sheet(*parts: Sequence[tuple[str, Image.Image]]) -> Image.Image:
    """Return captioned frames as one image; each part begins a new row."""
    first = parts[0][0][1]
    width = min(first.width, CELL_WIDTH)
    height = round(first.height * width / first.width)
    rows = [part[k : k + COLUMNS] for part in parts for k in range(0, len(part), COLUMNS)]
    size = COLUMNS * (width + GAP), len(rows) * (height + CAPTION)
    sheet = Image.new("RGB", size, "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(CAPTION - 6)
    for y, row in enumerate(rows):
        for x, (caption, frame) in enumerate(row):
            left, top = x * (width + GAP), y * (height + CAPTION)
            draw.text((left + 4, top + 1), caption, "black", font)
            sheet.paste(frame.resize((width, height)), (left, top + CAPTION))
    return sheet


def write_eval_file(configurations: Iterable[str]) -> bytes:
    """Return the content of `eval.yaml` for the tables with these names."""
    tasks = [
        {
            "id": name,
            "config": name,
            "split": "test",
            "field_spec": {"input": "question", "input_image": "image", "target": "answer"},
            "solvers": [{"name": "generate"}],
            "scorers": [{"name": "pattern", "args": {"pattern": PATTERN}}],
        }
        for name in configurations
    ]
    content = {
        "name": "DynaPix",
        "description": "Choose the exact future frame of a physical scene among four candidates.",
        "evaluation_framework": "inspect-ai",
        "tasks": tasks,
    }
    return yaml.safe_dump(content, sort_keys=False).encode()
