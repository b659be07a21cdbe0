"""Makes this project's launchers and its search known to Hydra, as if they were installed plugins.

A launcher's settings have submitit's own names, the search's those of hydra-optuna-sweeper.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from types import ModuleType

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins

from conf.multirun.launcher import ProcessLauncher
from conf.multirun.optuna_sweeper import OptunaSweeper
from conf.multirun.submitit_launcher import SubmititLauncher


@dataclass
class ProcessConf:
    _target_: str = "hydra_plugins.dynapix.ProcessLauncher"


@dataclass
class LocalConf:
    """Processes of this machine, all jobs at once: to try what a cluster would do."""

    _target_: str = "hydra_plugins.dynapix.SubmititLauncher"
    cluster: str = "local"
    submitit_folder: str = "${hydra.sweep.dir}/.submitit/%j"
    """Where submitit keeps its own files."""
    name: str = "${hydra.job.name}"
    timeout_min: int = 24 * 60
    """Minutes that a job may take."""
    gpus_per_node: int = 1
    cpus_per_task: int | None = None
    mem_gb: float | None = None


@dataclass
class SlurmConf(LocalConf):
    """Jobs of one SLURM array. What is null is left to the cluster."""

    cluster: str = "slurm"
    slurm_partition: str | None = None
    slurm_account: str | None = None
    slurm_qos: str | None = None
    slurm_constraint: str | None = None
    slurm_array_parallelism: int = 256
    """Jobs that run at once."""
    slurm_setup: list[str] | None = None
    """Commands of the batch script before the job's own, such as module load."""
    slurm_additional_parameters: dict[str, str] = field(default_factory=dict)
    """Any other option of sbatch, by its name."""


@dataclass
class OptunaConf:
    _target_: str = "hydra_plugins.dynapix.OptunaSweeper"
    metric: str | None = None
    """What a run measures that is to become best; null takes the command's usual one."""
    n_trials: int = 20
    """Jobs in all, those of an earlier start included."""
    n_jobs: int | None = None
    """Jobs that are chosen and run at once; null takes the number of GPUs."""
    seed: int = 0
    params: dict[str, str] | None = None
    """What is swept over where the command line names nothing else, for presets."""


# The first look at the plugins scans for installed ones, whose settings of the same names give way.
for plugin in (ProcessLauncher, SubmititLauncher, OptunaSweeper):
    Plugins.instance().register(plugin)
for group, name, node in (
    ("launcher", "process", ProcessConf),
    ("launcher", "submitit_local", LocalConf),
    ("launcher", "submitit_slurm", SlurmConf),
    ("sweeper", "optuna", OptunaConf),
):
    ConfigStore.instance().store(group=f"hydra/{group}", name=name, node=node)
# Hydra looks a plugin up by this name even when it is registered. The scan has imported the
# namespace package if any other plugin is installed.
_hydra_plugins = sys.modules.setdefault("hydra_plugins", ModuleType("hydra_plugins"))
_hydra_plugins.dynapix = sys.modules[__name__]
