"""Measure models that must pick the exact future frame of a physical scene.

    import dynapix

    bench = dynapix.load("tiny", split="test")
    result = dynapix.evaluate(bench.selection, predict=lambda item: "A")
    print(result)

Importing this package imports nothing heavy: a module is imported when one of its names is used.
Reading a built benchmark needs numpy, pyarrow and pillow; building one needs the extra `simulate`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dynapix.benchmark import Benchmark, Frame, Item, Query, load
    from dynapix.conf.errors import UserError
    from dynapix.evaluation.metrics.ranking import rank_metrics
    from dynapix.models.student.answer_parser import ParsedAnswer, parse_choice
    from dynapix.observers import Observers, observer
    from dynapix.rationales import RationaleScore, score_rationale, sufficiency
    from dynapix.retrieval import RetrievalScores, evaluate_retrieval
    from dynapix.selection import Comparison, Outcome, Result, evaluate
    from dynapix.teacher.numbers.detection import find_numbers

_MODULES = {
    "benchmark": ("Benchmark", "Frame", "Item", "Query", "load"),
    "conf.errors": ("UserError",),
    "evaluation.metrics.ranking": ("rank_metrics",),
    "models.student.answer_parser": ("ParsedAnswer", "parse_choice"),
    "observers": ("Observers", "observer"),
    "rationales": ("RationaleScore", "score_rationale", "sufficiency"),
    "retrieval": ("RetrievalScores", "evaluate_retrieval"),
    "selection": ("Comparison", "Outcome", "Result", "evaluate"),
    "teacher.numbers.detection": ("find_numbers",),
}
"""The public names by the module that defines them."""
_HOMES = {name: f"dynapix.{module}" for module, names in _MODULES.items() for name in names}

__all__ = [
    "Benchmark", "Comparison", "Frame", "Item", "Observers", "Outcome", "ParsedAnswer", "Query",
    "RationaleScore", "Result", "RetrievalScores", "UserError", "evaluate", "evaluate_retrieval",
    "find_numbers", "load", "observer", "parse_choice", "rank_metrics", "score_rationale",
    "sufficiency",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
