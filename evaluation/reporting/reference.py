"""The paper's own figures, as printed: the reference rows of the tables and figures.

Accuracies, parse rates and recalls are in percent, MRR is a share, ranks start at 1.
"""

from __future__ import annotations

from dataclasses import dataclass

SUITE = "dynapix"
"""The suite of whose items the selection tables by family are."""


@dataclass(frozen=True)
class SelectionReference:
    """Accuracy by family and their mean; the rest only where the paper prints it."""

    name: str
    event: float
    time: float
    window: float | None
    macro: float | None = None
    micro: float | None = None
    parse_rate: float | None = None


@dataclass(frozen=True)
class RetrievalReference:
    """2,002 queries over a database of 10,000 frames."""

    name: str
    recall_1: float
    recall_10: float
    recall_50: float
    mrr: float
    median_rank: int


@dataclass(frozen=True)
class OverallReference:
    """Accuracy over all items of the in-domain suite and of both transfer suites."""

    name: str
    clevrer: float
    movi_a: float
    physion: float


CHANCE = SelectionReference("Chance", 25.0, 25.0, 25.0, 25.0)
"""Table 2, as are the human vote and the zero-shot models."""

HUMAN_MAJORITY = SelectionReference("Human, majority vote", 58.3, 83.3, 73.9, 71.8)
"""59 items of three simulators, 127 judgments (Table 2, and Table 11)."""
HUMAN_ANNOTATORS = (
    SelectionReference("Annotator 1", 58.3, 83.3, 60.9),
    SelectionReference("Annotator 2", 40.0, 100.0, 81.8),
    SelectionReference("Annotator 3", 63.6, 83.3, 81.2),
)
"""Table 11."""
HUMAN_SECONDS = {"event": 39.9, "time": 15.8, "window": 20.3}
"""Median decision time, s (Table 11)."""
HUMAN_KAPPA = 0.366
"""Fleiss' kappa on the 19 items that all three saw (Section 4.3)."""

SELECTION_SIMILARITY = (
    SelectionReference("CLIP", 44.6, 27.0, 40.7, 37.4),
    SelectionReference("LanguageBind", 18.9, 21.7, 24.1, 21.5),
    SelectionReference("SigLIP 2", 65.9, 20.6, 52.7, 46.4),
    SelectionReference("VLM2Vec", 71.1, 24.1, 55.6, 50.2),
    SelectionReference("Qwen3-VL-Emb-2B", 63.1, 21.4, 44.7, 43.1),
    SelectionReference("Qwen3-VL-Emb-8B", 57.0, 22.7, 52.7, 44.1),
)
"""Table 2."""
SELECTION_GENERATIVE = (
    SelectionReference("Qwen3-VL-2B (instruct)", 28.5, 24.6, 35.3, 29.5),
    SelectionReference("Qwen3-VL-8B (instruct)", 64.7, 27.3, 42.0, 44.7),
    SelectionReference("Qwen3-VL-8B (thinking)", 65.1, 18.7, 39.3, 41.0, parse_rate=66.4),
    SelectionReference("Qwen3.5-27B", 25.8, 21.6, 26.6, 24.7, parse_rate=89.9),
    SelectionReference("Qwen3.6-27B", 26.1, 20.3, 27.1, 24.5, parse_rate=81.1),
)
"""Table 2, parse rates from its caption."""

ZERO_SHOT = SelectionReference("Zero-shot (base)", 64.7, 27.3, 42.0, 44.7, 42.1)
ANSWER_ONLY = SelectionReference("Answer-only SFT", 73.9, 36.6, 61.1, 57.2, 58.4)
COT = SelectionReference("Physics-grounded CoT", 92.4, 45.4, 96.7, 78.2, 87.5)
"""In reasoning mode; the same student's micro in answer mode is 86.7."""
SELECTION_DISTILLED = (ZERO_SHOT, ANSWER_ONLY, COT)
"""Table 4 (a)."""

TIME_BY_HORIZON = {ZERO_SHOT.name: {1: 28.8, 2: 26.6}, COT.name: {1: 64.0, 2: 37.6}}
"""Time accuracy 1 s and 2 s after the observation (Section 5.2)."""

RETRIEVAL_DIRECT = (
    RetrievalReference("CLIP", 1.9, 8.0, 20.4, 0.041, 404),
    RetrievalReference("LanguageBind", 1.0, 6.9, 19.4, 0.031, 388),
    RetrievalReference("SigLIP 2", 7.3, 39.4, 60.6, 0.171, 23),
    RetrievalReference("VLM2Vec-V2", 12.7, 62.0, 81.1, 0.272, 6),
    RetrievalReference("Qwen3-VL-Emb-2B", 10.6, 49.1, 71.5, 0.224, 11),
    RetrievalReference("Qwen3-VL-Emb-8B", 13.3, 64.2, 81.3, 0.283, 6),
)
"""Table 3."""
RETRIEVAL_TWO_STAGE = (
    RetrievalReference("Qwen3-VL-8B CoT -> text", 2.1, 11.4, 26.6, 0.055, 252),
    RetrievalReference("Qwen3-VL-2B predict -> caption", 1.0, 6.7, 18.0, 0.031, 477),
    RetrievalReference("Qwen3-VL-2B predict -> image", 0.2, 2.4, 7.6, 0.012, 985),
)
"""Table 3."""
RETRIEVAL_DISTILLED = (
    RetrievalReference("Two-stage (8B -> text)", 2.1, 11.4, 26.6, 0.055, 252),
    RetrievalReference("+ CoT-distilled student", 16.0, 61.3, 78.0, 0.305, 6),
    RetrievalReference("Direct (Emb-8B)", 13.3, 64.2, 81.3, 0.283, 6),
    RetrievalReference("+ contrastive finetune", 48.8, 92.0, 96.8, 0.652, 2),
)
"""Table 4 (b)."""

TRANSFER = (
    OverallReference("Zero-shot (base)", 42.1, 39.3, 17.5),
    OverallReference("Physics-grounded CoT, answer mode", 86.7, 48.1, 48.4),
)
"""Section 5.3."""
MOVI_A_BY_FAMILY = (
    SelectionReference("Zero-shot (base)", 72.8, 30.2, None, micro=39.3),
    SelectionReference("Physics-grounded CoT, answer mode", 89.3, 36.8, None, micro=48.1),
)
"""Section 5.3: selection on MoVi-A, which has no window items."""

ABLATION = (
    OverallReference("Full student", 87.5, 39.9, 64.6),
    OverallReference("- candidate analysis", 88.0, 35.9, 69.0),
    OverallReference("- match layout", 86.8, 40.3, 68.9),
)
"""Table 12. In reasoning mode, so not to be held against `TRANSFER`."""
