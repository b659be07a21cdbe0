"""An approximate index of a database's embeddings, by faiss: for databases that take too long to
rank exactly.

Unit vectors are kept in a byte an entry, in about as many lists as the square root of the frames; a
query looks through the nearest few. What that loses is measured, against exact ranks.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np

from conf.errors import UserError
from conf.runs import lock_folder, write_json
from evaluation.embedders.cache import EmbeddingCache
from evaluation.reporting.results import RECALLS
from evaluation.retrieval.exact_search import Cut, Ranks, block_scores, least_of_top

log = logging.getLogger(__name__)

DEPTH = 1000
"""Frames that a query gets; a target that is not among them counts as not found."""
A_LIST = 40
"""Frames a list by which the lists are placed."""
COMPARED = 200
"""Queries whose exact ranking is held against the index."""


@dataclass(frozen=True)
class IndexResult:
    """What an index of one width gave: the frames by number, best first, -1 where it ran out, and
    their scores, both (queries, depth); the index's size and how long it took to ask."""

    frames: np.ndarray
    scores: np.ndarray
    bytes: int
    seconds: float


def import_faiss() -> ModuleType:
    """Raises UserError where faiss is not installed."""
    try:
        import faiss
    except ImportError as error:
        raise UserError("index=faiss needs faiss: pip install -e '.[index]'") from error
    return faiss


def approximate_ranks(
    asked: np.ndarray,
    targets: Sequence[str],
    shown: EmbeddingCache,
    names: Sequence[str],
    widths: Sequence[int],
    probes: int,
    seed: int,
) -> tuple[Ranks, list[dict[str, float]]]:
    """Ranks by an index of each width, and what is to be told of each index: `width`, `bytes`,
    `seconds` to ask for all queries, and its `recall@k` against exact ranks by k.

    Args:
        asked: (queries, entries) fp32.
        targets: the name of each query's target.
        names: of the database's frames.
        probes: lists that a query looks through.
        seed: of the queries that are ranked exactly too.

    Raises:
        UserError: there is no faiss, or an index there is another model's.
    """
    found = [search(shown, names, asked, width, probes) for width in widths]
    number = {name: k for k, name in enumerate(names)}
    golds = np.array([number[target] for target in targets])
    recalls = recall_against_exact(found, asked, shown, names, widths, RECALLS, seed)
    told = [
        {"width": width, "bytes": there.bytes, "seconds": there.seconds, **recall}
        for width, there, recall in zip(widths, found, recalls, strict=True)
    ]
    return ranks_of_found(found, golds, widths, len(names)), told


def search(
    shown: EmbeddingCache, names: Sequence[str], asked: np.ndarray, width: int, probes: int
) -> IndexResult:
    """Ask an index of `width` for the frames nearest to each query, `probes` lists each. The index
    is kept beside the embeddings.

    Args:
        names: of the database's frames; what is found is their numbers.
        asked: (queries, entries) fp32.

    Raises:
        UserError: there is no faiss, or the index there is another model's.
    """
    faiss = import_faiss()
    folder = shown.folder / "index"
    folder.mkdir(exist_ok=True)
    database = hashlib.sha256("\n".join(names).encode()).hexdigest()[:16]
    path = folder / f"{database}-{width}.faiss"
    built_for = {**shown.about, "database": database, "width": width, "faiss": faiss.__version__}
    with lock_folder(
        folder, f"{folder} is in use by another process; run this again when it is done"
    ):
        if not _is_there(path, built_for):
            log.info("building the index of width %d over %s frames", width, f"{len(names):,}")
            # Not kept by a name: read back below, it would be in memory twice.
            parts = partial(_units, shown, names, width)
            _write(faiss, _build(faiss, parts, len(names), width), path, built_for)
        try:
            index = faiss.read_index(str(path))
        except RuntimeError as error:
            first = str(error).partition("\n")[0]
            raise UserError(
                f"{path} is damaged ({first}): delete it; it is then built again"
            ) from error
    index.nprobe = probes
    start = time.perf_counter()
    scores, frames = index.search(_unit(asked[:, :width]), min(DEPTH, len(names)))
    return IndexResult(frames, scores, path.stat().st_size, time.perf_counter() - start)


