"""How what a model says to a selection item is read."""

from train.choice import Choice, Reason, parse, parse_choice

__all__ = ["Choice", "Reason", "parse", "parse_choice"]
