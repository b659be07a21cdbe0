"""What every group's check() asks of its values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit


def is_url(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and parts.port != 0 and " " not in text
    except ValueError:
        return False


def no_share(cfg: Any, above: str, names: Sequence[str]) -> list[str]:
    """A sentence for each setting that is no share of a whole."""
    return [
        f"{above}{name}={getattr(cfg, name)} must be 0 or more and below 1"
        for name in names
        if not 0 <= getattr(cfg, name) < 1
    ]


def too_small(cfg: Any, above: str, least: dict[str, float]) -> list[str]:
    """A sentence for each setting that is less than its least value; null is no value."""
    values = {name: getattr(cfg, name) for name in least}
    return [
        f"{above}{name}={value} must be {least[name]} or more"
        for name, value in values.items()
        if value is not None and value < least[name]
    ]
