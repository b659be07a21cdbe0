"""Export benchmarks as a Hugging Face dataset, as rows for other trainers, or as an archive."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from dynapix.conf.compose import compose
from dynapix.conf.entry import Run, command
from dynapix.conf.files import write_text
from dynapix.conf.schema import BuildCommand, ExportCommand

if TYPE_CHECKING:
    from dynapix.data.publish.folders import Shard

log = logging.getLogger(__name__)


@command("data.export", ExportCommand)
def main(cfg: ExportCommand, run: Run) -> dict[str, float]:
    from dynapix.data.publish.hub import push_folder
    from dynapix.data.publish.huggingface import summarize

    if cfg.archive is not None:
        return export_archive(cfg)
    shards = export_dataset(cfg) if cfg.format == "dataset" else export_rows(cfg)
    summary = summarize(shards)
    text = f"{cfg.folder}\n{summary.to_string(float_format='{:,.1f}'.format)}"
    log.info("%s", text)
    write_text(run.folder / "report.txt", text + "\n")
    if cfg.push is not None:
        log.info("uploaded: %s", push_folder(Path(cfg.folder), cfg.push))
    metrics = {f"rows/{'/'.join(name)}": float(count) for name, count in summary["rows"].items()}
    return metrics | {"bytes": float(sum(shard["bytes"] for shard in shards))}


def export_dataset(cfg: ExportCommand) -> list[Shard]:
    """Write the tables of all benchmarks."""
    from dynapix.data.build import ensure_benchmark, ensure_items
    from dynapix.data.parallel import Workers
    from dynapix.data.publish.huggingface import ensure_export

    root, benchmarks = Path(cfg.store), {cfg.benchmark.name: cfg.benchmark}
    for name in cfg.also:
        benchmarks[name] = compose("data.build", BuildCommand, [f"benchmark={name}"]).benchmark
    stores = {
        name: ensure_benchmark(benchmark, root, cfg.workers)
        if cfg.images
        else ensure_items(benchmark, root, Workers(cfg.workers))
        for name, benchmark in benchmarks.items()
    }
    return ensure_export(stores, Path(cfg.folder), cfg.images)


def export_archive(cfg: ExportCommand) -> dict[str, float]:
    """Write a built benchmark as one file."""
    from dynapix.data.build import ensure_benchmark
    from dynapix.data.publish.archive import write_archive

    path = Path(cfg.archive)
    write_archive(ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers), path)
    log.info("%s", path)
    return {"bytes": float(path.stat().st_size)}


def export_rows(cfg: ExportCommand) -> list[Shard]:
    """Write the training samples of a benchmark."""
    from dynapix.data.build import ensure_benchmark
    from dynapix.train.common.training_rows import ensure_rows

    return ensure_rows(cfg, ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers))


if __name__ == "__main__":
    main()
