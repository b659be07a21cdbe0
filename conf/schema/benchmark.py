"""Settings of a benchmark: its scenes, its cells with their quotas, and its databases."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

from omegaconf import MISSING

from conf.schema.checks import check_minimum, check_options, check_positive, check_share

RENDERERS = ("bullet", "blender")
SIMULATORS = ("bullet", "clevrer", "movi_a", "physion")
STANDINS = ("movi_a", "physion")
WINDOW_FAMILIES = {"G1": "AC", "G2": "ABC", "G3": "AC", "G4": "AB"}
"""Window families of each group: B needs a collision ahead, C leaves out G4 (paper, Window)."""
WINDOW_HORIZONS = (8, 16, 24)
"""Frames from the end of a window item's prefix to its target."""
WINDOW_DIFFICULTIES = ("easy", "hard")
STANDIN_OBJECTS = 6
DISTINCT_APPEARANCES = 48
"""Number of distinct object names: 3 shapes x 8 colours x 2 materials."""


@dataclass
class Quota:
    """Number of items or queries of a cell in each split."""

    train: int = 0
    """Number of items or queries (for `matched`, pairs of items) in the training split."""
    test: int = 0
    """Number of items or queries (for `matched`, pairs of items) in the test split."""


@dataclass
class SelectionConfig:
    """Cells of the selection track and their quotas. The name of a cell is its items' `subtype`."""

    min_displacement: float = 12.0
    """Minimum displacement (px at 336 x 336) of at least one object between any two candidates."""
    event: dict[str, Quota] = field(default_factory=dict)
    """Quota of each event cell."""
    time: dict[str, Quota] = field(default_factory=dict)
    """Quota of each time cell."""
    window: dict[str, Quota] = field(default_factory=dict)
    """Quota of each window cell, such as G1_A_h8_easy; a group and family, such as G1_A, divides
    its quota evenly among its six cells."""
    matched: Quota = field(default_factory=Quota)
    """Pairs of matched-anchor items: the two questions differ only in the anchor (event or
    time)."""

    def __post_init__(self) -> None:
        self.window = divide_window_quotas(self.window)

    def check(self) -> list[str]:
        problems = check_minimum(self, "benchmark.selection.", {"min_displacement": 0})
        for family in ("event", "time", "window"):
            problems += check_quotas(f"benchmark.selection.{family}", getattr(self, family))
        return problems + check_quotas("benchmark.selection", {"matched": self.matched})


@dataclass
class RetrievalTrackConfig:
    """Builders 1 to 6 of the retrieval track, and its databases."""

    builders: dict[str, Quota] = field(default_factory=dict)
    """Quota of each builder."""
    counterfactual: Quota = field(default_factory=Quota)
    """Queries about scenes that are simulated again without one of their objects."""
    hard_negatives: int = 3
    """Hard negatives per query: wrong-time frames of the query's own scene."""
    standard: int = 2_002
    """Number of queries in the standard test, divided evenly among the builders."""
    database: int = 10_000
    """Frames in the database of the standard test, including every target."""
    source: int = 30_000
    """Frames in the source database of the builders' queries, including every target."""
    counterfactual_source: int = 26_995
    """Frames in the source database of the counterfactual queries, including every target."""

    def check(self) -> list[str]:
        sizes = dict.fromkeys(("standard", "database", "source", "counterfactual_source"), 0)
        return [
            *check_minimum(self, "benchmark.retrieval.", {"hard_negatives": 1, **sizes}),
            *check_quotas("benchmark.retrieval.builders", self.builders),
            *check_quotas("benchmark.retrieval", {"counterfactual": self.counterfactual}),
        ]