def _is_there(path: Path, built_for: dict) -> bool:
    """Whether there is an index for this model and database, built by this faiss.

    Raises:
        UserError: there is one for another.
    """
    try:
        there = json.loads(path.with_suffix(".json").read_text())
    except (OSError, ValueError):
        return False
    if not path.exists():
        return False
    if other := [key for key in built_for if there.get(key) != built_for[key]]:
        key = other[0]
        if key == "faiss":
            log.info("%s was built by faiss %s; building it anew", path, there.get(key))
            return False
        raise UserError(
            f"{path} was built for another model or database ({key} is {there.get(key)} there and "
            f"{built_for[key]} here): delete it; one for these is then built"
        )
    return True


def _write(faiss: ModuleType, index, path: Path, built_for: dict) -> None:
    """The note comes last: without it an index is not whole."""
    path.with_suffix(".json").unlink(missing_ok=True)
    faiss.write_index(index, str(path))
    write_json(path.with_suffix(".json"), built_for)


def _build(
    faiss: ModuleType,
    parts: Callable[[], Iterator[tuple[np.ndarray, np.ndarray]]],
    frames: int,
    width: int,
):
    lists = max(1, round(math.sqrt(frames)))
    index = faiss.index_factory(width, f"IVF{lists},SQ8", faiss.METRIC_INNER_PRODUCT)
    # A small database has few frames a list, which faiss would warn of.
    index.cp.min_points_per_centroid = 1
    stride = max(1, frames // (A_LIST * lists))
    index.train(np.concatenate([rows[::stride] for _, rows in parts()]))
    for numbers, rows in parts():
        index.add_with_ids(rows, numbers.astype(np.int64))
    return index


def _units(
    shown: EmbeddingCache, names: Sequence[str], width: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for numbers, rows in shown.parts(names):
        yield numbers, _unit(rows[:, :width])


def _unit(rows: np.ndarray) -> np.ndarray:
    """Rows of unit length, fp32; a row of zeros stays one."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.ascontiguousarray(rows / np.maximum(lengths, 1e-12), np.float32)


def ranks_of_found(
    found: Sequence[IndexResult], targets: np.ndarray, widths: Sequence[int], frames: int
) -> Ranks:
    """Ranks (widths, queries) among what an index of each width gave, by its own scores.

    Args:
        targets: (queries,) numbers of the target frames.
    """
    counts = []
    for there in found:
        own = np.where(there.frames == targets[:, None], there.scores, -np.inf).max(
            1, keepdims=True
        )
        real = there.frames >= 0
        greater = (real & (there.scores > own)).sum(1)
        tied = (real & (there.scores == own)).sum(1) - 1
        hit = np.isfinite(own[:, 0])
        counts.append((np.where(hit, greater, 0), np.where(hit, tied, 0), hit))
    greater, tied, hit = (np.stack(c) for c in zip(*counts, strict=True))
    sizes, seconds = zip(*((there.bytes, there.seconds) for there in found), strict=True)
    return Ranks(tuple(widths), greater, tied, hit, frames, sizes, seconds)


def recall_against_exact(
    found: Sequence[IndexResult],
    asked: np.ndarray,
    shown: EmbeddingCache,
    names: Sequence[str],
    widths: Sequence[int],
    ks: Sequence[int],
    seed: int,
) -> list[dict[str, float]]:
    """What share of the exact first k frames an index gives among its own first k: a dictionary a
    width, `recall@k` by k, over `COMPARED` queries at most, drawn by `seed`.

    A frame counts that scores as high as the exact ranking's k-th: of tied frames any is right.
    """
    some = np.sort(np.random.default_rng(seed).permutation(len(asked))[:COMPARED])
    least = least_of_top(asked[some], (rows for _, rows in shown.parts(names)), widths, ks)
    given = np.stack([there.frames[some, : max(ks)] for there in found])
    numbers, place = np.unique(given, return_inverse=True)
    rows = shown.rows([names[max(number, 0)] for number in numbers])
    place = place.reshape(given.shape)
    scores = np.empty(given.shape, np.float32)
    queries = Cut(asked[some], widths)
    for query in range(len(some)):
        for k in range(len(widths)):
            near = Cut(rows[place[k, query]], widths)
            scores[k, query] = list(block_scores(queries[query : query + 1], near))[-1 - k][0]
    scores[given < 0] = -np.inf
    results = []
    for k in range(len(widths)):
        shares = {}
        for i, depth in enumerate(ks):
            reached = np.isfinite(scores[k]) & (scores[k] >= least[k, i][:, None])
            shares[f"recall@{depth}"] = float(
                reached[:, :depth].sum(1).mean() / min(depth, len(names))
            )
        results.append(shares)
    return results
