import pytest

from dynapix.data.checks.intervals import SceneBootstrap
from dynapix.evaluation.metrics.results import accuracy_by_family


def test_accuracy_by_family_has_the_families_macro_and_micro():
    families = ["time", "event", "window", "window", "window", "event"]
    credits = [0, 1, True, True, 0.5, 0]
    scenes = SceneBootstrap(["a", "a", "b", "c", "c", "d"], seed=0)
    found = accuracy_by_family(families, credits, scenes)
    assert list(found.families) == ["event", "time", "window"]
    assert [i.value for i in found.families.values()] == pytest.approx([1 / 2, 0, 2.5 / 3])
    assert [i.n for i in found.families.values()] == [2, 1, 3]
    assert found.macro == scenes.macro(credits, families)
    assert found.macro.value == pytest.approx((1 / 2 + 2.5 / 3) / 3)
    assert found.micro == scenes.mean(credits)
    assert found.micro.value == pytest.approx(3.5 / 6)
