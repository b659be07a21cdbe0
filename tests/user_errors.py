"""Assertions that check the stable code of a UserError instead of its wording."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from dynapix.conf.errors import UserError


@contextmanager
def raises_user_error(code: str, contains: str | tuple[str, ...] = ()) -> Iterator[None]:
    """Require the block to raise a UserError with this code.

    Args:
        code: The error's code.
        contains: Keys, values or file names that the message must mention.
    """
    with pytest.raises(UserError) as caught:
        yield
    assert caught.value.code == code, f"[{caught.value.code}] {caught.value}"
    for part in (contains,) if isinstance(contains, str) else contains:
        assert part in str(caught.value)
