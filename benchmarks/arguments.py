"""Types of the options of scripts."""

from __future__ import annotations

import argparse


def positive_int(text: str) -> int:
    """Return an integer above 0; argparse prints what is wrong with another text."""
    if not (text.isdecimal() and int(text)):
        raise argparse.ArgumentTypeError(f"{text}: give an integer above 0")
    return int(text)
