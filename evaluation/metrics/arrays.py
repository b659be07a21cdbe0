"""Arrays from what models return."""

from __future__ import annotations

from typing import Any

import numpy as np


def to_array(values: Any, dtype: Any = None) -> np.ndarray:
    """Return numbers as an array: those of an array, of a tensor on any device, also with gradients
    or in bf16, or of nested lists of them. Raises the errors of numpy and of torch."""
    try:
        return np.asarray(values, dtype)
    except (RuntimeError, TypeError, ValueError):
        return np.asarray(_detach(values), dtype)


def _detach(values: Any) -> Any:
    if isinstance(values, list | tuple):
        return [_detach(value) for value in values]
    if not hasattr(values, "detach"):
        return values
    tensor = values.detach().cpu()
    return (tensor.double() if tensor.is_floating_point() else tensor).numpy()
