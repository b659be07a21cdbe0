"""What a benchmark is made of: its scenes, cells, quotas and databases."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

from omegaconf import MISSING

from conf.schema.checks import too_small

RENDERERS = ("bullet", "egl", "blender")
SIMULATORS = ("bullet", "clevrer", "movi_a", "physion")
STANDINS = ("movi_a", "physion")
WINDOW_FAMILIES = {"G1": "AC", "G2": "ABC", "G3": "AC", "G4": "AB"}
"""Window families of each group: B needs a collision ahead, C leaves out G4 (paper, Window)."""
WINDOW_HORIZONS = (8, 16, 24)
"""Frames from the end of a window item's prefix to its target."""
WINDOW_DIFFICULTIES = ("easy", "hard")
STANDIN_OBJECTS = 6
DISTINCT_APPEARANCES = 48
"""Objects that can be told apart by their names: 3 shapes, 8 colours, 2 materials."""


@dataclass
class Quota:
    """How many items or queries a cell gets in each split."""

    train: int = 0
    test: int = 0


@dataclass
class SelectionConfig:
    """Cells of the selection track and their quotas. A cell's name is its item's `subtype`."""

    min_displacement: float = 12.0
    """Least displacement (px at 336 x 336) between any two candidates, in some object."""
    event: dict[str, Quota] = field(default_factory=dict)
    time: dict[str, Quota] = field(default_factory=dict)
    window: dict[str, Quota] = field(default_factory=dict)
    """Quotas of cells, such as G1_A_h8_easy, or of all six cells of a group and family, such as
    G1_A, which are divided evenly among them."""
    matched: Quota = field(default_factory=Quota)
    """Pairs of items that differ in their question's anchor alone, a suite of their own."""

    def __post_init__(self) -> None:
        self.window = divide_window_quotas(self.window)

    def check(self) -> list[str]:
        problems = too_small(self, "benchmark.selection.", {"min_displacement": 0})
        for family in ("event", "time", "window"):
            problems += quota_problems(f"benchmark.selection.{family}", getattr(self, family))
        return problems + quota_problems("benchmark.selection", {"matched": self.matched})


@dataclass
class RetrievalTrackConfig:
    """Builders of the retrieval track (spec names 1 to 6) and the test database."""

    builders: dict[str, Quota] = field(default_factory=dict)
    counterfactual: Quota = field(default_factory=Quota)
    """Queries about scenes that are simulated again with an object absent."""
    hard_negatives: int = 3
    """Same-scene wrong-time frames a query."""
    standard: int = 2_002
    """Of the builders' test queries, those of the standard test; as many of each builder."""
    database: int = 10_000
    """Frames of the standard test's database; it holds every target of its queries."""
    source: int = 30_000
    """Frames that the builders' queries have for a source; it holds every target of theirs."""
    counterfactual_source: int = 26_995
    """Frames that the counterfactual queries have for a source."""

    def check(self) -> list[str]:
        sizes = ("standard", "database", "source", "counterfactual_source")
        return [
            *too_small(self, "benchmark.retrieval.", {"hard_negatives": 1}),
            *too_small(self, "benchmark.retrieval.", dict.fromkeys(sizes, 0)),
            *quota_problems("benchmark.retrieval.builders", self.builders),
            *quota_problems("benchmark.retrieval", {"counterfactual": self.counterfactual}),
        ]


