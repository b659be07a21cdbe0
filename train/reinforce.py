"""Train a student further by reinforcement learning (GRPO), with rewards from the oracle.

The rewards depend on the answer, on the claims that the oracle supports or contradicts, and on the
form of the response.
"""

from __future__ import annotations

from pathlib import Path

from dynapix.conf.entry import Run, command
from dynapix.conf.gpus import restrict_to_one_gpu
from dynapix.conf.runs import read_finished_metrics
from dynapix.conf.schema import ReinforceCommand


@command("train.reinforce", ReinforceCommand, ranks=True)
def main(cfg: ReinforceCommand, run: Run) -> dict[str, float]:
    if (metrics := read_finished_metrics(run)) is not None:
        return metrics
    restrict_to_one_gpu()

    from dynapix.data.build import ensure_benchmark
    from dynapix.models import compat, distributed
    from dynapix.models.fingerprints import weights_digest
    from dynapix.models.resolved_settings import data_digest
    from dynapix.models.trained_runs import product_folder
    from dynapix.train.common.training_loop import check_trackers, newest_checkpoint
    from dynapix.train.on_policy.continuation import (
        inherit_settings,
        load_source,
        read_source_settings,
        resolve_continuation,
        train_and_save,
    )
    from dynapix.train.on_policy.judged_items import load_items
    from dynapix.train.on_policy.reinforcement import build_trainer

    check_trackers(cfg.train.report_to)
    compat.keep_freed_memory()
    source, trained = read_source_settings(cfg.model)
    cfg = inherit_settings(cfg, trained)
    train, responses = cfg.train, "train.batch x train.responses"
    distributed.split_batch(train.batch * train.responses, train.micro_batch, key=responses)

    # The main rank builds what is missing; then every rank reads it from the disk.
    with distributed.main_first():
        checkpoint = newest_checkpoint(run.folder)
        store = ensure_benchmark(trained.benchmark, Path(cfg.store), cfg.workers)
    training, validation = load_items(cfg.train, trained, store, cfg.seed)
    ids = [judged.item.item_id for judged in training]
    weights = weights_digest(product_folder(source, "student"))
    cfg, trained = resolve_continuation(
        cfg, run, trained, data_digest(store.identity, [*ids, weights])
    )

    precision = cfg.train.precision
    model, processor = load_source(source, trained, precision)
    trainer = build_trainer(
        cfg, run, trained.student, model, processor, training, validation, checkpoint
    )
    last_resort = "train.batch or train.responses"
    return train_and_save(trainer, processor, run, checkpoint, trained, last_resort)


if __name__ == "__main__":
    main()
