"""Build the conversations that a student reads and writes.

A selection prompt consists of the prefix as a video with its true times, the question, the four
candidates as labelled images, and an instruction. In reasoning mode, the response is the rationale,
the match layout (one line per candidate that says whether it matches) and the answer line; some
regimes (`train.regime`) leave parts out. In answer mode, it is only the answer line.

Prompts without candidates ask for a text: a rationale about a retrieval query, or a description of
the query's future frame or of a single frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.items.controls import prefix_under_control
from dynapix.data.records import (
    FPS,
    FRAMES,
    LETTERS,
    FrameRef,
    RetrievalQuery,
    SelectionItem,
    sample_prefix_frames,
)
from dynapix.teacher.sections import remove_section

MODES = ("reasoning", "answer")
TEXT_INSTRUCTIONS = {
    "rationale": "Reason about the scene step by step: scene parse, motion analysis, prediction "
    "and outcome.",
    "prediction": "Describe in a sentence or two the frame that answers this: the objects that it "
    "shows, and where each of them is.",
    "caption": "Describe in a sentence or two the objects that the frame shows, and where each of "
    "them is.",
}
"""Instructions of prompts without candidates, by mode."""


@dataclass(frozen=True)
class Clip:
    """A prefix as a video.

    Attributes:
        pixels: (T, S, S, 3) uint8.
        indices: Index in the scene of each of the T frames, in ascending order.
        fps: Frames per second of the scene.
        total: Number of frames of the scene.
    """

    pixels: np.ndarray
    indices: list[int]
    fps: float = FPS
    total: int = FRAMES

    @property
    def metadata(self) -> dict[str, Any]:
        """The true times; given them, a processor neither samples frames nor assumes a rate."""
        return {
            "fps": float(self.fps),
            "total_num_frames": self.total,
            "frames_indices": list(self.indices),
        }


@dataclass(frozen=True)
class Sample:
    """A conversation with its media, before tokenization.

    Attributes:
        content: Parts of the user message in the form of chat templates, without pixels.
        clip: The prefix, or None for a prompt without video.
        images: (S, S, 3) uint8 pixels of the images, such as the candidates, in order.
        response: The assistant's text, or None if it is to be generated.
        response_ids: Token ids of the response if a model has generated them; the tokenizer may
            divide the same text into other tokens.
        supervised: Whether the response is trained on; if not, the sample only fills a batch.
        false_spans: Spans of `response` that are false on purpose. The model reads them, but is not
            trained to write their tokens.
    """

    sample_id: str
    content: list[dict[str, Any]]
    clip: Clip | None
    images: list[np.ndarray]
    response: str | None = None
    response_ids: tuple[int, ...] | None = None
    supervised: bool = True
    false_spans: tuple[tuple[int, int], ...] = ()

    @property
    def pictures(self) -> int:
        """Number of pictures: images, and pairs of a clip's frames."""
        return len(self.images) + ((len(self.clip.indices) + 1) // 2 if self.clip else 0)


def list_timestamps() -> list[str]:
    """Return timestamps, as a processor writes them before a clip's frames, with all digits."""
    return [f"<{tenths / 10:.1f} seconds>" for tenths in range(52)]


def answer_line(letter: str) -> str:
    return f"Answer: {letter}"


def choose_instruction(mode: str, regime: str) -> str:
    """Return the instruction with which a prompt of this mode and regime ends."""
    if mode in TEXT_INSTRUCTIONS:
        return TEXT_INSTRUCTIONS[mode]
    if mode == "answer":
        return 'Reply with one line, "Answer:" and the letter.'
    steps = ["scene parse", "motion analysis", "prediction"]
    steps += ["candidate analysis"] * has_analysis(regime)
    match_layout = "Then say of each candidate, in a line of its own, whether it matches and why. "
    return (
        f"Reason about the scene step by step: {', '.join(steps)} and outcome. "
        f"{match_layout * has_matches(regime)}"
        'End with a line "Answer:" and the letter.'
    )


def build_response(
    rationale: str, matches: Sequence[str], letter: str, mode: str, regime: str
) -> str:
    """Return the response on which a regime trains a student in a mode.

    Args:
        rationale: The teacher's full text; not used in answer mode.
        matches: The lines of the match layout, one per candidate.
    """
    if mode == "answer":
        return answer_line(letter)
    text = remove_section(rationale, "Answer")
    if not has_analysis(regime):
        text = remove_section(text, "Candidate analysis")
    lines = matches if has_matches(regime) else ()
    return "\n".join([text.rstrip(), *lines, answer_line(letter)])


def has_analysis(regime: str) -> bool:
    """Return whether a regime's rationales keep their candidate analysis."""
    return regime != "cot_no_candidate_analysis"


def has_matches(regime: str) -> bool:
    """Return whether a regime's responses have the match layout."""
    return regime in ("cot", "cot_no_candidate_analysis")


def selection_sample(
    item: SelectionItem,
    mode: str,
    regime: str,
    frames: FrameReader,
    frame_count: int,
    response: str | None = None,
    control: str | None = None,
    text: str | None = None,
) -> Sample:
    """Return the conversation about a selection item.

    Args:
        frame_count: Number of frames of the prefix that are visible.
        response: The assistant's text, or None if it is to be generated.
        control: How the prefix is altered (see `data.items.controls`); None leaves it unchanged.
        text: The instruction; None uses the instruction of the mode and the regime.
    """
    visible = prefix_under_control(item, frame_count, control)
    parts: list[str | np.ndarray] = [item.question]
    for letter, c in zip(LETTERS, item.candidates, strict=True):
        parts += [f"\nCandidate {letter}: ", frames.array(c.scene_id, c.frame)]
    parts.append(f"\n{text or choose_instruction(mode, regime)}")
    clip = load_clip(item.scene_id, visible, frames) if visible else None
    return build_sample(f"{item.item_id} ({mode})", parts, response, clip)


def write_time(seconds: float) -> str:
    """Return the text before a frame that is shown as an image."""
    return f"At {seconds:.2f} s: "


def show_frames_as_images(sample: Sample) -> Sample:
    """Return a sample whose clip, if any, is replaced by its frames, each after its time.

    This is for models that are not told the times of a clip's frames.
    """
    if sample.clip is None:
        return sample
    frames: list[dict[str, Any]] = []
    for index in sample.clip.indices:
        frames.append({"type": "text", "text": write_time(index / sample.clip.fps)})
        frames += [{"type": "image"}, {"type": "text", "text": "\n"}]
    parts = (frames if part["type"] == "video" else [part] for part in sample.content)
    content = [part for several in parts for part in several]
    return replace(sample, content=content, clip=None, images=[*sample.clip.pixels, *sample.images])


def facts_sample(
    item: SelectionItem, mode: str, regime: str, facts: str, response: str | None = None
) -> Sample:
    """Return the conversation about a selection item whose facts are given as text instead of its
    frames."""
    parts = [f"{item.question}\nFacts:\n{facts}\n{choose_instruction(mode, regime)}"]
    return build_sample(f"{item.item_id} ({mode}, facts)", parts, response)


def text_sample(
    frames: FrameReader, frame_count: int, mode: str, subject: RetrievalQuery | FrameRef
) -> Sample:
    """Return a prompt with an instruction of `TEXT_INSTRUCTIONS`, about a query (its prefix and
    question) or about a single frame."""
    name, text = f"{subject.name} ({mode})", f"\n{TEXT_INSTRUCTIONS[mode]}"
    if isinstance(subject, FrameRef):
        pixels = frames.array(subject.scene_id, subject.frame)
        return build_sample(name, [pixels, text], None)
    visible = sample_prefix_frames(subject.prefix_start, subject.prefix_stop, frame_count)
    clip = load_clip(subject.scene_id, visible, frames)
    return build_sample(name, [subject.question, text], None, clip)


def load_clip(scene_id: str, indices: list[int], frames: FrameReader) -> Clip:
    """Return frames of a scene as a clip. Its times ascend, even if the frames are shuffled."""
    scene = frames.scene(scene_id)
    return Clip(frames.stack(scene_id, indices), sorted(indices), scene.fps, scene.frames)


def build_sample(
    sample_id: str,
    parts: Sequence[str | np.ndarray],
    response: str | None,
    clip: Clip | None = None,
) -> Sample:
    """Return a sample whose user message is the clip, if any, and then `parts`, which are texts and
    (S, S, 3) uint8 images."""
    content: list[dict[str, Any]] = [{"type": "video"}] if clip else []
    content += [
        {"type": "text", "text": part} if isinstance(part, str) else {"type": "image"}
        for part in parts
    ]
    images = [part for part in parts if not isinstance(part, str)]
    return Sample(sample_id, content, clip, images, response)
