"""Register this project's launchers and sweeper with Hydra, as if they were installed plugins."""

from __future__ import annotations

import sys
from types import ModuleType

from hydra.core.plugins import Plugins

from conf.multirun.launcher import ProcessLauncher
from conf.multirun.optuna_sweeper import OptunaSweeper
from conf.multirun.submitit_launcher import SubmititLauncher

for plugin in (ProcessLauncher, SubmititLauncher, OptunaSweeper):
    # Hydra imports a registered plugin by its name too, and only from the namespace package
    # hydra_plugins.
    plugin.__module__ = "hydra_plugins.dynapix"
    Plugins.instance().register(plugin)
# The namespace package is already imported if another plugin is installed.
_hydra_plugins = sys.modules.setdefault("hydra_plugins", ModuleType("hydra_plugins"))
_hydra_plugins.dynapix = sys.modules[__name__]
