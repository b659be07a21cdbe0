"""A toy that squares x."""

import logging
import os
import time
from dataclasses import dataclass, field

from hydra.core.config_store import ConfigStore

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import UserError
from dynapix.conf.schema import CommandConfig, TeacherConfig

log = logging.getLogger(__name__)


@dataclass
class ToyCommand(CommandConfig):
    x: float = 1.0
    """Number to square."""
    end: str = "well"
    """How the run ends, such as well or bug."""
    teacher: TeacherConfig = field(default_factory=TeacherConfig)


defaults = ["toy_schema", "run_folder", {"teacher": "template"}, "_self_"]
ConfigStore.instance().store(name="toy", node={"defaults": defaults})


@command("toy", ToyCommand)
def main(cfg: ToyCommand, run: Run) -> dict[str, float]:
    assert isinstance(cfg.teacher, TeacherConfig)
    log.info("x is %s in %s", cfg.x, run.folder)
    if gpu := os.environ.get("CUDA_VISIBLE_DEVICES"):
        log.info("sees GPU %s", gpu)
    match cfg.end:
        case "mistake":
            raise UserError("this end is a mistake: set end=well", code="toy-mistake")
        case "bug":
            raise ValueError("a bug")
        case "never":
            time.sleep(60)
    return {"loss": cfg.x**2, "accuracy": 1 / cfg.x}


if __name__ == "__main__":
    main()
