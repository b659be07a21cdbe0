"""Refuses embeddings that are not finite."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from conf.errors import UserError


def check_finite(embedded: torch.Tensor, names: Callable[[], Sequence[str]]) -> None:
    """Raise UserError if one of embeddings (rows, ...) has a NaN or an Inf; `names` names the
    rows."""
    whole = torch.isfinite(embedded).flatten(1).all(dim=1)
    if not whole.all():
        first = int((~whole).nonzero()[0])
        raise UserError(
            f"non-finite embedding (NaN or Inf) for {names()[first]}: lower train.lr or set "
            "train.precision=fp32; the checkpoints written so far are kept",
            code="non-finite-embedding",
        )
