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

_HOMES = {
    "Benchmark": "dynapix.benchmark",
    "Comparison": "dynapix.selection",
    "Frame": "dynapix.benchmark",
    "Item": "dynapix.benchmark",
    "Observers": "dynapix.observers",
    "Outcome": "dynapix.selection",
    "ParsedAnswer": "dynapix.models.student.answer_parser",
    "Query": "dynapix.benchmark",
    "RationaleScore": "dynapix.rationales",
    "Result": "dynapix.selection",
    "RetrievalScores": "dynapix.retrieval",
    "UserError": "dynapix.conf.errors",
    "evaluate": "dynapix.selection",
    "evaluate_retrieval": "dynapix.retrieval",
    "find_numbers": "dynapix.teacher.numbers.detection",
    "load": "dynapix.benchmark",
    "observer": "dynapix.observers",
    "parse_choice": "dynapix.models.student.answer_parser",
    "rank_metrics": "dynapix.evaluation.metrics.ranking",
    "score_rationale": "dynapix.rationales",
    "sufficiency": "dynapix.rationales",
}
"""The module that defines each public name."""

__all__ = [
    "Benchmark",
    "Comparison",
    "Frame",
    "Item",
    "Observers",
    "Outcome",
    "ParsedAnswer",
    "Query",
    "RationaleScore",
    "Result",
    "RetrievalScores",
    "UserError",
    "evaluate",
    "evaluate_retrieval",
    "find_numbers",
    "load",
    "observer",
    "parse_choice",
    "rank_metrics",
    "score_rationale",
    "sufficiency",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
