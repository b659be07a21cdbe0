"""Evaluate the embeddings of a model on retrieval queries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from dynapix.benchmark import Benchmark, Query, refuse_repeated
from dynapix.conf.errors import UserError
from dynapix.conf.files import expand_path, write_json, write_text
from dynapix.evaluation.metrics.ranking import share_above, to_array
from dynapix.evaluation.metrics.results import RetrievalReport, RetrievalResult, retrieval_results
from dynapix.evaluation.retrieval.exact_search import Ranks, exact_ranks, write_ranks
from dynapix.integrations.logs import read_mteb
from dynapix.saved_runs import saved_run

Embeddings = np.ndarray | Mapping[str, Sequence[float]]
"""An array with a row for each query or frame, or vectors by `Query.query_id` or `Frame.name`."""


@dataclass(frozen=True, repr=False)
class RetrievalScores:
    """The result of `evaluate_retrieval`. Printing it shows the table of
    `python -m evaluation.retrieve`.

    Attributes:
        rows: The measures with 95% intervals over scenes: over all queries at each width, widest
            first, then for each builder.
        ranks: The number of frames above each query's target, and tied with it, at each width.
        name, benchmark, queries, seed: What was evaluated, and the seed of the intervals.
    """

    rows: list[RetrievalResult]
    ranks: Ranks
    name: str
    benchmark: Benchmark
    queries: list[Query]
    seed: int

    @property
    def metrics(self) -> dict[str, float]:
        """`recall@k`, `mrr`, `median_rank` and `tie_rate` over all queries, at the widest width. In
        the counterfactual pool also `twin_above`, the share of queries for which the factual
        scene's frame at the target's moment ranks above the target."""
        return {name: measure.value for name, measure in self.rows[0].measures.items()}

    def __str__(self) -> str:
        from dynapix.evaluation.reporting.tables import retrieval_table

        return str(retrieval_table(self.rows))

    def __repr__(self) -> str:
        return f"<RetrievalScores {self.metrics}>"

    def save(self, folder: str | Path) -> Path:
        """Write the result as a run, and return its folder.

        `python -m evaluation.report` shows the results in the folder runs/ beside other runs.

        Raises:
            UserError: The folder exists and contains something else.
        """
        folder = Path(expand_path(str(folder)))
        store = self.benchmark.store
        with saved_run(folder, store, "retrieve", self.name, self.seed, self.metrics):
            write_ranks(folder, {self.name: self.ranks}, [q.record for q in self.queries])
            write_json(folder / "report.json", asdict(RetrievalReport(store.identity, self.rows)))
            write_text(folder / "report.txt", f"{self}\n")
        return folder

    @classmethod
    def from_mteb(cls, path: str | Path, benchmark: Benchmark, seed: int = 0) -> RetrievalScores:
        """Read the predictions that MTEB saves of `dynapix.integrations.mteb_task.RetrievalTask`
        with `prediction_folder`.

        Args:
            benchmark: The benchmark of the task.

        Raises:
            UserError: The file does not contain such predictions, or these are of other queries or
                frames than those of `benchmark`.
        """
        file = Path(expand_path(str(path)))
        name, found = read_mteb(file)
        queries, frames = list(benchmark.retrieval), [f.name for f in benchmark.database]
        try:
            scores = np.array([[found[q.query_id][f] for f in frames] for q in queries])
        except KeyError as error:
            raise UserError(
                f"{file} lacks the scores of {error}: it is of another benchmark than "
                f"{benchmark.store.folder}, or of a part of it",
                code="different-builds",
            ) from error
        index = {frame: k for k, frame in enumerate(frames)}

        def choose(names: list[str]) -> np.ndarray:
            return scores[np.arange(len(queries)), [index[n] for n in names]][:, None]

        targets = choose([q.target.name for q in queries])
        above, tied = (scores > targets).sum(1)[None], (scores == targets).sum(1)[None] - 1
        twins = [t.name for q in queries if (t := q.record.factual_twin)]
        twin_above = share_above(choose(twins), targets).T if twins else None
        found = np.ones(len(queries), bool)
        ranks = Ranks((None,), above, tied, found, len(frames), twin_above=twin_above)
        rows = retrieval_results(benchmark.name, name, ranks, [q.record for q in queries], seed)
        return cls(rows, ranks, name, benchmark, queries, seed)


def evaluate_retrieval(
    queries: Sequence[Query],
    query_embeddings: Embeddings,
    frame_embeddings: Embeddings,
    *,
    widths: Sequence[int] | None = None,
    name: str = "model",
    seed: int = 0,
) -> RetrievalScores:
    """Rank every frame of the database for each query by cosine similarity.

    If frames tie with the target, each measure is its mean over all orders of the tied frames.

    Args:
        queries: `Benchmark.retrieval`, or some of its queries.
        query_embeddings: (queries, width), in the order of `queries`, or vectors by query id.
        frame_embeddings: (frames, width), in the order of `Benchmark.database`, or vectors by the
            name of the frame.
        widths: The Matryoshka widths to rank at; None ranks at the width of the embeddings.
        name: The model's name in tables.
        seed: Seed of the bootstrap over scenes.

    Raises:
        UserError: There are no queries, a query occurs twice, or the embeddings have another
            shape, are not finite, or are not those of the queries and of the database.
    """
    queries = list(queries)
    if not queries:
        raise UserError("there are no queries to evaluate", code="no-items")
    refuse_repeated([query.query_id for query in queries], "query")
    benchmark: Benchmark = queries[0]._benchmark
    names = [frame.name for frame in benchmark.database]
    query_rows = _rows(query_embeddings, [q.query_id for q in queries], "query")
    frame_rows = _rows(frame_embeddings, names, "frame")
    width = query_rows.shape[1]
    if width != frame_rows.shape[1]:
        raise UserError(
            f"query embeddings have the width {width}, and frame embeddings "
            f"{frame_rows.shape[1]}: embed both with one model",
            code="invalid-embeddings",
        )
    ranked_widths = sorted(set(widths or [width]), reverse=True)
    if ranked_widths[-1] < 1 or ranked_widths[0] > width:
        raise UserError(
            f"widths={list(widths or [])}: give widths from 1 to {width}", code="invalid-setting"
        )
    index = {frame: k for k, frame in enumerate(names)}
    if missing := [q.target.name for q in queries if q.target.name not in index]:
        raise UserError(
            f"the database lacks {len(missing)} targets, such as {missing[0]}: evaluate "
            "Benchmark.retrieval of the test split",
            code="missing-targets",
        )
    targets = frame_rows[[index[q.target.name] for q in queries]]
    records = [q.record for q in queries]
    twins = [index[r.factual_twin.name] for r in records if r.factual_twin]
    twin_rows = frame_rows[twins] if twins else None
    ranks = exact_ranks(query_rows, targets, [frame_rows], ranked_widths, twin_rows)
    rows = retrieval_results(benchmark.name, name, ranks, records, seed)
    return RetrievalScores(rows, ranks, name, benchmark, queries, seed)


def _rows(embeddings: Embeddings, names: Sequence[str], kind: str) -> np.ndarray:
    """Return the embeddings as finite fp32 rows in the order of `names`."""
    if isinstance(embeddings, Mapping):
        if missing := [name for name in names if name not in embeddings]:
            raise UserError(
                f"{len(missing)} of {len(names)} {kind} embeddings are missing, such as that of "
                f"{missing[0]}: embed the queries and the database of this benchmark",
                code="invalid-embeddings",
            )
        embeddings = [embeddings[name] for name in names]
    try:
        rows = to_array(embeddings, np.float32)
    except (OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise UserError(
            f"{kind} embeddings are not an array of numbers: {error}", code="invalid-embeddings"
        ) from error
    if rows.ndim != 2 or len(rows) != len(names) or not rows.shape[1]:
        expected = "queries" if kind == "query" else "frames of the database"
        raise UserError(
            f"{kind} embeddings have the shape {rows.shape}: give one row for each of the "
            f"{len(names)} {expected}",
            code="invalid-embeddings",
        )
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        raise UserError(
            f"{int((~finite).sum())} {kind} embeddings have NaN or infinite entries, such as that "
            f"of {names[int(np.argmin(finite))]}: embed these again, in fp32 if they overflow",
            code="invalid-embeddings",
        )
    return rows
