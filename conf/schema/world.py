"""Settings of a world: its camera, physics, objects, light, and the parts that stand on its floor.

Lengths are in simulator units: an object of scale 1 has a radius of 0.2. The floor is the plane
z = 0, z points up, and y points to the right in the image if the camera looks along -x. The
defaults are the world of CLEVRER.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import dist, hypot

from dynapix.conf.schema.settings import Settings, check_choices, setting

SHAPES = ("cube", "sphere", "cylinder")
APPEARANCES_PER_SHAPE = 16
"""Number of distinct objects of one shape: 8 colours x 2 materials."""
STARTS = ("slide", "throw", "strike")
MAX_TILT = 45.0
"""Maximum tilt of a part, degrees. On steeper ramps, cubes tumble and leave the surface instead of
sliding."""
RADIUS = 0.2
"""Radius of spheres and cylinders, and half the height of cylinders, of scale 1, simulator units.
In the world of CLEVRER, all objects have scale 1."""
SLIDE_FRAMES = 33
"""Minimum number of frames of scenes in which objects slide; see `data.sim.starts`."""
MAX_ROW = 6
"""Maximum number of objects in a scene that starts with a row of objects."""


def vector(*values: float) -> list[float]:
    """Return the dataclass field of a list of numbers, whose length must not change."""
    return field(default_factory=lambda: list(values))


def check_vector(key: str, value: Sequence[float], names: str) -> Iterator[str]:
    """Yield a message if a list does not have one number for each of `names`."""
    if len(value) != len(names.split()):
        yield f"{key}={list(value)}: give {len(names.split())} numbers ({names})"


def check_range(key: str, value: Sequence[float], least: float) -> Iterator[str]:
    """Yield a message unless a list is a range [low, high] that starts at `least` or above."""
    if len(value) != 2 or not least <= value[0] <= value[1]:
        yield f"{key}={list(value)}: give [low, high] with {least:g} <= low <= high"


def check_color(key: str, value: Sequence[float]) -> Iterator[str]:
    """Yield a message unless a list is an RGB colour."""
    if len(value) != 3 or not all(0 <= channel <= 255 for channel in value):
        yield f"{key}={list(value)}: give red, green and blue from 0 to 255"


@dataclass
class CameraConfig(Settings):
    position: list[float] = vector(4.3301, 0.0, 2.5)
    """Position [x, y, z]; z is the height above the floor."""
    aim: list[float] = vector(0.0, 0.0, 0.0)
    """Point [x, y, z] in the middle of the image."""
    field_of_view: float = setting(49.134, least=5, most=120)
    """Horizontal angle of view (degrees)."""

    def find_problems(self, group: str) -> Iterator[str]:
        for name in ("position", "aim"):
            yield from check_vector(f"{group}{name}", getattr(self, name), "x y z")
        if len(self.position) != 3 or len(self.aim) != 3:
            return
        if self.position[2] <= 0:
            yield f"{group}position={self.position}: the camera is not above the floor; raise z"
        elif dist(self.position[:2], self.aim[:2]) < 0.01:
            yield (
                f"{group}position={self.position} and {group}aim={self.aim}: the camera must not "
                "look straight down or up; change x or y of one of them"
            )
        elif self.aim[2] >= self.position[2]:
            yield (
                f"{group}aim={self.aim}: the camera looks at no floor; set the z of the aim below "
                f"that of {group}position={self.position}"
            )


@dataclass
class ByMaterial(Settings):
    """One number for each material."""

    metal: float = setting(1.0, least=0)
    """Value for metal."""
    rubber: float = setting(1.0, least=0)
    """Value for rubber."""


@dataclass
class PhysicsConfig(Settings):
    """Bullet multiplies the coefficients of two bodies that touch: an object slides with the
    friction `floor_friction` x `object_friction`."""

    frames: int = setting(128, least=8)
    """Frames of a scene."""
    fps: int = setting(25, least=1)
    """Frames per second."""
    substeps: int = setting(7, least=1)
    """Simulation steps per frame. Fast or small objects need more."""
    gravity: float = setting(9.81, above=0)
    """Acceleration of falling objects (units/s2)."""
    floor_friction: float = setting(0.1, least=0)
    """Friction coefficient of the floor."""
    object_friction: float = setting(0.3, least=0)
    """Friction coefficient of objects."""
    rolling_friction: float = setting(0.0, least=0)
    """Rolling friction of spheres (units). 0 lets them roll on. Cylinders that have fallen over
    always roll on."""
    floor_restitution: float = setting(0.0, least=0, most=1)
    """Restitution of the floor. With 0, nothing bounces on it."""
    restitution: ByMaterial = field(default_factory=lambda: ByMaterial(metal=0.7, rubber=0.5))
    """Restitution of objects by material, at most 1."""

    @property
    def friction_deceleration(self) -> float:
        """Deceleration of a sliding object (units/s2)."""
        return self.floor_friction * self.object_friction * self.gravity

    def find_problems(self, group: str) -> Iterator[str]:
        for material, value in vars(self.restitution).items():
            if value > 1:
                yield f"{group}restitution.{material}={value} must be at most 1"


@dataclass
class ObjectsConfig(Settings):
    min_count: int = setting(4, least=2)
    """Minimum number of objects in a scene."""
    max_count: int = setting(6, least=2)
    """Maximum number of objects in a scene."""
    shapes: list[str] = field(default_factory=lambda: list(SHAPES))
    """Shapes of objects."""
    scale: list[float] = vector(1.0, 1.0)
    """Range [low, high] of an object's size, as a multiple of the standard size: a radius of 0.2
    for spheres and cylinders, half an edge of 0.18 for cubes."""
    mass: ByMaterial = field(default_factory=ByMaterial)
    """Mass by material of an object of scale 1. The mass grows with the cube of the scale."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from check_choices(f"{group}shapes", self.shapes, SHAPES)
        yield from check_range(f"{group}scale", self.scale, 0.1)
        names = len(set(self.shapes)) * APPEARANCES_PER_SHAPE
        if not self.min_count <= self.max_count <= names:
            yield (
                f"{group}min_count={self.min_count} and {group}max_count={self.max_count}: need "
                f"min <= max <= {names}, because all objects of a scene look different"
            )
        for material, value in vars(self.mass).items():
            if value == 0:
                yield f"{group}mass.{material}=0 must be above 0"


