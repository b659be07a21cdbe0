import numpy as np
import pytest

from evaluation.metrics.intervals import mean_with_wilson
from evaluation.metrics.results import accuracy_by_family, accuracy_by_group


def test_accuracy_by_family_has_the_families_macro_and_micro():
    families = ["time", "event", "window", "window", "window", "event"]
    found = accuracy_by_family(families, [0, 1, True, True, 0.5, 0])
    assert list(found.families) == ["event", "time", "window"]
    assert [i.value for i in found.families.values()] == pytest.approx([1 / 2, 0, 2.5 / 3])
    assert [i.n for i in found.families.values()] == [2, 1, 3]
    assert found.macro == pytest.approx((1 / 2 + 2.5 / 3) / 3)
    assert accuracy_by_family(["time", "event"], [1, 0]).macro == 0.5
    assert found.micro == mean_with_wilson(np.array([0, 1, 1, 1, 0.5, 0]))


def test_accuracy_by_group_is_sorted_by_group():
    found = accuracy_by_group(["b", "a", "b"], [1, 1, 0])
    assert {k: (v.value, v.n) for k, v in found.items()} == {"a": (1, 1), "b": (0.5, 2)}
