"""Settings of a benchmark: its scenes, the numbers of its items and queries, and its databases.

A cell is one kind of item, and a builder is the procedure that makes one kind of query. A quota is
the number of items or queries to make of a cell or builder.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product

from dynapix.conf.schema.settings import MISSING, Settings, path, setting
from dynapix.conf.schema.world import WorldConfig

RENDERERS = ("bullet", "blender")
SIMULATORS = ("bullet", "clevrer", "movi_a", "physion", "tracks")
DISTRACTORS = ("paper", "balanced", "contact")
RECIPES = ("dynapix", "movi_a", "physion", "tracks")
WINDOW_FAMILIES = {"G1": "AC", "G2": "ABC", "G3": "AC", "G4": "AB"}
"""Window families of each group (see `data.items.recipes`). B and G2 need a later collision."""
WINDOW_HORIZONS = (8, 16, 24)
"""Number of frames from the last frame of a window item's prefix to its target."""
MASS_CHANGES = ("heavier", "lighter")
"""The interventions on the mass of an object (see `data.items.futures.interventions`)."""
WINDOW_DIFFICULTIES = ("easy", "hard")
MATCHED_ANCHOR = "matched_anchor"
"""Name of the suite of the matched-anchor items."""
INTERVENTIONS = "interventions"
"""Name of the suite of the pairs of items about what comes and what would have come."""
PAIRED = (MATCHED_ANCHOR, INTERVENTIONS)
"""The suites whose items form pairs, which a benchmark has besides its own suite."""
STANDIN = "standin_"
"""Start of the names of the suites whose scenes are simulated instead of read from a release."""
POOLS = ("future", "counterfactual")
"""Kinds of retrieval queries."""
QUERIES_PER_SCENE = {"1": 3, "2": 3, "3": 3, "4": 1, "5": 1, "6": 1}
"""Maximum number of queries of each builder about a scene (paper, retrieval construction)."""
COUNTERFACTUAL_SECONDS = (0.5, 1, 2, 3, 4)
"""Seconds from the end of the prefix to the target of the counterfactual queries about a scene."""
MODEL_SIZE = 336
"""Side (px) of the square image in which displacements are measured: the models' input size."""
SCENE_FRAMES, SCENE_FPS = 128, 25
"""Frames and frame rate of the scenes to which the recipe dynapix applies."""


@dataclass
class Quota(Settings):
    """Number of items of a cell, or of queries of a builder, in each split."""

    train: int = setting(0, least=0)
    """Number of items or queries (for `matched`, pairs of items) in the training split."""
    test: int = setting(0, least=0)
    """Number of items or queries (for `matched`, pairs of items) in the test split."""


