"""Rendered pixels: visibility agrees with Bullet's mask, and appearances are distinguishable."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict, replace

import numpy as np
import pytest
from PIL import Image
from sklearn.neighbors import KNeighborsClassifier

from dynapix.data.oracle.displacement import frame_displacements, object_match_scores
from dynapix.data.records import COLORS, MATERIALS, SHAPES, Scene, SceneObject
from dynapix.data.render import get_renderer
from dynapix.data.render.bullet import BulletRenderer
from dynapix.data.sim.camera import Camera
from tests.data.simulated import CLEVRER, simulate_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return simulate_scene(0, 0)


def test_origin_is_projected_to_the_image_centre() -> None:
    pixel, depth = Camera().project(np.zeros(3))
    np.testing.assert_allclose(pixel, [240, 160], atol=1e-9)
    assert depth == pytest.approx(5.0, abs=1e-3)


FRAMES = [0, 10, 15, 20, 60, 100]


def test_visibility_agrees_with_bullets_mask(scene: Scene) -> None:
    renderer = BulletRenderer(240, 160, CLEVRER)  # renders at 480 x 320, the oracle's image size
    # These frames have objects out of view, fully visible and partly hidden.
    fractions = scene.visible_fraction[FRAMES]
    assert not scene.in_view[FRAMES].all()
    assert (fractions == 1).any()
    assert ((fractions > 0.2) & (fractions < 0.8)).any()
    for frame in FRAMES:
        handles = renderer.pose(scene, frame)
        _, mask = renderer.capture()
        for k, handle in enumerate(handles):
            visible = int((mask == handle).sum())
            renderer.pose(alone(scene, k), frame)
            covers = int((renderer.capture()[1] >= 0).sum())
            if covers > 8 or covers == 0:
                assert scene.in_view[frame, k] == (covers > 0)
            if covers > 100:
                fraction = scene.visible_fraction[frame, k]
                assert fraction == pytest.approx(visible / covers, abs=0.05)


def alone(scene: Scene, k: int) -> Scene:
    """A copy of the scene with only object k."""
    arrays = {name: getattr(scene, name)[:, k : k + 1] for name in Scene.ARRAYS}
    name = f"{scene.scene_id}-only-{k}"
    return replace(scene, scene_id=name, objects=(scene.objects[k],), collisions=(), **arrays)


def test_displacement_is_a_symmetric_distance(scene: Scene) -> None:
    gaps = frame_displacements(scene)
    np.testing.assert_array_equal(np.diag(gaps), 0)
    np.testing.assert_array_equal(gaps, gaps.T)
    assert object_match_scores(scene, 40)[40] == 0
    assert (object_match_scores(scene, 40) <= 1).all()


def test_rendering_is_independent_of_the_previous_scene(scene: Scene) -> None:
    first = BulletRenderer(192, 128, CLEVRER).render(scene, 50).tobytes()
    other = get_renderer(
        {"renderer": "bullet", "width": 192, "height": 128, "world": asdict(CLEVRER)}
    )
    other.render(simulate_scene(0, 1), 3)
    assert other.render(scene, 50).tobytes() == first


def crop(appearance: SceneObject, place: tuple[float, float], yaw: float) -> np.ndarray:
    """Render one object in an empty scene at the tiny preset's frame size, and crop it.

    Returns:
        (H, W, 4) RGB on a black background, and the share of each pixel that the object covers,
        from 0 to 255.
    """
    height = 0.18 if appearance.shape == "cube" else 0.2
    position = np.array([[[*place, height]]], np.float32)
    turn = np.array([[[0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]]], np.float32)
    none = np.zeros((1, 1, 3), np.float32)
    in_view = np.ones((1, 1), bool)
    scene = Scene(
        f"{appearance}{place}{yaw}", "train", (appearance,), (), position, turn, none, none,
        none[..., :2], in_view, in_view.astype(np.float32),
    )  # fmt: skip
    renderer = get_renderer(
        {"renderer": "bullet", "width": 192, "height": 128, "world": asdict(CLEVRER)}
    )
    renderer.pose(scene, 0)
    packed, mask = renderer.capture()
    pixels = packed.view(np.uint8).reshape(*mask.shape, 4)
    is_object = (mask >= 0)[..., None]
    oversampled = np.dstack([pixels[..., :3] * is_object, is_object])
    averaged = oversampled.reshape(128, 2, 192, 2, 4).mean(axis=(1, 3))
    pixels, cover = averaged[..., :3], averaged[..., 3]
    rows, columns = np.nonzero(cover > 0.5)
    box = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
    return np.dstack([pixels[box], 255 * cover[box]])


def features(picture: np.ndarray, attribute: str) -> np.ndarray:
    """Features of a crop that depend on the colour, material or shape."""
    rgb, cover = picture[..., :3], picture[..., 3]
    if attribute == "color":
        return rgb[cover > 250].mean(axis=0) / 255
    brightness = shrink(rgb.max(axis=-1) / rgb.max())
    if attribute == "material":
        return brightness
    aspect_ratio = cover.shape[0] / cover.shape[1]
    return np.concatenate([brightness, shrink(cover / 255), [8 * aspect_ratio]])


def shrink(values: np.ndarray) -> np.ndarray:
    """Resize an image to 16 x 16 and flatten it."""
    return np.asarray(Image.fromarray(values.astype(np.float32)).resize((16, 16))).ravel()


PLACES = [(x, y) for x in (-1.5, -0.5, 0.5) for y in (-0.8, 0.1, 0.9)]


@pytest.fixture(scope="module")
def crops() -> list[tuple[int, SceneObject, np.ndarray]]:
    """Crops of every appearance at every position, with a random yaw."""
    rng = np.random.default_rng(0)
    appearances = [SceneObject(s, m, c) for s in SHAPES for m in MATERIALS for c in COLORS]
    return [
        (k, each, crop(each, place, rng.uniform(0, 6.28)))
        for each in appearances
        for k, place in enumerate(PLACES)
    ]


@pytest.mark.parametrize("attribute", ["color", "material", "shape"])
def test_appearances_are_distinguishable_at_the_tiny_size(crops, attribute) -> None:
    """A nearest-neighbour classifier recognises an attribute at positions that it was not fitted
    on."""
    groups = defaultdict(list)
    for place, appearance, picture in crops:
        # Objects of different materials are compared only if their shape and colour are equal.
        group = (appearance.shape, appearance.color) if attribute == "material" else ()
        name, vector = getattr(appearance, attribute), features(picture, attribute)
        groups[group].append((place % 2 == 0, name, vector))
    right = []
    for rows in groups.values():
        known, names, vectors = map(np.array, zip(*rows, strict=True))
        classifier = KNeighborsClassifier(1).fit(vectors[known], names[known])
        right += list(classifier.predict(vectors[~known]) == names[~known])
    assert np.mean(right) >= 0.95
