"""An item becomes a conversation: the one place that knows how a student is asked and answers.

The prompt is the prefix as a video with its true times, the question, the four candidates as
labelled images, and what to write. In reasoning mode the response is the rationale as the regime
has it, whether each candidate matches it (the match layout, where the regime has that), and the
answer's line; in answer mode it is that line alone.

What has no candidates is asked for a text alone: what a query's future frame will show, reasoned
out or described at once, or what a frame shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from conf.schema import StudentConfig
from data.records import (
    FPS,
    FRAMES,
    LETTERS,
    FrameRef,
    RetrievalQuery,
    SelectionItem,
    sample_prefix_frames,
)
from data.render.frame_cache import FrameReader
from data.tracks.controls import prefix_under_control
from teacher.sections import remove_section

MODES = ("reasoning", "answer")
TEXT_INSTRUCTIONS = {
    "rationale": "Reason about the scene step by step: scene parse, motion analysis, prediction "
    "and outcome.",
    "prediction": "Describe in a sentence or two the frame that answers this: the objects that it "
    "shows, and where each of them is.",
    "caption": "Describe in a sentence or two the objects that the frame shows, and where each of "
    "them is.",
}
"""What a model is asked for, of a query or of a frame, where it has no candidates."""


@dataclass(frozen=True)
class Clip:
    """(T, S, S, 3) uint8 pixels of a prefix, shown at the times of the scene's frames `indices`;
    the scene's frames a second, and how many it has."""

    pixels: np.ndarray
    indices: list[int]
    fps: float = FPS
    total: int = FRAMES

    @property
    def metadata(self) -> dict[str, Any]:
        """The video's true times, so that a processor neither samples again nor assumes a rate."""
        return {
            "fps": float(self.fps),
            "total_num_frames": self.total,
            "frames_indices": list(self.indices),
        }


@dataclass(frozen=True)
class Sight:
    """An object that one of a sample's pictures shows: which picture (pairs of a clip's frames
    first, then images), where, as shares of its width and height, and the object's words."""

    picture: int
    place: tuple[float, float]
    words: tuple[str, ...]


@dataclass(frozen=True)
class Sample:
    """A conversation with its media, before any tokenizer has seen it.

    Attributes:
        content: the user message's parts in the chat template's form; media as bare placeholders.
        clip: the prefix; None where none is shown.
        images: (S, S, 3) uint8 pixels of each image in order, such as the candidates.
        response: what the assistant should say, or None where it is to be generated.
        sights: what the pictures show, where a model is to be taught to see.
        supervised: whether the response is learnt; else the sample only fills a place.
    """

    sample_id: str
    content: list[dict[str, Any]]
    clip: Clip | None
    images: list[np.ndarray]
    response: str | None = None
    supervised: bool = True
    sights: tuple[Sight, ...] = ()

    @property
    def pictures(self) -> int:
        """Images, and pairs of a clip's frames."""
        return len(self.images) + ((len(self.clip.indices) + 1) // 2 if self.clip else 0)


def answer_line(letter: str) -> str:
    return f"Answer: {letter}"


def instruction(mode: str, regime: str) -> str:
    """What a student is told to write."""
    if mode in TEXT_INSTRUCTIONS:
        return TEXT_INSTRUCTIONS[mode]
    if mode == "answer":
        return 'Reply with one line, "Answer:" and the letter.'
    steps = ["scene parse", "motion analysis", "prediction"]
    steps += ["candidate analysis"] * has_analysis(regime)
    layout = "Then say of each candidate, in a line of its own, whether it matches and why. "
    return (
        f"Reason about the scene step by step: {', '.join(steps)} and outcome. "
        f"{layout * has_matches(regime)}"
        'End with a line "Answer:" and the letter.'
    )


def response(rationale: str, matches: Sequence[str], letter: str, mode: str, regime: str) -> str:
    """What a student of a regime answers: `rationale` in its full form, `matches` a line for each
    candidate in order."""
    if mode == "answer":
        return answer_line(letter)
    text = remove_section(rationale, "Answer")
    if not has_analysis(regime):
        text = remove_section(text, "Candidate analysis")
    lines = matches if has_matches(regime) else ()
    return "\n".join([text.rstrip(), *lines, answer_line(letter)])


def has_analysis(regime: str) -> bool:
    """Whether a regime's rationales hold their candidate analysis."""
    return regime != "cot_no_candidate_analysis"


def has_matches(regime: str) -> bool:
    """Whether a regime's answers have the match layout."""
    return regime in ("cot", "cot_no_candidate_analysis")


def selection_sample(
    item: SelectionItem,
    mode: str,
    regime: str,
    frames: FrameReader,
    cfg: StudentConfig,
    response: str | None = None,
    control: str | None = None,
) -> Sample:
    """A selection item asked in `mode` ("reasoning" or "answer") as a student of `regime` is, its
    prefix shown as a `control` asks (see `data.tracks.controls`)."""
    asked = instruction(mode, regime)
    return instructed_sample(item, mode, asked, frames, cfg, response, control)


def instructed_sample(
    item: SelectionItem,
    mode: str,
    asked: str,
    frames: FrameReader,
    cfg: StudentConfig,
    response: str | None = None,
    control: str | None = None,
) -> Sample:
    """A selection item with what is `asked` about it, as `selection_sample` shows it."""
    shown = prefix_under_control(item, cfg.frames, control)
    parts: list[str | np.ndarray] = [item.question]
    for letter, c in zip(LETTERS, item.candidates, strict=True):
        parts += [f"\nCandidate {letter}: ", frames.array(c.scene_id, c.frame)]
    clip = load_clip(item.scene_id, shown, frames) if shown else None
    return conversation(f"{item.item_id} ({mode})", [*parts, f"\n{asked}"], response, clip)


def text_sample(
    frames: FrameReader, cfg: StudentConfig, mode: str, thing: RetrievalQuery | FrameRef
) -> Sample:
    """A prompt of `TEXT_INSTRUCTIONS` about a query (its prefix and question) or about a frame."""
    name, asked = f"{thing.name} ({mode})", f"\n{TEXT_INSTRUCTIONS[mode]}"
    if isinstance(thing, FrameRef):
        pixels = frames.array(thing.scene_id, thing.frame)
        return conversation(name, [pixels, asked], None)
    shown = sample_prefix_frames(thing.prefix_start, thing.prefix_stop, cfg.frames)
    clip = load_clip(thing.scene_id, shown, frames)
    return conversation(name, [thing.question, asked], None, clip)


def load_clip(scene_id: str, shown: list[int], frames: FrameReader) -> Clip:
    """Frames of a scene as a clip, whose times run on in whatever order they are `shown`."""
    scene = frames.scene(scene_id)
    return Clip(frames.stack(scene_id, shown), sorted(shown), scene.fps, scene.frames)


def conversation(
    sample_id: str,
    parts: Sequence[str | np.ndarray],
    response: str | None,
    clip: Clip | None = None,
    sights: Sequence[Sight] = (),
) -> Sample:
    """A clip, if there is one, and then `parts`: texts and (S, S, 3) uint8 pixels of images."""
    content: list[dict[str, Any]] = [{"type": "video"}] if clip else []
    content += [
        {"type": "text", "text": part} if isinstance(part, str) else {"type": "image"}
        for part in parts
    ]
    images = [part for part in parts if not isinstance(part, str)]
    return Sample(sample_id, content, clip, images, response, sights=tuple(sights))
