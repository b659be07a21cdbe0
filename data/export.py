"""Export a benchmark as a Hugging Face dataset, or its scenes in CLEVRER's layout."""

from __future__ import annotations

import logging
from pathlib import Path

from conf.entry import Run, command
from conf.runs import write_text
from conf.schema import ExportCommand
from data.parallel import Workers

log = logging.getLogger(__name__)


@command("data.export", ExportCommand)
def main(cfg: ExportCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    if cfg.format == "clevrer":
        from data.publish.clevrer_format import export_clevrer

        scenes = export_clevrer(store, Path(cfg.folder), Workers(cfg.workers))
        log.info("%s holds %d scenes in CLEVRER's layout", cfg.folder, scenes)
        return {"scenes": float(scenes)}
    from data.publish.huggingface import ensure_export, summarize

    shards = ensure_export(store, Path(cfg.folder), cfg.images)
    summary = summarize(Path(cfg.folder), shards)
    log.info("%s", summary)
    write_text(run.folder / "report.txt", summary + "\n")
    rows = {f"rows/{s.configuration}/{s.split}": 0.0 for s in shards}
    for shard in shards:
        rows[f"rows/{shard.configuration}/{shard.split}"] += shard.rows
    return rows | {"bytes": float(sum(s.bytes for s in shards))}


if __name__ == "__main__":
    main()
