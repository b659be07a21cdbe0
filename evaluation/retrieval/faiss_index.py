"""Approximate ranks by a faiss index, for databases that take too long to rank exactly.

An index keeps unit vectors in one byte per entry, in about as many lists as the square root of the
database's size; a query searches the nearest few. The loss is measured against exact ranks.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from conf.errors import UserError
from conf.runs import lock_folder
from evaluation.embedders.cache import EmbeddingCache
from evaluation.metrics.results import RECALLS
from evaluation.retrieval.exact_search import GridEmbeddings, Ranks, block_scores, kth_scores

log = logging.getLogger(__name__)

DEPTH = 1000
"""Frames that a query retrieves; a target that is not among them is a miss."""
TRAINING_FRAMES = 40
"""Frames per list that place the lists."""
COMPARED_QUERIES = 200
"""Queries whose exact ranking is compared with the index."""


@dataclass(frozen=True)
class IndexResult:
    """The result of searching an index of one width.

    Attributes:
        frames: (queries, depth) indices of the frames, best first; -1 if there are fewer.
        scores: (queries, depth).
        bytes: Size of the index.
        seconds: Time to search for all queries.
    """

    frames: np.ndarray
    scores: np.ndarray
    bytes: int
    seconds: float


def import_faiss() -> ModuleType:
    """
    Raises:
        UserError: faiss is not installed.
    """
    try:
        import faiss
    except ImportError as error:
        raise UserError(
            "index=faiss needs faiss: pip install -e '.[index]'", code="missing-package"
        ) from error
    return faiss


def approximate_ranks(
    queries: np.ndarray,
    targets: Sequence[str],
    database: EmbeddingCache,
    names: Sequence[str],
    widths: Sequence[int],
    probes: int,
    seed: int,
) -> tuple[Ranks, list[dict[str, float]]]:
    """Rank by an index of each width.

    Args:
        queries: (queries, entries) fp32.
        targets: The name of each query's target.
        names: The names of the database's frames.
        probes: Lists that a query searches.
        seed: Seed of the queries that are also ranked exactly.

    Returns:
        The ranks, and for each index its `width`, `bytes`, `seconds` to search for all queries, and
        `recall@k` against exact ranks.

    Raises:
        UserError: faiss is not installed, or an index is damaged.
    """
    results = [search(database, names, queries, width, probes) for width in widths]
    index_of = {name: k for k, name in enumerate(names)}
    columns = np.array([index_of[target] for target in targets])
    recalls = recall_against_exact(results, queries, database, names, widths, RECALLS, seed)
    summaries = [
        {"width": width, "bytes": result.bytes, "seconds": result.seconds, **recall}
        for width, result, recall in zip(widths, results, recalls, strict=True)
    ]
    return ranks_of_results(results, columns, widths, len(names)), summaries


def search(
    database: EmbeddingCache, names: Sequence[str], queries: np.ndarray, width: int, probes: int
) -> IndexResult:
    """Search an index of `width` for the frames nearest to each query.

    The index is built at the first search and kept beside the embeddings, under a hash of
    everything that it depends on.

    Raises:
        UserError: faiss is not installed, or the index is damaged.
    """
    faiss = import_faiss()
    about = [database.about, list(names), width, faiss.__version__]
    key = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
    folder = database.folder / "index"
    folder.mkdir(exist_ok=True)
    path = folder / f"{key}-{width}.faiss"
    busy = f"{folder} is in use by another process; run this again when it is done"
    with lock_folder(folder, busy):
        if not path.exists():
            log.info("building the index of width %d over %s frames", width, f"{len(names):,}")
            _build(faiss, database, names, width, path)
        try:
            index = faiss.read_index(str(path))
        except RuntimeError as error:
            first = str(error).partition("\n")[0]
            raise UserError(
                f"{path} is damaged ({first}): delete it, and it is built again",
                code="damaged-file",
            ) from error
    index.nprobe = probes
    start = time.perf_counter()
    scores, frames = index.search(_unit(queries[:, :width]), min(DEPTH, len(names)))
    return IndexResult(frames, scores, path.stat().st_size, time.perf_counter() - start)


def _build(
    faiss: ModuleType, database: EmbeddingCache, names: Sequence[str], width: int, path: Path
) -> None:
    lists = max(1, round(math.sqrt(len(names))))
    index = faiss.index_factory(width, f"IVF{lists},SQ8", faiss.METRIC_INNER_PRODUCT)
    # faiss would warn of a small database, which has few frames per list.
    index.cp.min_points_per_centroid = 1
    stride = max(1, len(names) // (TRAINING_FRAMES * lists))
    training = [_unit(rows[::stride, :width]) for _, rows in database.parts(names)]
    index.train(np.concatenate(training))
    for indices, rows in database.parts(names):
        index.add_with_ids(_unit(rows[:, :width]), indices.astype(np.int64))
    partial = path.with_suffix(".partial")
    faiss.write_index(index, str(partial))
    partial.replace(path)


def _unit(rows: np.ndarray) -> np.ndarray:
    """Normalise rows to length 1, fp32; a row of zeros stays zero."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.ascontiguousarray(rows / np.maximum(lengths, 1e-12), np.float32)


