"""What the tests of several ranks have `accelerate launch` start: a trainer, once for each of the
runs that a file lists, over the benchmark that the file holds."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from accelerate.state import AcceleratorState, PartialState
from accelerate.utils import DistributedType
from hydra.core.config_store import ConfigStore

from conf.errors import UserError
from conf.runs import rank
from train import contrastive, sft
from train.student import dataset
from train.student import run as student_run


def let_cpus_share() -> None:
    """Have accelerate take FSDP on CPUs as it does on GPUs. It knows the plugin there, and torch
    and gloo do the rest."""
    made = AcceleratorState.__init__

    def sharing(self: AcceleratorState, *args: Any, fsdp_plugin: Any = None, **settings: Any):
        made(self, *args, fsdp_plugin=fsdp_plugin, **settings)
        if fsdp_plugin is not None and self.distributed_type == DistributedType.MULTI_CPU:
            self.fsdp_plugin = fsdp_plugin
            self.distributed_type = DistributedType.FSDP
            PartialState._shared_state["distributed_type"] = DistributedType.FSDP

    AcceleratorState.__init__ = sharing


TRAINERS = {"sft": sft.main, "contrastive": contrastive.main}

make = dataset.supervised_items
MEASURED = 3
"""Held-out items of the tests' settings; training has more."""


def fewer(*arguments: Any) -> dict[str, list[dataset.Supervised]]:
    """Five training samples of two modes: a step of four, and one that all ranks cannot share."""
    few = {"reasoning": 3, "answer": 2}
    items = make(*arguments)
    is_validation = len(arguments[1]) <= MEASURED
    return items if is_validation else {mode: items[mode][: few[mode]] for mode in few}


def fail(*_: Any, **__: Any) -> None:
    raise UserError("this rank alone cannot go on")


def main() -> None:
    told = json.loads(Path(sys.argv[1]).read_text())
    ConfigStore.instance().store(group="benchmark", name="micro", node=told["benchmark"])
    let_cpus_share()
    dataset.supervised_items = fewer
    for run in told["runs"]:
        # As accelerate launch has it with and without --use_fsdp.
        os.environ["ACCELERATE_USE_FSDP"] = str(run["fsdp"]).lower()
        if rank() == 0 and run["after"]:
            shutil.copytree(run["after"], Path(run["folder"]) / Path(run["after"]).name)
        if rank() == run["fails_on"]:
            student_run.token_mean = fail
        sys.argv[1:] = run["overrides"]
        TRAINERS[run["trainer"]]()


if __name__ == "__main__":
    main()
