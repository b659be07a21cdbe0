"""A short training over the committed base beats chance on held-out items."""

from __future__ import annotations

from pathlib import Path

import pytest

from research.experiments.sabotage import INTACT, SABOTAGES, train_and_measure


@pytest.mark.slow
def test_a_short_training_beats_chance_by_five_standard_errors(tmp_path: Path) -> None:
    result = train_and_measure(
        SABOTAGES[INTACT], INTACT, str(tmp_path / "store"), tmp_path / "checkpoints"
    )
    assert result is not None
    assert result.errors_above_chance >= 5, result
