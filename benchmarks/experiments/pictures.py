"""Draws two pictures from a student's responses: an item that it answers correctly beside one that
it does not, with its responses (`docs/item.webp`), and the first of them as an animation
(`docs/reasoning.webp`).

    python -m benchmarks.experiments.pictures checkpoints/select/model-checkpoints-sft-exp-cot

By default, the items are the first solved and the first unsolved one whose response is not cut.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from benchmarks.experiments.experiment import open_benchmark, read_item_responses
from conf.failures import report_failures
from data.frames.frame_cache import FrameReader
from data.records import LETTERS, SelectionItem, sample_prefix_frames
from data.store import Store

INK, PAPER, GREEN, RED, GRAY = "#222222", "#ffffff", "#1a7f37", "#cf222e", "#8c959f"
WIDTH, FRAME, GAP, BORDER = 620, 144, 10, 5
"""Sizes of a panel, of a frame's width, of gaps, and of the borders of candidates, in pixels."""
FONT = ImageFont.truetype(findfont("DejaVu Sans"), 12)
LINE, CHARACTERS_PER_LINE = 16, 88
PREFIX_FRAMES = 4
"""Number of frames of the prefix in the still picture."""
DOCS = Path("docs")


@dataclass(frozen=True)
class Solution:
    """A student's response to an item."""

    item: SelectionItem
    letter: str | None
    text: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("run", type=Path, help="folder of a run of evaluation.select")
    parser.add_argument("--benchmark", default="tiny", help="benchmark of the run")
    parser.add_argument("--store", type=Path, default=Path("store"))
    parser.add_argument("--solved", help="id of the solved item")
    parser.add_argument("--unsolved", help="id of the unsolved item")
    args = parser.parse_args()
    store = open_benchmark(args.store, args.benchmark)
    solutions = read_solutions(args.run, store)
    solved, unsolved = (
        find_solution(solutions, wanted, is_right)
        for wanted, is_right in ((args.solved, True), (args.unsolved, False))
    )
    frames = FrameReader(store)
    panels = [draw_panel(s, frames) for s in (solved, unsolved)]
    save_still(panels, DOCS / "item.webp")
    save_animation(solved, frames, DOCS / "reasoning.webp")
    print(f"{DOCS / 'item.webp'}: {solved.item.item_id} and {unsolved.item.item_id}")


def read_solutions(folder: Path, store: Store) -> list[Solution]:
    """Return the responses of a run in reasoning mode that are not cut, in the order of the
    items."""
    responses = read_item_responses(folder, "reasoning")
    return [
        Solution(item, response.letter, response.text)
        for item in store.selection("test")
        if (response := responses.get(item.item_id)) and not response.truncated
    ]


def find_solution(solutions: Sequence[Solution], wanted: str | None, is_right: bool) -> Solution:
    fitting = [
        s
        for s in solutions
        if (s.letter == s.item.letter) == is_right and wanted in (None, s.item.item_id)
    ]
    if not fitting:
        kind = "solved" if is_right else "unsolved"
        raise SystemExit(f"error: the run has no {kind} item {wanted or ''}".rstrip())
    return fitting[0]


def draw_panel(
    solution: Solution, frames: FrameReader, text: str | None = None, shown: int | None = None
) -> Image.Image:
    """Draw an item and a response, with the target green and a false choice red.

    Args:
        text: The visible part of the response, without colours; None shows all of it.
        shown: Index of the only visible frame of the prefix, for an animation; None shows several.
    """
    item = solution.item
    lines = _wrap(solution.text)
    height = _frame_height(frames, item)
    top = 2 * (height + LINE + GAP) + 3 * LINE
    panel = Image.new("RGB", (WIDTH, top + LINE * (len(lines) + 1)), PAPER)
    draw = ImageDraw.Draw(panel)
    prefix = sample_prefix_frames(item.prefix_start, item.prefix_stop, PREFIX_FRAMES)
    for k, frame in enumerate(prefix if shown is None else [shown]):
        position = (GAP + k * (FRAME + GAP), LINE + 4)
        _paste(panel, frames, item.scene_id, frame, position, height)
    draw.text((GAP, 2), "observed", fill=GRAY, font=FONT)
    y = height + LINE + 2 * GAP
    for line in wrap(item.question, CHARACTERS_PER_LINE):
        draw.text((GAP, y), line, fill=INK, font=FONT)
        y += LINE
    y = height + 3 * LINE + 3 * GAP
    for k, (letter, c) in enumerate(zip(LETTERS, item.candidates, strict=True)):
        x = GAP + k * (FRAME + GAP)
        color = GREEN if letter == item.letter else RED if letter == solution.letter else None
        if text is None and color:
            draw.rectangle(
                (x - BORDER, y - BORDER, x + FRAME + BORDER - 1, y + height + BORDER - 1),
                fill=color,
            )
        _paste(panel, frames, c.scene_id, c.frame, (x, y), height)
        draw.text((x + 4, y + 2), letter, fill=INK, font=FONT)
    y += height + GAP
    visible = lines if text is None else _wrap(text)
    for line in visible:
        draw.text((GAP, y), line, fill=INK, font=FONT)
        y += LINE
    return panel


def _wrap(text: str) -> list[str]:
    return [line for part in text.splitlines() for line in wrap(part, CHARACTERS_PER_LINE)]


def _frame_height(frames: FrameReader, item: SelectionItem) -> int:
    image = frames.image(item.scene_id, item.prefix_stop)
    return round(FRAME * image.height / image.width)


def _paste(
    panel: Image.Image,
    frames: FrameReader,
    scene_id: str,
    frame: int,
    position: tuple[int, int],
    height: int,
) -> None:
    image = frames.image(scene_id, frame)
    panel.paste(image.resize((FRAME, height), Image.Resampling.LANCZOS), position)


def save_still(panels: Sequence[Image.Image], path: Path) -> None:
    """Save panels side by side."""
    height = max(panel.height for panel in panels)
    picture = Image.new("RGB", (WIDTH * len(panels), height), PAPER)
    for k, panel in enumerate(panels):
        picture.paste(panel, (k * WIDTH, 0))
    picture.save(path, "WEBP", quality=85, method=6)


def save_animation(solution: Solution, frames: FrameReader, path: Path) -> None:
    """Save the prefix as a video, then the response sentence by sentence, then the answer."""
    item = solution.item
    prefix = sample_prefix_frames(item.prefix_start, item.prefix_stop, 8)
    sentences = solution.text.replace(". ", ".\0").replace("\n", "\n\0").split("\0")
    parts = [_join(sentences[:k]) for k in range(1, len(sentences))]
    steps: list[tuple[int, str | None, int]] = [(frame, "", 160) for frame in prefix]
    steps += [(item.prefix_stop, text, 700) for text in parts]
    steps += [(item.prefix_stop, None, 4000)]
    pictures = [draw_panel(solution, frames, text, frame) for frame, text, _ in steps]
    durations = [duration for *_, duration in steps]
    pictures[0].save(
        path,
        "WEBP",
        save_all=True,
        append_images=pictures[1:],
        duration=durations,
        loop=0,
        quality=75,
        method=4,
    )


def _join(sentences: Sequence[str]) -> str:
    return "".join(s if s.endswith("\n") else f"{s} " for s in sentences).rstrip()


if __name__ == "__main__":
    with report_failures():
        main()