@dataclass
class StartConfig(Settings):
    """How objects start.

    slide: a first object slides into the view. Each further object is placed so that it collides
    with an earlier one, at rest or sliding. The remaining objects rest.
    throw: objects start above the floor or above a part, and move towards the middle.
    strike: an object slides along a row of objects at rest, or falls on its first object.
    """

    kind: str = setting("slide", STARTS)
    """slide, throw or strike."""
    middle: list[float] = vector(-0.7, 0.0)
    """Point [x, y] of the floor towards which moving objects start."""
    spread: float = setting(1.0, least=0)
    """Moving objects start towards a random point at most this far from `middle` along x and y.
    Thrown objects that rest lie in the same square."""
    distance: list[float] = vector(2.6, 4.0)
    """Range of the distance from which an object slides in (from `middle`, or from the row)."""
    speed: list[float] = vector(1.0, 3.0)
    """Range of the initial speed of moving objects (units/s); one that falls on a row is slower."""
    at_rest: float = setting(0.35, least=0, most=1)
    """Share of objects that start at rest: of those placed to collide (slide) or of all (throw)."""
    area: list[float] = vector(-3.5, -2.2, 1.2, 2.2)
    """Part of the floor [x min, y min, x max, y max] for objects at rest (slide), for thrown
    objects, or for the first object of a row (strike)."""
    height: list[float] = vector(0.5, 1.5)
    """Range of the initial height of the centre above the surface, for objects in the air."""
    max_collisions: int | None = setting(3, least=1)
    """Maximum number of pairs of objects that collide in a scene; null for any number. A pair may
    collide again, except if objects slide in."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from check_vector(f"{group}middle", self.middle, "x y")
        for name in ("distance", "speed", "height"):
            yield from check_range(f"{group}{name}", getattr(self, name), 0)
        if len(self.distance) == 2 and self.distance[0] == 0 and self.kind != "throw":
            yield f"{group}distance={self.distance}: the distance must be above 0"
        area = self.area
        if len(area) != 4 or not (area[0] < area[2] and area[1] < area[3]):
            yield f"{group}area={area}: give [x min, y min, x max, y max], each min below its max"


@dataclass
class LightConfig(Settings):
    """Light of the renderer `bullet`; the renderer `blender` has lamps of its own."""

    direction: list[float] = vector(3.0, 3.0, 6.0)
    """Direction [x, y, z] towards the light."""
    ambient: float = setting(0.45, least=0, most=1)
    """Brightness of surfaces that face away from the light."""
    diffuse: float = setting(0.6, least=0, most=1)
    """Additional brightness of surfaces that face the light."""

    def find_problems(self, group: str) -> Iterator[str]:
        key = f"{group}direction"
        yield from check_vector(key, self.direction, "x y z")
        if len(self.direction) == 3 and not self.direction[2] > 0.2 * hypot(*self.direction[:2]):
            lowest = 0.2 * hypot(*self.direction[:2])
            yield f"{key}={self.direction}: the light is too low; z must be above {lowest:.3g}"


@dataclass
class PartConfig(Settings):
    """A box that does not move: a ramp, a wall, or a screen that hides what is behind it."""

    position: list[float] = vector(0.0, 0.0, 0.5)
    """Centre [x, y, z] of the box."""
    size: list[float] = vector(1.0, 1.0, 1.0)
    """Lengths [x, y, z] of the edges."""
    turn: float = 0.0
    """Rotation about the vertical axis (degrees)."""
    tilt: float = 0.0
    """Rotation about the box's own y axis (degrees, at most 45), before the turn. A positive tilt
    lowers the side of positive x, as of a ramp that descends along x."""
    color: list[float] = vector(140.0, 130.0, 118.0)
    """RGB colour, 0 to 255."""
    friction: float = setting(0.1, least=0)
    """Friction coefficient of the surface."""
    restitution: float = setting(0.5, least=0, most=1)
    """Restitution of the surface."""

    def find_problems(self, group: str) -> Iterator[str]:
        for name in ("position", "size"):
            yield from check_vector(f"{group}{name}", getattr(self, name), "x y z")
        if len(self.size) == 3 and min(self.size) <= 0.02:
            yield f"{group}size={self.size}: each edge must be longer than 0.02"
        yield from check_color(f"{group}color", self.color)
        if abs(self.tilt) > MAX_TILT:
            yield (
                f"{group}tilt={self.tilt:g}: objects tumble off ramps steeper than {MAX_TILT:g} "
                "degrees; give a smaller tilt"
            )


@dataclass
class WorldConfig(Settings):
    name: str = "clevrer"
    """Name of the world: lower-case letters, digits and underscores. The folder of a benchmark in
    another world than clevrer ends with it."""
    camera: CameraConfig = field(default_factory=CameraConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    start: StartConfig = field(default_factory=StartConfig)
    light: LightConfig = field(default_factory=LightConfig)
    floor: list[float] = vector(158.0, 156.0, 152.0)
    """RGB colour of the floor at full light, 0 to 255."""
    background: list[float] = vector(158.0, 156.0, 152.0)
    """RGB colour above the horizon, 0 to 255."""
    parts: dict[str, PartConfig] = field(default_factory=dict)
    """Boxes that do not move, by a name of your choice."""
    speed_bounds: list[float] = vector(0.6, 1.5, 3.0)
    """Upper bounds of the speeds (units/s) that rationales call slow, steady and quick; objects
    above the last move very quickly. Below 0.05, an object is stationary."""

    def find_problems(self, group: str) -> Iterator[str]:
        for name in ("floor", "background"):
            yield from check_color(f"{group}{name}", getattr(self, name))
        if not re.fullmatch(r"[a-z0-9_]+", self.name):
            yield f"{group}name={self.name}: use lower-case letters, digits and underscores"
        if self.start.kind == "slide" and self.physics.frames < SLIDE_FRAMES:
            yield (
                f"{group}physics.frames={self.physics.frames} with {group}start.kind=slide: "
                f"objects that slide need at least {SLIDE_FRAMES} frames"
            )
        # Empty ranges are named by the checks of their groups.
        radius = RADIUS * max(self.objects.scale, default=0)
        if self.start.kind != "slide" and min(self.start.height, default=radius) < radius:
            yield (
                f"{group}start.height={self.start.height}: the centre of an object with the radius "
                f"{radius:g} would start inside the surface; raise it"
            )
        bounds = self.speed_bounds
        if len(bounds) != 3 or not 0.05 < bounds[0] < bounds[1] < bounds[2]:
            yield f"{group}speed_bounds={bounds}: give 3 rising numbers above 0.05"
        if self.start.kind == "strike" and self.objects.max_count > MAX_ROW:
            yield (
                f"{group}start.kind=strike with {group}objects.max_count="
                f"{self.objects.max_count}: a row has room for at most {MAX_ROW} objects"
            )