@dataclass
class SelectionConfig(Settings):
    """Quotas of the cells of the selection track. A cell's name is the `subtype` of its items."""

    min_displacement: float = setting(12.0, least=0)
    """Minimum displacement (px at 336 x 336) of at least one object between any two candidates."""
    event: dict[str, Quota] = field(default_factory=dict)
    """Quota of each event cell."""
    time: dict[str, Quota] = field(default_factory=dict)
    """Quota of each time cell."""
    window: dict[str, Quota] = field(default_factory=dict)
    """Quota of each window cell, such as G1_A_h8_easy. The quota of a group and family, such as
    G1_A, is divided evenly among those of its six cells that have no quota of their own."""
    matched: Quota = field(default_factory=Quota)
    """Pairs of matched-anchor items. The two questions of a pair ask for the same target, one by an
    event and the other by a time."""
    interventions: dict[str, Quota] = field(default_factory=dict)
    """Pairs of items about interventions, by subtype: absent, heavier, lighter, faster, other_side.
    One question of a pair asks for what comes, and the other for what would have come."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.window = divide_window_quotas(self.window)


@dataclass
class RetrievalTrackConfig(Settings):
    """Quotas and databases of the retrieval track, which has the builders 1 to 6."""

    builders: dict[str, Quota] = field(default_factory=dict)
    """Quota of each builder. The test queries of all builders are the standard test."""
    counterfactual: Quota = field(default_factory=Quota)
    """Quota of counterfactual queries: a scene is simulated again without one of its objects."""
    hard_negatives: int = setting(3, least=1)
    """Hard negatives per query: frames of the target's scene at other moments and, for a
    counterfactual query, the factual scene's frame at the target's moment."""
    database: int = setting(10_000, least=0)
    """Number of frames in the database of the standard test, including every target."""
    source: int = setting(30_000, least=0)
    """Number of frames in the database of all queries of the builders, including every target."""
    counterfactual_source: int = setting(26_995, least=0)
    """Number of frames in the database of all counterfactual queries, including every target."""


def store_name(benchmark: str, world: str) -> str:
    """Return the name of a benchmark's folder: that of the benchmark, followed by the world's name
    unless the world is clevrer or the name ends with it."""
    if world == "clevrer" or benchmark.endswith(world):
        return benchmark
    return f"{benchmark}-{world}"


@dataclass
class BenchmarkConfig(Settings):
    name: str = MISSING
    """Name of the benchmark. Its folder below `store` is NAME-WORLD; or NAME, if the world is
    clevrer or NAME ends with the name of the world."""
    simulator: str = setting("bullet", SIMULATORS)
    """Source of the scenes: bullet simulates them; the others read a release from `folder`."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """World of simulated scenes."""
    recipe: str | None = setting(None, (*RECIPES, None))
    """How items are made: as the paper does it for CLEVRER (dynapix), for MoVi-A (movi_a) or for
    Physion (physion), or without contacts (tracks). null takes the recipe of `simulator`; that of
    bullet is dynapix."""
    distractors: str = setting("paper", DISTRACTORS)
    """Distractors of selection items: as in the paper (paper); frames of other futures of the
    scene, chosen so that only a prediction of its motion reveals the target (balanced); or frames
    of other outcomes of a collision, chosen so that only contact physics reveals it (contact)."""
    folder: str | None = path(None)
    """Folder of the release or of the tracked videos, if `simulator` reads one."""
    fps: float = setting(30.0, above=0)
    """Frame rate (frames per second) of Physion's trials, most of which do not record it."""
    seed: int = setting(0, least=0)
    """Seed of the scenes, the split and the items."""
    scenes: int = setting(10_000, least=4)
    """Number of scenes to simulate, or maximum number of scenes to read from a release."""
    test_share: float = setting(0.2, above=0, most=1)
    """Share of the scenes in the test split; of the videos, if `simulator` is tracks."""
    test_scenes: int | None = setting(None, least=1)
    """Number of scenes of the test split that the test items, the test queries and the frames of
    their database come from, chosen at random; nothing uses the other test scenes. null takes
    all."""
    renderer: str = setting("bullet", RENDERERS)
    """bullet renders on the CPU of any machine; blender renders scenes that look like CLEVRER's and
    needs the extra `blender`."""
    width: int = 480
    """Width of a frame (px)."""
    height: int = 320
    """Height of a frame (px)."""
    prefix_frames: int = setting(12, least=2)
    """Number of evenly spaced frames of each prefix that are rendered during the build."""
    selection: SelectionConfig = field(default_factory=SelectionConfig)
    retrieval: RetrievalTrackConfig = field(default_factory=RetrievalTrackConfig)

    @property
    def store_name(self) -> str:
        """Name of the benchmark's folder below `store`."""
        return store_name(self.name, self.world.name)

    @property
    def item_recipe(self) -> str:
        """The recipe of the items, `recipe` or the simulator's own."""
        own = self.simulator if self.simulator in RECIPES else "dynapix"
        return self.recipe or own

    @property
    def suite(self) -> str:
        """Name of the set of items: `dynapix`, a transfer suite, or a stand-in for one, whose
        scenes are simulated."""
        recipe = self.item_recipe
        is_standin = recipe != "dynapix" and self.simulator != recipe
        return f"{STANDIN}{recipe}" if is_standin else recipe

    def find_problems(self, group: str) -> Iterator[str]:
        if not re.fullmatch(r"\w[\w.-]*", self.name, re.ASCII):
            yield f"{group}name={self.name}: use letters, digits, '_', '-' and '.' only"
        simulator, recipe = f"{group}simulator={self.simulator}", self.item_recipe
        counterfactual = self.retrieval.counterfactual
        has_counterfactuals = counterfactual.train + counterfactual.test > 0
        remedy = f"set both quotas of {group}retrieval.counterfactual to 0"
        if self.simulator in SIMULATORS[1:]:
            if has_counterfactuals:
                yield f"{simulator}: scenes of a release cannot be simulated again; {remedy}"
            if self.simulator in RECIPES and recipe != self.simulator:
                yield f"{simulator} with {group}recipe={recipe}: set {group}recipe={self.simulator}"
            if self.world != WorldConfig():
                yield (
                    f"{simulator} with world={self.world.name}: a world is simulated, but the "
                    f"scenes of a release are read; set world=clevrer or {group}simulator=bullet"
                )
        physics = self.world.physics
        if recipe == "dynapix" and (physics.frames, physics.fps) != (SCENE_FRAMES, SCENE_FPS):
            yield (
                f"{group}world.physics.frames={physics.frames} and {group}world.physics.fps="
                f"{physics.fps}: the recipe dynapix needs {SCENE_FRAMES} frames at {SCENE_FPS} per "
                f"second; set them, or set {group}recipe=movi_a or physion"
            )
        if self.distractors != "paper" and (recipe != "dynapix" or self.simulator != "bullet"):
            yield (
                f"{group}distractors={self.distractors} with {simulator} and {group}recipe="
                f"{recipe}: these distractors are frames of simulated futures; set "
                f"{group}simulator=bullet and {group}recipe=dynapix, or {group}distractors=paper"
            )
        yield from self._find_intervention_problems(group)
        if recipe == "tracks":
            yield from self._find_contact_quotas(group)
        elif recipe != "dynapix":
            if any(quota.train + quota.test for quota in self.retrieval.builders.values()):
                yield (
                    f"{group}retrieval.builders with {group}recipe={recipe}: this recipe has no "
                    "queries; set the quotas of all builders to 0"
                )
            if has_counterfactuals:
                yield f"{group}retrieval.counterfactual with {group}recipe={recipe}: {remedy}"
        if self.renderer == "blender" and (look := _unusual_look(self.world)):
            yield (
                f"{group}renderer=blender: Blender has no {look} of world={self.world.name}; set "
                f"{group}renderer=bullet"
            )
        if self.simulator == "bullet":
            yield from self.find_pixel_problem(self.width, self.height, group)
        yield from self._find_unmet_quotas(group)
        if self.width < 48 or self.width * 2 != self.height * 3:
            yield (
                f"{group}width={self.width} and {group}height={self.height}: the aspect ratio "
                "must be 3:2 and the size at least 48 x 32 px, such as 480 x 320"
            )

    def find_pixel_problem(
        self, width: int, height: int, group: str = "benchmark."
    ) -> Iterator[str]:
        """Describe a minimum displacement below a pixel of a frame of `width` x `height` px."""
        pixel = MODEL_SIZE / min(width, height)
        if self.selection.min_displacement < pixel:
            yield (
                f"{group}selection.min_displacement={self.selection.min_displacement} must be at "
                f"least {pixel:.2f}, a pixel of a frame of {width} x {height} px: otherwise "
                "candidates could be the same image"
            )

    def _find_intervention_problems(self, group: str) -> Iterator[str]:
        """Describe pairs about interventions that the world or the simulator cannot give."""
        quotas = self.selection.interventions
        asked = [name for name, quota in quotas.items() if quota.train + quota.test]
        if asked and (self.simulator != "bullet" or self.item_recipe != "dynapix"):
            yield (
                f"{group}selection.interventions with {group}simulator={self.simulator} and "
                f"{group}recipe={self.item_recipe}: their scenes are simulated again; set "
                f"{group}simulator=bullet and {group}recipe=dynapix, or remove these quotas"
            )
        mass, about = self.world.objects.mass, [name for name in asked if name in MASS_CHANGES]
        if about and mass.metal <= mass.rubber:
            yield (
                f"{group}selection.interventions.{', '.join(about)} with world={self.world.name}: "
                f"metal is not heavier than rubber there (objects.mass.metal={mass.metal:g}, "
                f"rubber={mass.rubber:g}), so a question about the mass has no answer; set "
                "world=masses or world=above_masses, or remove these quotas"
            )

    def _find_contact_quotas(self, group: str) -> Iterator[str]:
        """Describe what the recipe tracks cannot make."""
        if self.simulator != "tracks":
            yield (
                f"{group}recipe=tracks with {group}simulator={self.simulator}: this recipe is for "
                f"tracked videos; set {group}simulator=tracks"
            )
        track, builders = self.selection, self.retrieval.builders
        quotas = {
            **{f"selection.event.{cell}": quota for cell, quota in track.event.items()},
            **{
                f"selection.window.{cell[:4]}": quota
                for cell, quota in track.window.items()
                if needs_contacts(cell) and quota.train + quota.test
            },
            "selection.matched": track.matched,
            **{f"retrieval.builders.{b}": q for b, q in builders.items() if b in "3456"},
        }
        if refused := [name for name, quota in quotas.items() if quota.train + quota.test]:
            yield (
                f"{group}{', '.join(refused)} with {group}recipe=tracks: object tracks record no "
                "contacts, to which these questions refer; set both quotas to 0"
            )

    def _find_unmet_quotas(self, group: str) -> Iterator[str]:
        """Describe each quota and size that `test_scenes` scenes cannot meet."""
        if self.test_scenes is None:
            return
        track, builders = self.selection, self.retrieval.builders
        quotas = {
            f"selection.{family}.{cell}": (quota.test, 1)
            for family in ("event", "time", "window")
            for cell, quota in getattr(track, family).items()
        }
        for change, quota in track.interventions.items():
            quotas[f"selection.interventions.{change}"] = (quota.test, 1)
        quotas["selection.matched"] = (track.matched.test, 1)
        for name, most in QUERIES_PER_SCENE.items():
            quotas[f"retrieval.builders.{name}"] = (builders.get(name, Quota()).test, most)
        counterfactual = self.retrieval.counterfactual.test
        quotas["retrieval.counterfactual"] = (counterfactual, len(COUNTERFACTUAL_SECONDS))
        limits = {f"{name}.test": limit for name, limit in quotas.items()}
        has_queries = any(quota.train + quota.test for quota in builders.values())
        if has_queries and self.simulator == "bullet":
            limits["retrieval.database"] = (self.retrieval.database, self.world.physics.frames)
        for name, (quota, most) in limits.items():
            if quota > most * self.test_scenes:
                yield (
                    f"{group}test_scenes={self.test_scenes} cannot carry {group}{name}={quota}: a "
                    f"scene gives at most {most}; raise the former or lower the latter"
                )


