"""Save the logs of harnesses as results that `python -m evaluation.report` shows."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from pathlib import Path

from dynapix.benchmark import Benchmark, load
from dynapix.conf.errors import UserError
from dynapix.conf.files import expand_path
from dynapix.conf.schema.benchmark import POOLS
from dynapix.data.records import SPLITS
from dynapix.data.store import MANIFEST, hash_file
from dynapix.integrations.logs import read_inspect, read_lmms_eval, read_mteb
from dynapix.retrieval import RetrievalScores
from dynapix.selection import Result

FORMATS = {
    "_predictions.json": ("mteb", lambda path: [*read_mteb(path)[1]], RetrievalScores.from_mteb),
    ".jsonl": ("lmms-eval", lambda path: [*read_lmms_eval(path).responses], Result.from_lmms_eval),
    ".eval": ("inspect", lambda path: [*read_inspect(path).responses], Result.from_inspect),
    ".json": ("inspect", lambda path: [*read_inspect(path).responses], Result.from_inspect),
}
"""For each ending of a log's name: the harness, and functions that read the ids in a log and the
result. The first ending that fits counts."""


def save_log(path: str | Path, store: Path, saved: Path) -> Path:
    """Save the log of a harness in a folder of its own below `saved`, and return the folder.

    Args:
        path: A log of inspect_ai (*.eval, *.json), the samples that lmms-eval logs (*.jsonl), or
            the predictions of MTEB (*_predictions.json).
        store: Folder of the built benchmarks, one of which the log is on.

    Raises:
        UserError: The file is no such log, or no benchmark in `store` has its items.
    """
    file = Path(expand_path(str(path)))
    endings = [ending for ending in FORMATS if file.name.endswith(ending)]
    if not endings or not file.is_file():
        raise UserError(
            f"logs: {file} is no log of a harness: give a file that ends in {', '.join(FORMATS)}",
            code="missing-file",
        )
    harness, read_ids, read = FORMATS[endings[0]]
    result = read(file, find_benchmark(file, read_ids(file), store))
    # Two logs of one model are two results, and a log that is given again is the same result.
    name = f"{harness}-{Path(result.name).name}-{hash_file(file)[:8]}"
    return result.save(saved / name)


def find_benchmark(log: Path, ids: Iterable[str], store: Path) -> Benchmark:
    """Return the only benchmark in a folder that has the items or queries with these ids."""
    found, wanted, refused = [], {*ids}, ""
    if not wanted:
        raise UserError(f"{log} has no responses", code="damaged-file")
    for manifest in sorted(store.glob(f"*/{MANIFEST}")):
        try:
            for split, pool in product(SPLITS, POOLS):
                bench = load(manifest.parent, split, pool=pool)
                items = {i.item_id for i in (*bench.selection, *bench.interventions)}
                if wanted <= items | {query.query_id for query in bench.retrieval}:
                    found.append(bench)
                    break
        except UserError as error:
            # A benchmark of another version, which has other items, or a damaged one.
            refused += f". Not searched: {error}"
    if len(found) == 1:
        return found[0]
    if found:
        raise UserError(
            f"{log} may be on {' or '.join(str(b.store.folder) for b in found)}, which share its "
            "items: save it with Result.from_inspect, Result.from_lmms_eval or "
            "RetrievalScores.from_mteb, which take the benchmark",
            code="different-builds",
        )
    raise UserError(
        f"{log} is on none of the benchmarks in {store}: build its benchmark there, or give their "
        f"folder with store=FOLDER{refused}",
        code="different-builds",
    )