@dataclass
class BenchmarkConfig:
    name: str = MISSING
    """Name of the folder below `store`."""
    simulator: str = "bullet"
    """bullet simulates scenes; clevrer, movi_a and physion read a release of that simulator."""
    standin: str | None = None
    """The transfer suite, movi_a or physion, for which scenes of another look and physics stand in:
    Bullet's own, by that suite's recipe. Null simulates standard scenes."""
    folder: str | None = None
    """Folder of the release, where one is read."""
    fps: float = 30.0
    """Frames a second of Physion's trials, which do not record it."""
    seed: int = 0
    scenes: int = 10_000
    """Scenes, of a release at most."""
    test_share: float = 0.2
    min_objects: int = 4
    max_objects: int = 6
    max_collisions: int = 3
    renderer: str = "bullet"
    """bullet draws everywhere, egl through a graphics driver, blender as CLEVRER looks (extra
    blender)."""
    width: int = 480
    height: int = 320
    prefix_frames: int = 12
    """Frames of a prefix that are rendered ahead, evenly spread."""
    selection: SelectionConfig = field(default_factory=SelectionConfig)
    retrieval: RetrievalTrackConfig = field(default_factory=RetrievalTrackConfig)

    def check(self) -> list[str]:
        problems = too_small(
            self, "benchmark.", {"seed": 0, "scenes": 4, "max_collisions": 1, "prefix_frames": 2}
        )
        if not 0 < self.test_share <= 1:
            problems.append(f"benchmark.test_share={self.test_share} must be above 0 and at most 1")
        if self.fps <= 0:
            problems.append(f"benchmark.fps={self.fps} must be above 0")
        if self.renderer not in RENDERERS:
            problems.append(
                f"benchmark.renderer={self.renderer}: the options are {', '.join(RENDERERS)}"
            )
        absent = self.retrieval.counterfactual
        if self.simulator not in SIMULATORS:
            problems.append(
                f"benchmark.simulator={self.simulator}: the options are {', '.join(SIMULATORS)}"
            )
        elif self.simulator != "bullet" and absent.train + absent.test > 0:
            problems.append(
                f"benchmark.retrieval.counterfactual with benchmark.simulator={self.simulator}: "
                "scenes of a release cannot be simulated again, set both of its quotas to 0"
            )
        problems += self._standin_problems()
        if not 2 <= self.min_objects <= self.max_objects <= DISTINCT_APPEARANCES:
            problems.append(
                f"benchmark.min_objects={self.min_objects} and "
                f"benchmark.max_objects={self.max_objects}: need 2 <= min <= max <= "
                f"{DISTINCT_APPEARANCES}, because no two objects of a scene look alike"
            )
        if self.width < 48 or self.width * 2 != self.height * 3:
            problems.append(
                f"benchmark.width={self.width} and benchmark.height={self.height}: frames are "
                "3 wide to 2 high and 48 x 32 px at least, such as 480 x 320"
            )
        return problems

    def _standin_problems(self) -> list[str]:
        if self.standin is None:
            return []
        named = f"benchmark.standin={self.standin}"
        if self.standin not in STANDINS:
            return [f"{named}: the options are {', '.join(STANDINS)} and null"]
        problems = []
        if self.simulator != "bullet":
            problems.append(
                f"{named} with benchmark.simulator={self.simulator}: only scenes of "
                "benchmark.simulator=bullet stand in for another suite's"
            )
        if self.renderer == "blender":
            problems.append(
                f"{named} with benchmark.renderer=blender, which has no look but its own: give "
                "benchmark.renderer=bullet or egl"
            )
        if self.max_objects > STANDIN_OBJECTS:
            problems.append(
                f"{named} with benchmark.max_objects={self.max_objects}: {STANDIN_OBJECTS} at most "
                "have room in its view"
            )
        absent = self.retrieval.counterfactual
        if absent.train + absent.test > 0:
            problems.append(
                f"{named} has no counterfactual scenes: set both quotas of "
                "benchmark.retrieval.counterfactual to 0"
            )
        return problems


def quota_problems(above: str, quotas: dict[str, Quota]) -> list[str]:
    return [
        problem
        for name, quota in quotas.items()
        for problem in too_small(quota, f"{above}.{name}.", {"train": 0, "test": 0})
    ]


def divide_window_quotas(quotas: dict[str, Quota]) -> dict[str, Quota]:
    """Divide the quota of a group and family evenly among its cells, the remainder to the first.

    A quota named by its cell replaces that cell's share.
    """
    cells: dict[str, Quota] = {}
    for name, quota in quotas.items():
        group, _, family = name.partition("_")
        if len(family) != 1 or family not in WINDOW_FAMILIES.get(group, ""):
            cells[name] = quota
            continue
        shares = list(product(WINDOW_HORIZONS, WINDOW_DIFFICULTIES))
        for k, (horizon, difficulty) in enumerate(shares):
            train, test = (
                total // len(shares) + (k < total % len(shares))
                for total in (quota.train, quota.test)
            )
            cells.setdefault(f"{name}_h{horizon}_{difficulty}", Quota(train, test))
    return cells | {name: quota for name, quota in quotas.items() if name in cells}
