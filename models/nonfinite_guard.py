"""What to tell a user whose model gives no numbers any more."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from conf.errors import UserError


def check_finite(embedded: torch.Tensor, names: Callable[[], Sequence[str]]) -> None:
    """Raises UserError where one of embeddings (rows, ...) is no number; `names` names the rows."""
    whole = torch.isfinite(embedded).flatten(1).all(dim=1)
    if not whole.all():
        first = int((~whole).nonzero()[0])
        raise UserError(
            f"the embedding of {names()[first]} is no number: a lower train.lr or "
            "train.precision=fp32 may help; what was trained up to the last checkpoint is kept"
        )
