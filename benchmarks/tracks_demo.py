"""Makes a benchmark from videos that only a tracker has seen, to try `simulator=tracks`.

    python -m benchmarks.tracks_demo --out /tmp/tracks_demo --videos 10 --seconds 10

Draws toys that slide across a table in front of a noisy camera, some of them behind a post, and
writes the videos. A tracker reads the videos alone: the median frame is the background; pixels that
differ from it are classified by hue, and connected pixels of a hue are a detection; detections are
assigned to tracks at constant velocity (Hungarian method). Tracks, names (from hue and how much of
its box a toy fills) and visible fractions (area, as a share of the track's largest areas) are
written as MOTChallenge files and tracks.yaml. Then the benchmark is built, rationales are written
by the built-in narrator, and a contact sheet of items and queries is drawn.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import yaml
from PIL import Image, ImageDraw
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from benchmarks.arguments import positive_int
from dynapix.conf.compose import compose
from dynapix.conf.failures import report_failures
from dynapix.conf.schema import BuildCommand, TeacherConfig
from dynapix.data.build import ensure_benchmark
from dynapix.data.checks.counts import summarize_store
from dynapix.data.publish.contact_sheets import SheetRows, draw_sheet
from dynapix.teacher.narrate import narrate_store

WIDTH, HEIGHT = 480, 320
RATES = (30, 15)
"""Frame rates of the videos, in turn."""
HUES = {"red": 0, "yellow": 40, "green": 85, "cyan": 125, "blue": 165, "purple": 210}
"""Hue of each colour, of 255."""
CHANGE, LEAST_AREA, LEAST_SATURATION = 40, 60, 90
"""Difference from the background (of 255), area (px) and saturation of a detected toy."""
GATE, PATIENCE, LEAST_BOXES = 40.0, 20, 8
"""Maximum distance (px) of a detection from the predicted place of its track, number of frames
after which a lost track ends, and minimum number of boxes of a track that is written."""
BACKGROUND_FRAMES = 60
"""Number of frames whose median is the background."""
NOUNS = {"disc": 0.78, "box": 1.0, "wedge": 0.5}
"""Share of its box that a toy of each shape fills."""
QUOTAS = {
    "time": {"in_1s": (20, 5), "in_2s": (20, 5)},
    "window": dict.fromkeys(("G1_A", "G1_C", "G3_A", "G3_C", "G4_A"), (12, 6)),
}
ON_SHEET = {"in_1s": 1, "in_2s": 1, "G1_C_h24_easy": 1, "G3_A_h24_hard": 1, "G4_A_h24_easy": 1}
"""Number of items of a cell on the contact sheet; of each builder, it has one query."""


@dataclass
class Toy:
    """A toy on the table: its place (px), velocity (px/s) and when it starts (s)."""

    shape: str
    color: str
    radius: float
    place: np.ndarray
    velocity: np.ndarray
    start: float


def sample_toys(rng: np.random.Generator, seconds: int) -> list[Toy]:
    """Return toys that enter from the left or right, a new one about every two seconds."""
    toys = []
    for start in np.arange(-3, seconds, 1.6):
        side = rng.choice([-1, 1])
        place = np.array([WIDTH / 2 - side * (WIDTH / 2 + 30), rng.uniform(50, HEIGHT - 50)])
        velocity = np.array([side * rng.uniform(60, 150), rng.uniform(-45, 45)])
        color, shape = rng.choice([*HUES]), rng.choice([*NOUNS])
        toys.append(Toy(shape, color, rng.uniform(14, 22), place, velocity, start))
    return toys


def move(toys: list[Toy], seconds: float) -> None:
    """Move the toys on; they slow down a little, and bounce off the upper and lower edge."""
    for toy in toys:
        toy.place += seconds * toy.velocity
        toy.velocity *= 1 - 0.05 * seconds
        low, high = toy.radius, HEIGHT - toy.radius
        if not low <= toy.place[1] <= high:
            toy.velocity[1] *= -1
            toy.place[1] = np.clip(toy.place[1], low, high)


def draw_toy(draw: ImageDraw.ImageDraw, toy: Toy, scale: int) -> None:
    (x, y), r = scale * toy.place, scale * toy.radius
    color = tuple(
        Image.new("HSV", (1, 1), (HUES[toy.color], 210, 215)).convert("RGB").getpixel((0, 0))
    )
    box = (x - r, y - r, x + r, y + r)
    if toy.shape == "disc":
        draw.ellipse(box, fill=color)
    elif toy.shape == "box":
        draw.rectangle(box, fill=color)
    else:
        draw.polygon([(x - r, y + r), (x + r, y + r), (x, y - r)], fill=color)


def film(path: Path, rng: np.random.Generator, fps: int, seconds: int) -> None:
    """Write a video of sliding toys, with the camera's noise and a flickering light."""
    toys = sample_toys(rng, seconds)
    grain = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 6)
    table = np.array([150, 135, 115]) + 250 * grain[..., None]
    post = rng.integers(WIDTH // 3, 2 * WIDTH // 3) if rng.random() < 0.6 else None
    clock = -3.0
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        number = 0
        while number < fps * seconds:
            move([toy for toy in toys if toy.start <= clock], 1 / fps)
            clock += 1 / fps
            if clock < 0:
                continue
            big = Image.fromarray(np.clip(table, 0, 255).astype(np.uint8)).resize(
                (2 * WIDTH, 2 * HEIGHT)
            )
            draw = ImageDraw.Draw(big)
            for toy in toys:
                if toy.start <= clock:
                    draw_toy(draw, toy, 2)
            if post is not None:
                draw.rectangle((2 * post, 0, 2 * post + 90, 2 * HEIGHT), fill=(96, 94, 92))
            pixels = np.asarray(big.resize((WIDTH, HEIGHT)), float)
            light = 1 + 0.02 * np.sin(9 * clock)
            noisy = np.clip(light * pixels + rng.normal(scale=5, size=pixels.shape), 0, 255)
            frame = av.VideoFrame.from_ndarray(noisy.astype(np.uint8), format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, fps)
            container.mux(stream.encode(frame))
            number += 1
        container.mux(stream.encode())


@dataclass
class Detection:
    """Connected pixels of a hue: their box (left, top, width, height), area and colour."""

    box: np.ndarray
    area: int
    color: str

    @property
    def centre(self) -> np.ndarray:
        return self.box[:2] + self.box[2:] / 2


@dataclass
class Trail:
    """The detections of a track, by frame."""

    found: dict[int, Detection] = field(default_factory=dict)

    def predict(self, frame: int) -> np.ndarray:
        """Return the place at a frame at constant velocity (px), from the last five frames."""
        last = max(self.found)
        earlier = max((f for f in self.found if f <= last - 4), default=min(self.found))
        here = self.found[last].centre
        step = (here - self.found[earlier].centre) / max(last - earlier, 1)
        return here + step * (frame - last)

    @property
    def color(self) -> str:
        return next(iter(self.found.values())).color


def detect(pixels: np.ndarray, background: np.ndarray) -> list[Detection]:
    """Return the toys in a frame (H, W, 3): connected pixels of a hue that differ from the
    background."""
    hue, saturation, _ = np.moveaxis(np.asarray(Image.fromarray(pixels).convert("HSV"), int), -1, 0)
    changed = np.abs(pixels.astype(int) - background).max(-1) > CHANGE
    changed &= saturation > LEAST_SATURATION
    apart = np.abs(hue[..., None] - np.array([*HUES.values()]))
    nearest = np.minimum(apart, 255 - apart).argmin(-1)
    detections = []
    for index, color in enumerate(HUES):
        mask = ndimage.binary_opening(changed & (nearest == index), iterations=2)
        labels, _ = ndimage.label(mask)
        for number, (rows, columns) in enumerate(ndimage.find_objects(labels), 1):
            area = int((labels[rows, columns] == number).sum())
            if area >= LEAST_AREA:
                left, top = columns.start, rows.start
                box = np.array([left, top, columns.stop - left, rows.stop - top], float)
                detections.append(Detection(box, area, color))
    return detections


def track(path: Path) -> list[Trail]:
    """Return the tracks of a video's toys."""
    with av.open(str(path)) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    sample = np.linspace(0, len(frames) - 1, BACKGROUND_FRAMES).astype(int)
    background = np.median([frames[k] for k in sample], axis=0)
    ended: list[Trail] = []
    active: list[Trail] = []
    for number, pixels in enumerate(frames):
        ended += [t for t in active if number - max(t.found) > PATIENCE]
        active = [t for t in active if number - max(t.found) <= PATIENCE]
        detections = detect(pixels, background)
        cost = np.full((len(active), len(detections)), 1e6)
        for i, trail in enumerate(active):
            for j, found in enumerate(detections):
                distance = np.linalg.norm(trail.predict(number) - found.centre)
                if found.color == trail.color and distance < GATE:
                    cost[i, j] = distance
        pairs = [
            (i, j) for i, j in zip(*linear_sum_assignment(cost), strict=True) if cost[i, j] < GATE
        ]
        for i, j in pairs:
            active[i].found[number] = detections[j]
        matched = {j for _, j in pairs}
        active += [Trail({number: d}) for j, d in enumerate(detections) if j not in matched]
    return [t for t in ended + active if len(t.found) >= LEAST_BOXES]


def write_tracks(path: Path, trails: list[Trail]) -> dict[int, dict[str, str]]:
    """Write a video's tracks, and return their names by id."""
    lines, names = [], {}
    for key, trail in enumerate(trails, 1):
        found = trail.found.values()
        whole = np.percentile([d.area for d in found], 90)
        fill = np.percentile([d.area / d.box[2:].prod() for d in found], 50)
        noun = min(NOUNS, key=lambda name: abs(NOUNS[name] - fill))
        names[key] = {"noun": noun, "color": trail.color}
        for number, d in trail.found.items():
            box = ",".join(f"{value:.1f}" for value in d.box)
            visibility = min(d.area / whole, 1)
            lines.append((number, f"{number + 1},{key},{box},1,1,{visibility:.2f}"))
    path.write_text("".join(f"{line}\n" for _, line in sorted(lines)))
    return names


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="a new folder")
    parser.add_argument("--videos", type=positive_int, default=10)
    parser.add_argument("--seconds", type=positive_int, default=10)
    options = parser.parse_args()
    folder = options.out / "videos"
    folder.mkdir(parents=True)
    names = {}
    for k in range(options.videos):
        path = folder / f"table{k:02d}.mp4"
        film(path, np.random.default_rng(k), RATES[k % len(RATES)], options.seconds)
        trails = track(path)
        names[path.stem] = {"objects": write_tracks(path.with_suffix(".txt"), trails)}
        print(f"{path.name}: {len(trails)} tracks, {sum(len(t.found) for t in trails)} boxes")
    (folder / "tracks.yaml").write_text(yaml.safe_dump({"videos": names}, sort_keys=False))
    quotas = [
        f"benchmark.selection.{family}.{cell}={{train: {train}, test: {test}}}"
        for family, cells in QUOTAS.items()
        for cell, (train, test) in cells.items()
    ]
    quotas += [f"benchmark.retrieval.builders.{b}={{train: 20, test: 5}}" for b in (1, 2)]
    overrides = ["benchmark=tracks", f"benchmark.folder={folder}", *quotas]
    sizes = ["benchmark.retrieval.database=200", "benchmark.retrieval.source=400"]
    cfg = compose("data.build", BuildCommand, [*overrides, *sizes]).benchmark
    store = ensure_benchmark(cfg, options.out / "store", workers=2)
    print(summarize_store(store))
    print(narrate_store(store, TeacherConfig(name="template")))
    rows, shown = SheetRows(store), []
    for cell, count in ON_SHEET.items():
        shown += [item for item in store.selection() if item.subtype == cell][:count]
    for builder in (1, 2):
        shown += [query for query in store.retrieval() if query.builder == builder][:1]
    sheet = options.out / "sheet.png"
    sheet.write_bytes(draw_sheet([rows.make(record) for record in shown]))
    print(f"contact sheet: {sheet}")


if __name__ == "__main__":
    with report_failures():
        main()
