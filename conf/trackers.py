"""The experiment trackers that transformers' Trainer can report to, and whether one is there."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec

from conf.errors import UserError

PACKAGES = {
    "tensorboard": "tensorboard",
    "wandb": "wandb",
    "trackio": "trackio",
    "azure_ml": "azureml",
    "clearml": "clearml",
    "codecarbon": "codecarbon",
    "comet_ml": "comet_ml",
    "dagshub": "dagshub",
    "dvclive": "dvclive",
    "flyte": "flytekit",
    "kubeflow": "kubeflow",
    "mlflow": "mlflow",
    "neptune": "neptune",
    "swanlab": "swanlab",
}
"""The package that is imported for each of the Trainer's names."""
EXTRAS = ("tensorboard", "wandb")
"""Those that this project has an extra for, of the same name."""


def check_trackers(report_to: Sequence[str]) -> None:
    """Raises UserError where a tracker is none that the Trainer knows, or is not installed."""
    for name in report_to:
        if name not in PACKAGES:
            raise UserError(
                f"train.report_to names {name}, which is no tracker; the options are "
                f"{', '.join(PACKAGES)}"
            )
        if find_spec(PACKAGES[name]) is None:
            what = f"-e '.[{name}]'" if name in EXTRAS else PACKAGES[name].replace("_", "-")
            raise UserError(
                f"train.report_to names {name}, which is not installed: pip install {what}, or "
                "leave it out"
            )
