"""Measures the time and memory of ranking the frames of a large database for queries.

    python -m benchmarks.speed.retrieval

Computes the exact ranks of 256 queries over 1,000,000 frames at all seven widths up to 4,096. The
script first writes the embeddings of the frames to cache files (16 GiB), which it deletes at the
end. It prints seconds and peak memory. Time is linear in the number of queries; memory grows by 100
KiB per query. `benchmarks.speed.growth rank` ranks smaller databases, in memory.

Embeddings are random but clustered: those of the 128 frames of a scene lie around one point, and
that of a query lies near its target. OMP_NUM_THREADS=1 restricts the script to one thread.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.arguments import positive_int
from dynapix.conf.failures import report_failures
from dynapix.data.records import FRAMES as SCENE
from dynapix.evaluation.embedders.cache import EmbeddingCache
from dynapix.evaluation.retrieval.exact_search import Ranks, exact_ranks

WIDTHS = (4096, 2048, 1024, 512, 256, 128, 64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--queries", type=positive_int, default=256)
    parser.add_argument("--frames", type=positive_int, default=1_000_000)
    parser.add_argument("--folder", help="where to write the cache files, by default /tmp")
    args = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    print(f"{cores} core(s), OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', 'unset')}")
    print(f"{args.queries:,} queries, {args.frames:,} frames, widths {WIDTHS}")
    queries, targets = embed_queries(args.frames, args.queries)
    names = [f"{frame // SCENE:06d}/{frame % SCENE}" for frame in range(args.frames)]
    with tempfile.TemporaryDirectory(prefix="retrieval-", dir=args.folder) as folder:
        needed, free = 4.2 * args.frames * WIDTHS[0], shutil.disk_usage(folder).free
        if free < needed:
            sizes = f"{needed / 2**30:.0f} GiB are needed and {free / 2**30:.0f} free"
            raise SystemExit(f"error: {sizes}: name another --folder")
        cache = EmbeddingCache(Path(folder), "frame", {"weights": "random", "entries": WIDTHS[0]})
        frames = dict(zip(names, range(args.frames), strict=True))
        writing, _ = timed(lambda: cache.complete(frames, embed_frames, SCENE))

        def rank() -> Ranks:
            gold = cache.rows([names[k] for k in targets])
            return exact_ranks(queries, gold, cache.parts(names), WIDTHS)

        ranking, ranks = timed(rank)
    print(f"written in {writing:.0f} s, ranked in {ranking:.1f} s")
    print_ranks(ranks)


def embed_frames(frames: range | list[int]) -> np.ndarray:
    """Return embeddings (frames, entries). That of a frame does not depend on the other frames."""
    rows = np.empty((len(frames), WIDTHS[0]), np.float32)
    for k, frame in enumerate(frames):
        if k == 0 or frame // SCENE != frames[k - 1] // SCENE:
            center = random_vector(0, frame // SCENE)
        rows[k] = center + 0.5 * random_vector(1, frame)
    return rows


def random_vector(*seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(WIDTHS[0], np.float32)


def embed_queries(frames: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the embeddings of `count` queries, and the indices of their targets among `frames`
    frames."""
    rng = np.random.default_rng(2)
    targets = np.sort(rng.choice(frames, count, replace=count > frames))
    rows = embed_frames(targets.tolist())
    return rows + 2 * rng.standard_normal(rows.shape, np.float32), targets


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Call a function, and return the duration (s) and the result."""
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def print_ranks(ranks: Ranks) -> None:
    """Print the peak memory, and the shares of queries whose target is first, or ties, by width."""
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
    for k, width in enumerate(ranks.widths):
        first = (ranks.found & (ranks.above[k] == 0)).mean()
        print(f"  width {width}: target first {first:.1%}, tied {(ranks.tied[k] > 0).mean():.1%}")


if __name__ == "__main__":
    with report_failures():
        main()
