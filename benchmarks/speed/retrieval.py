"""The time and memory of ranking a database, compared with one matrix product.

    python -m benchmarks.speed.retrieval ranks
    python -m benchmarks.speed.retrieval large

`ranks` computes the exact ranks of 2,002 queries over 10,000 frames at all seven widths up to
4,096, alternating with one fp32 product of the same two tables; medians of the rounds.

`large` ranks 256 queries over 1,000,000 frames in cache files, which it writes first (16 GiB,
deleted at the end): seconds and peak memory. Time is linear in the queries; memory grows by 100 KiB
per query.

Embeddings are random but clustered: the 128 frames of a scene lie around one point, and a query
lies near its target. OMP_NUM_THREADS=1 restricts it to one thread.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from data.records import FRAMES as SCENE
from evaluation.embedders.cache import EmbeddingCache
from evaluation.retrieval.exact_search import Ranks, exact_ranks

WIDTHS = (4096, 2048, 1024, 512, 256, 128, 64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(required=True)
    for name, queries, frames, measure in (
        ("ranks", 2_002, 10_000, measure_ranks),
        ("large", 256, 1_000_000, measure_large),
    ):
        command = commands.add_parser(name)
        command.add_argument("--queries", type=int, default=queries)
        command.add_argument("--frames", type=int, default=frames)
        command.add_argument("--widths", type=int, nargs="+", default=WIDTHS, help="widest first")
        command.add_argument("--rounds", type=int, default=3)
        command.add_argument(
            "--folder", help="parent of the folder with the embeddings; by default /tmp"
        )
        command.set_defaults(measure=measure)
    args = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    print(f"{cores} core(s), OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', 'unset')}")
    print(f"{args.queries:,} queries, {args.frames:,} frames, widths {args.widths}")
    args.measure(args)


def measure_ranks(args: argparse.Namespace) -> None:
    database = embed_frames(range(args.frames), args.widths[0])
    queries, targets = embed_queries(args)
    rounds = []
    for _ in range(args.rounds + 1):
        product, _ = timed(lambda: queries @ database.T)
        ranking, ranks = timed(
            lambda: exact_ranks(queries, database[targets], [database], args.widths)
        )
        rounds.append((product, ranking, ranking / product))
    # The first round warms caches and is not counted.
    product, ranking, ratio = map(statistics.median, zip(*rounds[1:], strict=True))
    print(f"one fp32 product {product:.2f} s, ranks {ranking:.2f} s, ratio {ratio:.2f}")
    print_ranks(ranks)


def measure_large(args: argparse.Namespace) -> None:
    queries, targets = embed_queries(args)
    with temporary_folder(args) as folder:
        writing, cache = timed(lambda: write_embeddings(folder, args))
        ranking, ranks = timed(lambda: rank_exactly(cache, queries, targets, args))
    print(f"written in {writing:.0f} s, ranked in {ranking:.1f} s")
    print_ranks(ranks)


def rank_exactly(
    cache: EmbeddingCache, queries: np.ndarray, targets: np.ndarray, args: argparse.Namespace
) -> Ranks:
    """The exact ranks of the targets among the frames of a cache."""
    gold = cache.rows([frame_name(k) for k in targets])
    parts = cache.parts([frame_name(k) for k in range(args.frames)])
    return exact_ranks(queries, gold, parts, args.widths)


def write_embeddings(folder: Path, args: argparse.Namespace) -> EmbeddingCache:
    """Write random embeddings in the files of the embedding cache, and open them."""
    cache = EmbeddingCache(folder, "frame", {"weights": "random", "entries": args.widths[0]})
    frames = {frame_name(k): k for k in range(args.frames)}
    cache.complete(frames, lambda part: embed_frames(part, args.widths[0]), SCENE)
    return cache


@contextmanager
def temporary_folder(args: argparse.Namespace) -> Iterator[Path]:
    """A folder with room for the embeddings, deleted at the end."""
    with tempfile.TemporaryDirectory(prefix="retrieval-", dir=args.folder) as folder:
        needed, free = 4.2 * args.frames * args.widths[0], shutil.disk_usage(folder).free
        if free < needed:
            sizes = f"{needed / 2**30:.0f} GiB are needed and {free / 2**30:.0f} free"
            raise SystemExit(f"error: {sizes}: give another --folder")
        yield Path(folder)


def frame_name(frame: int) -> str:
    return f"{frame // SCENE:06d}/{frame % SCENE}"


def embed_frames(frames: range | list[int], width: int) -> np.ndarray:
    """(frames, width) embeddings; a frame's row does not depend on the other frames."""
    rows = np.empty((len(frames), width), np.float32)
    centers: dict[int, np.ndarray] = {}
    for k, frame in enumerate(frames):
        scene = frame // SCENE
        if scene not in centers:
            centers = {scene: np.random.default_rng((0, scene)).standard_normal(width, np.float32)}
        noise = np.random.default_rng((1, frame)).standard_normal(width, np.float32)
        rows[k] = centers[scene] + 0.5 * noise
    return rows


def embed_queries(args: argparse.Namespace) -> tuple[np.ndarray, np.ndarray]:
    """Query embeddings, and the indices of their target frames."""
    rng = np.random.default_rng(2)
    targets = np.sort(rng.choice(args.frames, args.queries, replace=args.queries > args.frames))
    rows = embed_frames(targets.tolist(), args.widths[0])
    return rows + 2 * rng.standard_normal(rows.shape, np.float32), targets


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """The duration (s) of a call and its result."""
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def print_ranks(ranks: Ranks) -> None:
    """Print the peak memory, and how often the target is first (random ranks: almost never)."""
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
    for k, width in enumerate(ranks.widths):
        first = (ranks.found & (ranks.greater[k] == 0)).mean()
        print(f"  width {width}: target first {first:.1%}, tied {(ranks.tied[k] > 0).mean():.1%}")


if __name__ == "__main__":
    main()