def needs_contacts(window_cell: str) -> bool:
    """Return whether the items of a window cell, such as G2_B_h8_easy, are about a collision."""
    group, _, rest = window_cell.partition("_")
    return group == "G2" or rest.startswith("B")


def _unusual_look(world: WorldConfig) -> str | None:
    """Name a setting of a world's look that differs from CLEVRER's and that Blender lacks."""
    usual = WorldConfig()
    looks = {
        "light": world.light != usual.light,
        "floor colour": world.floor != usual.floor,
        "background": world.background != usual.background,
        "parts": bool(world.parts),
        "scale of objects": world.objects.scale != usual.objects.scale,
    }
    return next((name for name, differs in looks.items() if differs), None)


def divide_window_quotas(quotas: dict[str, Quota]) -> dict[str, Quota]:
    """Divide the quota of each group and family, such as G1_A, evenly among those of its cells that
    have no quota of their own. The first cells get the remainder."""
    cells: dict[str, Quota] = {}
    for name, quota in quotas.items():
        group, _, family = name.partition("_")
        if len(family) != 1 or family not in WINDOW_FAMILIES.get(group, ""):
            cells[name] = quota
            continue
        every = product(WINDOW_HORIZONS, WINDOW_DIFFICULTIES)
        names = [f"{name}_h{horizon}_{difficulty}" for horizon, difficulty in every]
        shared = [cell for cell in names if cell not in quotas]
        for cell in names:
            if cell in quotas:
                cells[cell] = quotas[cell]
                continue
            k = shared.index(cell)
            train, test = (
                total // len(shared) + (k < total % len(shared))
                for total in (quota.train, quota.test)
            )
            cells[cell] = Quota(train, test)
    return cells