def ranks_of_results(
    results: Sequence[IndexResult], targets: np.ndarray, widths: Sequence[int], frames: int
) -> Ranks:
    """Count ranks (widths, queries) among the results of each width, by their own scores.

    Args:
        targets: (queries,) indices of the target frames.
    """
    counts = []
    for result in results:
        is_target = result.frames == targets[:, None]
        own = np.where(is_target, result.scores, -np.inf).max(1, keepdims=True)
        is_frame = result.frames >= 0
        greater = (is_frame & (result.scores > own)).sum(1)
        tied = (is_frame & (result.scores == own)).sum(1) - 1
        found = np.isfinite(own[:, 0])
        counts.append((np.where(found, greater, 0), np.where(found, tied, 0), found))
    greater, tied, found = (np.stack(c) for c in zip(*counts, strict=True))
    sizes, seconds = zip(*((r.bytes, r.seconds) for r in results), strict=True)
    return Ranks(tuple(widths), greater, tied, found, frames, sizes, seconds)


def recall_against_exact(
    results: Sequence[IndexResult],
    queries: np.ndarray,
    database: EmbeddingCache,
    names: Sequence[str],
    widths: Sequence[int],
    ks: Sequence[int],
    seed: int,
) -> list[dict[str, float]]:
    """Return `recall@k` of each width: the share of the exact first k frames among the index's.

    It is measured over at most `COMPARED_QUERIES` random queries. A frame counts if its exact score
    is at least the k-th, so that any of several tied frames is right.
    """
    sample = np.sort(np.random.default_rng(seed).permutation(len(queries))[:COMPARED_QUERIES])
    kth = kth_scores(queries[sample], (rows for _, rows in database.parts(names)), widths, ks)
    retrieved = np.stack([result.frames[sample, : max(ks)] for result in results])
    frames, place = np.unique(retrieved, return_inverse=True)
    rows = database.rows([names[max(frame, 0)] for frame in frames])
    place = place.reshape(retrieved.shape)
    scores = np.empty(retrieved.shape, np.float32)
    grid = GridEmbeddings(queries[sample], widths)
    for query in range(len(sample)):
        for k in range(len(widths)):
            nearest = GridEmbeddings(rows[place[k, query]], widths)
            # Scores come narrowest first, widths are widest first.
            scores[k, query] = list(block_scores(grid[query : query + 1], nearest))[-1 - k][0]
    scores[retrieved < 0] = -np.inf
    recalls = []
    for k in range(len(widths)):
        reached = np.isfinite(scores[k]) & (scores[k][None] >= kth[k][:, :, None])
        recalls.append(
            {
                f"recall@{depth}": float(
                    reached[i, :, :depth].sum(1).mean() / min(depth, len(names))
                )
                for i, depth in enumerate(ks)
            }
        )
    return recalls
