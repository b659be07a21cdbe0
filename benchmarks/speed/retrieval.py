"""The time and memory of ranking a database, beside one matrix product and beside faiss.

    python -m benchmarks.speed.retrieval ranks
    python -m benchmarks.speed.retrieval large
    python -m benchmarks.speed.retrieval index

`ranks` computes the exact ranks of 2,002 queries over 10,000 frames at all seven widths up to
4,096, alternating with one fp32 product of the same two tables; medians of the rounds.

`large` ranks 256 queries over 1,000,000 frames in cache files, which it writes first (16 GiB,
deleted at the end): seconds and the peak of resident memory. Time is linear in the queries; memory
grows by 100 KiB a query.

`index` (extra `index`) compares faiss with exact ranks over 100,000 frames: recall, size, seconds.

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
from collections.abc import Callable
from pathlib import Path

import numpy as np

from conf.errors import UserError
from data.records import FRAMES as SCENE
from evaluation.embedders.cache import EmbeddingCache
from evaluation.retrieval.exact_search import Ranks, exact_ranks
from evaluation.retrieval.faiss_index import approximate_ranks, import_faiss

WIDTHS = (4096, 2048, 1024, 512, 256, 128, 64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(required=True)
    for name, queries, frames, widths, measure in (
        ("ranks", 2_002, 10_000, WIDTHS, measure_ranks),
        ("large", 256, 1_000_000, WIDTHS, measure_large),
        ("index", 512, 100_000, (4096, 256), measure_index),
    ):
        command = commands.add_parser(name)
        command.add_argument("--queries", type=int, default=queries)
        command.add_argument("--frames", type=int, default=frames)
        command.add_argument("--widths", type=int, nargs="+", default=widths, help="widest first")
        command.add_argument("--rounds", type=int, default=3)
        command.add_argument("--probes", type=int, default=16)
        command.add_argument("--folder", help="where embeddings are written; a new one below /tmp")
        command.set_defaults(measure=measure)
    args = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    print(f"{cores} core(s), OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', 'unset')}")
    args.measure(args)


def measure_ranks(args: argparse.Namespace) -> None:
    database = vectors(range(args.frames), args.widths[0])
    asked, targets = queries_near(args)
    gold = database[targets]
    rounds = []
    for _ in range(args.rounds + 1):
        bare, _ = timed(lambda: asked @ database.T)
        ours, ranks = timed(lambda: exact_ranks(asked, gold, [database], args.widths))
        rounds.append((bare, ours, ours / bare))
    # The first round warms caches and is not counted.
    bare, ours, ratio = map(statistics.median, zip(*rounds[1:], strict=True))
    print(f"{args.queries:,} queries, {args.frames:,} frames, widths {args.widths}")
    print(f"one fp32 product {bare:.2f} s, ranks at all widths {ours:.2f} s, {ratio:.2f} times it")
    print_ranks(ranks)


def measure_large(args: argparse.Namespace) -> None:
    folder = new_folder(args)
    try:
        writing, shown = timed(lambda: write_embeddings(folder, args))
        asked, targets = queries_near(args)
        gold = shown.rows([name(k) for k in targets])
        names = [name(k) for k in range(args.frames)]
        parts = (rows for _, rows in shown.parts(names))
        opening, _ = timed(lambda: write_embeddings(folder, args))
        ranking, ranks = timed(lambda: exact_ranks(asked, gold, parts, args.widths))
    finally:
        shutil.rmtree(folder)
    print(f"{args.queries:,} queries, {args.frames:,} frames, widths {args.widths}")
    print(f"written in {writing:.0f} s, checked in {opening:.1f} s, ranked in {ranking:.1f} s")
    print(f"peak of resident memory {peak():.2f} GiB")
    print_ranks(ranks)


def measure_index(args: argparse.Namespace) -> None:
    import_faiss()
    folder = new_folder(args)
    try:
        shown = write_embeddings(folder, args)
        names = [name(k) for k in range(args.frames)]
        asked, targets = queries_near(args)
        golds = [name(k) for k in targets]
        parts = (rows for _, rows in shown.parts(names))
        exact, _ = timed(lambda: exact_ranks(asked, shown.rows(golds), parts, args.widths))
        ask = (asked, golds, shown, names, args.widths, args.probes, 0)
        first, (ranks, told) = timed(lambda: approximate_ranks(*ask))
        again, _ = timed(lambda: approximate_ranks(*ask))
    finally:
        shutil.rmtree(folder)
    print(f"{args.queries:,} queries, {args.frames:,} frames, {args.probes} probes")
    print(f"exact ranks {exact:.1f} s; faiss, with its comparison to exact: {first:.1f} s when the")
    print(f"indexes are built, {again:.1f} s from then on; peak {peak():.2f} GiB")
    for t in told:
        recalls = ", ".join(f"{key} {t[key]:.3f}" for key in t if key.startswith("recall"))
        print(f"width {t['width']}: {recalls}; {t['bytes'] / 2**20:.0f} MiB, {t['seconds']:.2f} s")
    print_ranks(ranks)


def write_embeddings(folder: Path, args: argparse.Namespace) -> EmbeddingCache:
    """Write random embeddings in the files of the embedding cache, and open them."""
    shown = EmbeddingCache(folder, "frame", {"weights": "random", "entries": args.widths[0]})
    frames = {name(k): k for k in range(args.frames)}
    shown.complete(frames, lambda part: vectors(part, args.widths[0]), SCENE)
    return shown


def new_folder(args: argparse.Namespace) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="retrieval-", dir=args.folder))
    needed, free = 4.2 * args.frames * args.widths[0], shutil.disk_usage(folder).free
    if free < needed:
        folder.rmdir()
        raise UserError(
            f"{needed / 2**30:.0f} GiB are needed and {free / 2**30:.0f} free: --folder"
        )
    return folder


def name(frame: int) -> str:
    return f"{frame // SCENE:06d}/{frame % SCENE}"


def vectors(frames: range | list[int], entries: int) -> np.ndarray:
    """(frames, entries) embeddings; a frame's row does not depend on the other frames."""
    rows = np.empty((len(frames), entries), np.float32)
    places: dict[int, np.ndarray] = {}
    for k, frame in enumerate(frames):
        scene = frame // SCENE
        if scene not in places:
            places = {scene: np.random.default_rng((0, scene)).standard_normal(entries, np.float32)}
        noise = np.random.default_rng((1, frame)).standard_normal(entries, np.float32)
        rows[k] = places[scene] + 0.5 * noise
    return rows


def queries_near(args: argparse.Namespace) -> tuple[np.ndarray, np.ndarray]:
    """Query embeddings, and the indices of their target frames."""
    rng = np.random.default_rng(2)
    targets = np.sort(rng.choice(args.frames, args.queries, replace=args.queries > args.frames))
    near = vectors(targets.tolist(), args.widths[0])
    return near + 2 * rng.standard_normal(near.shape, np.float32), targets


def timed(work: Callable) -> tuple[float, object]:
    start = time.perf_counter()
    made = work()
    return time.perf_counter() - start, made


def peak() -> float:
    """The peak of resident memory of this process so far, in GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def print_ranks(ranks: Ranks) -> None:
    """Print how often the target is first, as a check that the ranks are not random."""
    for k, width in enumerate(ranks.widths):
        first = (ranks.found[k] & (ranks.greater[k] == 0)).mean()
        print(f"  width {width}: target first {first:.1%}, tied {(ranks.tied[k] > 0).mean():.1%}")


if __name__ == "__main__":
    main()