@dataclass
class BenchmarkConfig:
    name: str = MISSING
    """Folder of the benchmark below `store`."""
    simulator: str = "bullet"
    """Source of the scenes: bullet simulates them; clevrer, movi_a and physion read a release."""
    standin: str | None = None
    """Transfer suite to imitate without its release: movi_a or physion. Bullet simulates scenes
    with another camera, floor, light and physics, and the items follow that suite's recipe. null
    simulates standard scenes."""
    folder: str | None = None
    """Folder of the release, when `simulator` reads one."""
    fps: float = 30.0
    """Frame rate (frames per second) of Physion's trials, whose files do not record it."""
    seed: int = 0
    """Seed of the scenes, of the split and of the items."""
    scenes: int = 10_000
    """Number of scenes; for a release, the maximum number."""
    test_share: float = 0.2
    """Share of the scenes in the test split."""
    min_objects: int = 4
    """Minimum number of objects in a scene."""
    max_objects: int = 6
    """Maximum number of objects in a scene."""
    max_collisions: int = 3
    """Maximum number of collisions in a scene."""
    renderer: str = "bullet"
    """bullet (software, runs on every machine) or blender (the look of CLEVRER, needs the extra
    `blender`)."""
    width: int = 480
    """Width of a frame (px)."""
    height: int = 320
    """Height of a frame (px)."""
    prefix_frames: int = 12
    """Evenly spaced frames of each prefix to render during the build."""
    selection: SelectionConfig = field(default_factory=SelectionConfig)
    retrieval: RetrievalTrackConfig = field(default_factory=RetrievalTrackConfig)

    def check(self) -> list[str]:
        least = {"seed": 0, "scenes": 4, "max_collisions": 1, "prefix_frames": 2}
        problems = check_minimum(self, "benchmark.", least)
        problems += check_share(self, "benchmark.", ["test_share"])
        problems += check_positive(self, "benchmark.", ["fps"])
        problems += check_options(
            self,
            "benchmark.",
            {"renderer": RENDERERS, "simulator": SIMULATORS, "standin": (*STANDINS, None)},
        )
        if self.simulator in SIMULATORS[1:] and self._has_counterfactuals():
            problems.append(
                f"benchmark.retrieval.counterfactual with benchmark.simulator={self.simulator}: "
                "scenes of a release cannot be simulated again; set both quotas to 0"
            )
        if self.standin in STANDINS:
            problems += self._standin_problems()
        if not 2 <= self.min_objects <= self.max_objects <= DISTINCT_APPEARANCES:
            problems.append(
                f"benchmark.min_objects={self.min_objects} and "
                f"benchmark.max_objects={self.max_objects}: need 2 <= min <= max <= "
                f"{DISTINCT_APPEARANCES}, because all objects of a scene look different"
            )
        if self.width < 48 or self.width * 2 != self.height * 3:
            problems.append(
                f"benchmark.width={self.width} and benchmark.height={self.height}: the aspect "
                "ratio must be 3:2 and the size at least 48 x 32 px, such as 480 x 320"
            )
        return problems

    def _has_counterfactuals(self) -> bool:
        quota = self.retrieval.counterfactual
        return quota.train + quota.test > 0

    def _standin_problems(self) -> list[str]:
        problems, typed = [], f"benchmark.standin={self.standin}"
        if self.simulator != "bullet":
            problems.append(
                f"{typed} with benchmark.simulator={self.simulator}: a stand-in is simulated; set "
                "benchmark.simulator=bullet"
            )
        if self.renderer == "blender":
            problems.append(
                f"{typed} with benchmark.renderer=blender: Blender only renders the standard look; "
                "set benchmark.renderer=bullet"
            )
        if self.max_objects > STANDIN_OBJECTS:
            problems.append(
                f"{typed} with benchmark.max_objects={self.max_objects}: its view has room for at "
                f"most {STANDIN_OBJECTS} objects"
            )
        if self._has_counterfactuals():
            problems.append(
                f"{typed} has no counterfactual scenes: set both quotas of "
                "benchmark.retrieval.counterfactual to 0"
            )
        return problems


def check_quotas(group: str, quotas: dict[str, Quota]) -> list[str]:
    """Quotas below 0."""
    return [
        problem
        for name, quota in quotas.items()
        for problem in check_minimum(quota, f"{group}.{name}.", {"train": 0, "test": 0})
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
