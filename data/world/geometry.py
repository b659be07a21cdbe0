"""Camera, visibility and how far apart two frames of a scene are, all from the oracle alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce

import numpy as np

from data.records import Scene, SceneObject

RADIUS = 0.2
"""Radius of spheres and cylinders and half the cylinder's height, simulator units. Objects of one
size, as CLEVRER has them."""
CUBE_HALF = 0.18
"""Half of a cube's edge, simulator units."""
BOUNDING_RADIUS = {"sphere": RADIUS, "cylinder": RADIUS * 2**0.5, "cube": CUBE_HALF * 3**0.5}
MODEL_SIZE = 336
"""Side in px of the square image that displacements are measured in."""
STRIDE = 2
"""Visibility is counted on every second pixel of every second row: a quarter of the rays, and
within 2% of the count over all for an object that shows."""
DIAGONAL = MODEL_SIZE * 2**0.5


@dataclass(frozen=True)
class Camera:
    """A pinhole looking at the origin with z up. The defaults fit CLEVRER's release."""

    width: int = 480
    height: int = 320
    focal: float = 525.0
    eye: tuple[float, float, float] = (4.3301, 0.0, 2.5)

    @cached_property
    def axes(self) -> np.ndarray:
        """(3, 3) rows: right, down and forward in world coordinates."""
        forward = -np.asarray(self.eye) / np.linalg.norm(self.eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def sized(self, width: int, height: int) -> Camera:
        """This camera at another resolution."""
        return replace(self, width=width, height=height, focal=self.focal * width / self.width)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points (..., 3) -> px (..., 2) and depth (...) along the optical axis."""
        local = (points - np.asarray(self.eye)) @ self.axes.T
        depth = local[..., 2]
        # A point beside or behind the camera has no image; keep it finite and far outside.
        safe = np.maximum(depth, 1e-3)
        centre = np.array([self.width / 2, self.height / 2])
        return centre + self.focal * local[..., :2] / safe[..., None], depth

    def rays(self, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """(P, 3) world directions through the centres of P pixels, not normalised."""
        x = (columns + 0.5 - self.width / 2) / self.focal
        y = (rows + 0.5 - self.height / 2) / self.focal
        return np.stack([x, y, np.ones_like(x)], axis=-1) @ self.axes


STANDARD_CAMERA = Camera()


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) matrix of a unit quaternion in x y z w order."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def hit_depth(
    shape: str, position: np.ndarray, quaternion: np.ndarray, eye: np.ndarray, rays: np.ndarray
) -> np.ndarray:
    """(P,) ray parameter of the first hit of each ray from `eye` on an object, inf for a miss."""
    to_local = rotation(quaternion)
    origin = (eye - position) @ to_local
    direction = rays @ to_local
    with np.errstate(divide="ignore", invalid="ignore"):
        if shape == "sphere":
            return _solve_quadric(origin, direction, 3)
        if shape == "cube":
            low, high = _slab(origin, direction, CUBE_HALF)
            low, high = reduce(np.maximum, low.T), reduce(np.minimum, high.T)
            return np.where((low <= high) & (low > 0), low, np.inf)
        side = _solve_quadric(origin, direction, 2)
        on_side = np.abs(origin[2] + side * direction[:, 2]) <= RADIUS
        side = np.where(on_side, side, np.inf)
        cap, _ = _slab(origin[2:], direction[:, 2:], RADIUS)
        cap = cap[:, 0]
        across = origin[:2] + cap[:, None] * direction[:, :2]
        on_cap = _squares(across) <= RADIUS**2
        return np.minimum(side, np.where(on_cap & (cap > 0), cap, np.inf))


def _solve_quadric(origin: np.ndarray, direction: np.ndarray, axes: int) -> np.ndarray:
    """Nearest hit on a sphere (3 axes) or an endless z cylinder (2 axes) of radius RADIUS."""
    o, d = origin[:axes], direction[:, :axes]
    a = _squares(d)
    b = d @ o
    c = o @ o - RADIUS**2
    under = b * b - a * c
    t = (-b - np.sqrt(np.maximum(under, 0))) / a
    return np.where((under > 0) & (t > 0), t, np.inf)


def _squares(vectors: np.ndarray) -> np.ndarray:
    """(P,) squared lengths. Column by column, for numpy is slow over so short an axis."""
    return reduce(np.add, (vectors**2).T)


def _slab(origin: np.ndarray, direction: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    first, second = (-half - origin) / direction, (half - origin) / direction
    return np.minimum(first, second), np.maximum(first, second)


def visibility(
    objects: tuple[SceneObject, ...],
    positions: np.ndarray,
    quaternions: np.ndarray,
    camera: Camera,
) -> tuple[np.ndarray, np.ndarray]:
    """Which objects are seen, and how much of each, by casting a ray through every pixel that
    matters.

    Args:
        positions: (F, N, 3), and quaternions (F, N, 4) in x y z w order.

    Returns:
        in_view (F, N) bool and visible_fraction (F, N) in [0, 1], as `Scene` defines them.
    """
    centre, depth = camera.project(positions)
    bound = np.array([BOUNDING_RADIUS[o.shape] for o in objects])
    in_front = depth > bound + 0.05
    # An off-axis ball's outline is a little longer than focal * r / depth: 1.3 covers the view.
    reach = np.where(in_front, 1.3 * camera.focal * bound / np.maximum(depth, 1e-3), 0.0)
    size = np.array([camera.width, camera.height])
    inside = in_front & (
        (centre - reach[..., None] >= 0) & (centre + reach[..., None] <= size)
    ).all(-1)
    outside = ~in_front | (
        (centre + reach[..., None] < 0) | (centre - reach[..., None] > size)
    ).any(-1)
    hides = _may_hide(positions - np.asarray(camera.eye), bound)
    hides &= ~outside[:, :, None] & ~outside[:, None, :]

    in_view = inside.copy()
    fraction = inside.astype(np.float64)
    eye = np.asarray(camera.eye)
    for f, i in np.argwhere(~outside & (~inside | hides.any(-1))):
        columns, rows = _pixels_around(centre[f, i], reach[f, i], camera)
        rays = camera.rays(columns, rows)
        own = hit_depth(objects[i].shape, positions[f, i], quaternions[f, i], eye, rays)
        covered = np.isfinite(own)
        visible = covered.copy()
        for j in np.flatnonzero(hides[f, i]):
            other = hit_depth(objects[j].shape, positions[f, j], quaternions[f, j], eye, rays)
            visible &= ~(other < own)
        in_view[f, i] = covered.any()
        fraction[f, i] = visible.sum() / covered.sum() if covered.any() else 0.0
    return in_view, fraction


def _may_hide(seen: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """(F, N, N) whether object j may hide a part of object i: the cones in which the eye sees their
    bounding balls meet, and j's is not wholly behind i's.

    Args:
        seen: (F, N, 3) centres as seen from the eye, and bound (N,) radii of the balls.
    """
    distance = np.linalg.norm(seen, axis=-1)
    toward = seen / distance[..., None]
    cone = np.arcsin(np.minimum(bound / distance, 1))
    angle = np.arccos(np.clip(np.einsum("fic,fjc->fij", toward, toward), -1, 1))
    meet = angle < cone[:, :, None] + cone[:, None, :]
    behind = (distance - bound)[:, None, :] > (distance + bound)[:, :, None]
    return meet & ~behind & ~np.eye(len(bound), dtype=bool)


def _pixels_around(
    centre: np.ndarray, reach: float, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    left, top = np.maximum(np.floor(centre - reach), 0).astype(int)
    right = min(int(centre[0] + reach) + 1, camera.width)
    bottom = min(int(centre[1] + reach) + 1, camera.height)
    columns, rows = np.meshgrid(np.arange(left, right, STRIDE), np.arange(top, bottom, STRIDE))
    return columns.ravel().astype(float), rows.ravel().astype(float)


def on_screen(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """(F, N, 2) where objects stand in px at 336 x 336, and (F, N) whether their centre shows."""
    places = scene.image_positions * (MODEL_SIZE / np.array(scene.image_size))
    inside = (places >= 0).all(-1) & (places <= MODEL_SIZE).all(-1)
    return places, scene.in_view & inside


@lru_cache(maxsize=64)
def displacements(scene: Scene, about: tuple[int, ...] | None = None) -> np.ndarray:
    """(F, F) how far two frames of a scene are apart: the largest image displacement between them
    of an object (of one in `about`, where that is given), px at 336 x 336, the image's diagonal at
    most.

    An object counts where its centre is on screen in at least one of the two frames, so that a
    sliver at the edge tells no frames apart.
    """
    places, shown = on_screen(scene)
    if about is not None:
        places, shown = places[:, about], shown[:, about]
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    counts = shown[:, None] | shown[None]
    return np.minimum(np.where(counts, apart, 0.0).max(axis=-1, initial=0.0), DIAGONAL)


def displacement_across(scene: Scene, frame: int, other: Scene, other_frame: int) -> float:
    """How far frames of two scenes are apart: as `displacements` over objects that look alike. One
    that shows and is in only one of the scenes makes them as far apart as can be."""
    here, there = _shown_at(scene, frame), _shown_at(other, other_frame)
    apart = 0.0
    for look in here.keys() | there.keys():
        (place, shown), (other_place, other_shown) = (
            side.get(look, (np.full(2, np.inf), False)) for side in (here, there)
        )
        if shown or other_shown:
            apart = max(apart, float(np.linalg.norm(place - other_place)))
    return min(apart, DIAGONAL)


def _shown_at(scene: Scene, frame: int) -> dict[tuple[SceneObject, int], tuple[np.ndarray, bool]]:
    """Where each object is and whether it shows, by its look and which of those that look so."""
    places, shown = on_screen(scene)
    return {
        (look, scene.objects[:k].count(look)): (places[frame, k], bool(shown[frame, k]))
        for k, look in enumerate(scene.objects)
    }


def object_match(scene: Scene, target: int, about: tuple[int, ...] | None = None) -> np.ndarray:
    """(F,) how unlike `target` each frame of a scene looks, 0 for itself: the mean over objects
    (those in `about`, where that is given) of the image-plane displacement as a share of the
    image's diagonal, where an object in view in only one of the two counts as 1 and one in view in
    neither as 0."""
    apart = np.linalg.norm(scene.image_positions - scene.image_positions[target], axis=-1)
    share = np.minimum(apart / np.hypot(*scene.image_size), 1.0)
    seen, seen_too = scene.in_view, scene.in_view[target]
    unlike = np.where(seen & seen_too, share, seen ^ seen_too)
    return (unlike if about is None else unlike[:, about]).mean(axis=-1)
