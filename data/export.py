"""Export a benchmark as a Hugging Face dataset."""

from __future__ import annotations

import logging
from pathlib import Path

from conf.entry import Run, command
from conf.files import write_text
from conf.schema import ExportCommand

log = logging.getLogger(__name__)


@command("data.export", ExportCommand)
def main(cfg: ExportCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark, ensure_items
    from data.parallel import Workers
    from data.publish.huggingface import ensure_export, summarize

    root = Path(cfg.store)
    if cfg.images:
        store = ensure_benchmark(cfg.benchmark, root, cfg.workers)
    else:
        store = ensure_items(cfg.benchmark, root, Workers(cfg.workers))
    shards = ensure_export(store, Path(cfg.folder), cfg.images)
    summary = summarize(shards)
    text = f"{cfg.folder}\n{summary.to_string(float_format='{:,.1f}'.format)}"
    log.info("%s", text)
    write_text(run.folder / "report.txt", text + "\n")
    rows = {f"rows/{'/'.join(name)}": float(count) for name, count in summary["rows"].items()}
    return rows | {"bytes": float(sum(shard["bytes"] for shard in shards))}


if __name__ == "__main__":
    main()
