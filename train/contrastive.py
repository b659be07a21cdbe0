"""Train a retriever with a ranking loss: each query's target must score above its hard negatives
and the frames of the other queries in its batch, at every width of the embeddings (Matryoshka)."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from dynapix.conf.entry import command
from dynapix.conf.errors import UserError
from dynapix.conf.gpus import restrict_to_one_gpu
from dynapix.conf.runs import Run, rank, read_finished_metrics
from dynapix.conf.schema import ContrastiveCommand

log = logging.getLogger(__name__)


@command("train.contrastive", ContrastiveCommand, ranks=True)
def main(cfg: ContrastiveCommand, run: Run) -> dict[str, float]:
    if (metrics := read_finished_metrics(run)) is not None:
        return metrics
    restrict_to_one_gpu()

    from transformers import set_seed

    from dynapix.data.build import ensure_benchmark
    from dynapix.models.checks import check_available
    from dynapix.models.compat import keep_freed_memory
    from dynapix.models.distributed import is_sharded, main_first, split_batch
    from dynapix.models.layers.fast_layers import use_fast_layers
    from dynapix.models.resolved_settings import data_digest, resolve_run
    from dynapix.models.retriever.embedder import load_retriever, tokenizer_texts
    from dynapix.train.common.journal import run_metrics
    from dynapix.train.common.model_card import write_run_card
    from dynapix.train.common.training_loop import (
        check_trackers,
        explain_load_errors,
        newest_checkpoint,
        run_training,
    )
    from dynapix.train.retriever.batches import read_pools, split_queries
    from dynapix.train.retriever.trainer import build_trainer

    check_trackers(cfg.train.report_to)
    keep_freed_memory()
    if is_sharded():
        raise UserError(
            "a retriever cannot be trained with FSDP, because sentence-transformers evaluates in "
            "torch's inference mode, after which sharded weights cannot be trained: replace "
            "--use_fsdp by --multi_gpu, which works on CPUs too",
            code="unsupported-with-fsdp",
        )
    # Check the batch and the base now, because building the benchmark may take long.
    rank_batch = split_batch(cfg.train.batch)
    if cfg.retriever.model is not None:
        check_available("retriever", cfg.retriever.model)

    # The main rank builds the benchmark if it is missing; then every rank reads it from the disk.
    with main_first():
        checkpoint = newest_checkpoint(run.folder)
        store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    training, validation = split_queries(store, cfg.train, cfg.seed)

    data = data_digest(store.identity, (q.query_id for q in (*training, *validation)))
    with main_first():
        precision, retriever = resolve_run(run.folder, cfg.train.precision, cfg.retriever, data)
    cfg = replace(cfg, retriever=retriever, train=replace(cfg.train, precision=precision))

    log.info("loading retriever %s, computing in %s", retriever.name, precision)
    # Seed the initialisation of the adapters; the trainer sets its seed later.
    set_seed(cfg.seed)
    texts = tokenizer_texts(read_pools(store, cfg.train.pools), retriever)
    with explain_load_errors("retriever"):
        model = load_retriever(retriever, precision, texts, run.folder / "untrained")
    use_fast_layers(model)

    trainer = build_trainer(cfg, run, store, model, training, validation, rank_batch, checkpoint)
    remedy = "lower train.mini_batch, set train.reuse_features=false"
    last_resort = "retriever.image_size or retriever.frames"
    run_training(trainer, run, checkpoint, remedy, last_resort)

    metrics = run_metrics(run.folder)
    if rank() == 0:
        model.save_pretrained(str(run.folder / "retriever"), create_model_card=False)
        write_run_card(run, cfg, metrics)
    log.info("the retriever is in %s", run.folder / "retriever")
    return metrics


if __name__ == "__main__":
    main()
