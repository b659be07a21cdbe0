"""An item becomes a conversation: the one place that knows how a student is asked and answers.

The prompt is the prefix as a video with its true times, the question, the four candidates as
labelled images, and what to write. In reasoning mode the response is the rationale, which ends in
the answer's line; in answer mode it is that line alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from conf.schema import StudentConfig
from data.controls import observed
from data.frames import Frames
from data.records import FPS, FRAMES, LETTERS, SelectionItem, shown_frames

ASK = {
    "reasoning": (
        "Reason about the scene step by step: scene parse, motion analysis, prediction, candidate "
        'analysis and outcome. End with a line "Answer:" and the letter.'
    ),
    "answer": 'Reply with one line, "Answer:" and the letter.',
}
DESCRIBE = "Describe the scene, how its objects move, and what will come of it."


@dataclass(frozen=True)
class Sample:
    """A conversation with its media, before any tokenizer has seen it.

    Attributes:
        content: the user message's parts in the chat template's form; media as bare placeholders.
        video: (T, S, S, 3) uint8 frames of the prefix, shown at the times of the scene's frames
            `video_frames`; None where no prefix is shown.
        fps, total: the scene's frames a second, and how many it has.
        images: the candidates' (S, S, 3) uint8 pixels in order.
        response: what the assistant should say, or None where it is to be generated.
    """

    sample_id: str
    content: list[dict[str, Any]]
    video: np.ndarray | None
    video_frames: list[int]
    images: list[np.ndarray]
    response: str | None = None
    fps: float = FPS
    total: int = FRAMES

    @property
    def metadata(self) -> dict[str, Any]:
        """The video's true times, so that a processor neither samples again nor assumes a rate."""
        return {
            "fps": float(self.fps),
            "total_num_frames": self.total,
            "frames_indices": list(self.video_frames),
        }


def answer_line(letter: str) -> str:
    return f"Answer: {letter}"


def selection_sample(
    item: SelectionItem,
    mode: str,
    frames: Frames,
    cfg: StudentConfig,
    response: str | None = None,
    control: str | None = None,
) -> Sample:
    """A selection item asked in `mode` ("reasoning" or "answer"), its prefix shown as a `control`
    asks (see `data.controls`)."""
    shown = observed(item, cfg.frames, control)
    scene = frames.scene(item.scene_id)
    content: list[dict[str, Any]] = [{"type": "video"}] if shown else []
    content.append({"type": "text", "text": item.question})
    for letter in LETTERS:
        content += [{"type": "text", "text": f"\nCandidate {letter}: "}, {"type": "image"}]
    content.append({"type": "text", "text": f"\n{ASK[mode]}"})
    return Sample(
        f"{item.item_id} ({mode})",
        content,
        frames.stack(item.scene_id, shown) if shown else None,
        sorted(shown),
        [frames.array(c.scene_id, c.frame) for c in item.candidates],
        response,
        scene.fps,
        scene.frames,
    )


def description_sample(
    scene_id: str,
    start: int,
    stop: int,
    target: int,
    frames: Frames,
    cfg: StudentConfig,
    response: str,
) -> Sample:
    """A prefix and its future frame, to be described in words."""
    shown = shown_frames(start, stop, cfg.frames)
    return Sample(
        f"{scene_id} {start} to {stop}, then {target}",
        [
            {"type": "video"},
            {"type": "text", "text": "Later: "},
            {"type": "image"},
            {"type": "text", "text": f"\n{DESCRIBE}"},
        ],
        frames.stack(scene_id, shown),
        shown,
        [frames.array(scene_id, target)],
        response,
    )
