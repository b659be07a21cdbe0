"""Detection of numbers in prose."""

from __future__ import annotations

from teacher.numbers.detection import WORDS, find_numbers

__all__ = ["WORDS", "find_numbers"]
