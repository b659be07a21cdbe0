"""Export benchmarks as a Hugging Face dataset."""

from __future__ import annotations

import logging
from pathlib import Path

from conf.compose import compose
from conf.entry import Run, command
from conf.files import write_text
from conf.schema import BuildCommand, ExportCommand

log = logging.getLogger(__name__)


@command("data.export", ExportCommand)
def main(cfg: ExportCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark, ensure_items
    from data.parallel import Workers
    from data.publish.huggingface import ensure_export, summarize

    root, benchmarks = Path(cfg.store), {cfg.benchmark.name: cfg.benchmark}
    for name in cfg.also:
        benchmarks[name] = compose("data.build", BuildCommand, [f"benchmark={name}"]).benchmark
    stores = {
        name: ensure_benchmark(benchmark, root, cfg.workers)
        if cfg.images
        else ensure_items(benchmark, root, Workers(cfg.workers))
        for name, benchmark in benchmarks.items()
    }
    shards = ensure_export(stores, Path(cfg.folder), cfg.images)
    summary = summarize(shards)
    text = f"{cfg.folder}\n{summary.to_string(float_format='{:,.1f}'.format)}"
    log.info("%s", text)
    write_text(run.folder / "report.txt", text + "\n")
    rows = {f"rows/{'/'.join(name)}": float(count) for name, count in summary["rows"].items()}
    return rows | {"bytes": float(sum(shard["bytes"] for shard in shards))}


if __name__ == "__main__":
    main()
