"""Makes this project's launcher known to Hydra, as if it were an installed plugin."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from types import ModuleType

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins

from conf.launcher import ProcessLauncher


@dataclass
class ProcessConf:
    _target_: str = "hydra_plugins.dynapix.ProcessLauncher"


# The first look at the plugins scans for installed ones, whose settings of the same names give way.
Plugins.instance().register(ProcessLauncher)
ConfigStore.instance().store(group="hydra/launcher", name="process", node=ProcessConf)
# Hydra looks a plugin up by this name even when it is registered. The scan has imported the
# namespace package if any other plugin is installed.
_hydra_plugins = sys.modules.setdefault("hydra_plugins", ModuleType("hydra_plugins"))
_hydra_plugins.dynapix = sys.modules[__name__]
