"""Train the runs that a file lists, one after another, as a rank of `accelerate launch`."""

from __future__ import annotations

import logging
import os
import pickle
import shutil
import sys
from pathlib import Path
from typing import Any

from accelerate.state import AcceleratorState, PartialState
from accelerate.utils import DistributedType

from dynapix.conf import entry
from dynapix.conf.errors import UserError
from dynapix.conf.failures import report_failures
from dynapix.conf.runs import Run, rank
from dynapix.conf.schema import SftCommand
from dynapix.train import contrastive, sft
from dynapix.train.student import dataset
from dynapix.train.student.trainer import LOSSES

VALIDATION_ITEMS = 3
"""Number of validation items in the settings of the tests; there are more training items."""
build = dataset.supervised_items


def enable_fsdp_on_cpus() -> None:
    """Let accelerate use FSDP on CPUs as on GPUs; torch and gloo support it."""
    init = AcceleratorState.__init__

    def patched(self: AcceleratorState, *args: Any, fsdp_plugin: Any = None, **settings: Any):
        init(self, *args, fsdp_plugin=fsdp_plugin, **settings)
        if fsdp_plugin is not None and self.distributed_type == DistributedType.MULTI_CPU:
            self.fsdp_plugin = fsdp_plugin
            self.distributed_type = DistributedType.FSDP
            PartialState._shared_state["distributed_type"] = DistributedType.FSDP

    AcceleratorState.__init__ = patched


def five_samples(*arguments: Any) -> dict[str, list[dataset.SupervisedItem]]:
    """Return what `supervised_items` returns, but only five samples if the items are those of
    training: a step of four samples, and a step of one, which two ranks cannot share."""
    items = build(*arguments)
    if len(arguments[1]) <= VALIDATION_ITEMS:
        return items
    return {"reasoning": items["reasoning"][:3], "answer": items["answer"][:2]}


def fail(*_: Any, **__: Any) -> None:
    raise UserError("a failure of this rank", code="test-failure")


def main() -> None:
    logging.basicConfig(level=logging.INFO)
    enable_fsdp_on_cpus()
    dataset.supervised_items = five_samples
    for run in pickle.loads(Path(sys.argv[1]).read_bytes()):
        # accelerate launch sets this with --use_fsdp.
        os.environ["ACCELERATE_USE_FSDP"] = str(run["fsdp"]).lower()
        folder, settings = run["folder"], run["settings"]
        folder.mkdir(parents=True, exist_ok=True)
        if rank() == 0 and run["checkpoint"]:
            shutil.copytree(run["checkpoint"], folder / run["checkpoint"].name)
        if rank() == run["failing_rank"]:
            LOSSES["token"] = fail
        trainer = sft if isinstance(settings, SftCommand) else contrastive
        with report_failures(str(folder)):
            start = trainer.main.__wrapped__
            entry._run(trainer.__name__, start, settings, Run(folder.name, folder))


if __name__ == "__main__":
    main()
