"""Settings of `python -m research.base`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from hydra.core.config_store import ConfigStore

from dynapix.conf.schema import BenchmarkConfig, CommandConfig, StudentConfig
from dynapix.conf.schema.settings import MISSING, Settings, setting

BASE_LAYERS, BASE_HEADS = 7, 6
"""Minimum numbers of language layers and of attention heads of a base that is trained: its
targets refer to the first seven layers, and in one of them to six heads: one for the clip, one for
each candidate, and one for the picture that the text describes."""


@dataclass
class StageConfig(Settings):
    """A stage of the training of the tiny base (see `research.tiny_base.training`)."""

    steps: int = setting(1000, least=1)
    """Number of optimizer steps."""
    batch: int = setting(8, least=1)
    """Number of samples per step."""
    lr: float = setting(1e-3, above=0)
    """Peak learning rate; a cosine lowers it to a twentieth."""


def stage(steps: int, batch: int, lr: float) -> StageConfig:
    """Return the field of a stage with its defaults."""
    return field(default_factory=lambda: StageConfig(steps, batch, lr))


@dataclass
class TinyBaseTrainConfig(Settings):
    vision: StageConfig = stage(3000, 16, 2e-3)
    """The vision tower learns to see objects in single pictures."""
    motion: StageConfig = stage(2000, 8, 1e-3)
    """The whole model learns where objects are and where they go."""
    words: StageConfig = stage(3500, 8, 8e-4)
    """The model learns to answer questions in words."""
    weight_decay: float = setting(0.05, least=0)
    """Weight decay of Muon and AdamW."""
    adam_beta2: float = setting(0.98, least=0, below=1)
    """Decay rate of AdamW's second moment."""
    max_grad_norm: float = setting(1.0, above=0)
    """Maximum norm of the gradient of the model's weights, to which it is clipped."""
    precision: str = setting("auto", ("auto", "bf16", "fp32"))
    """Precision of the forward and backward pass, as in `train.sft`."""
    evaluations: int = setting(10, least=1)
    """Number of evaluations of each stage. A checkpoint follows each evaluation."""
    checkpoint_steps: int = setting(200, least=1)
    """Number of steps between two checkpoints."""
    validation_items: int = setting(160, least=1)
    """Number of items, from held-out scenes, of an evaluation."""
    log_steps: int = setting(20, least=1)
    """Number of steps between two losses in the journal."""


@dataclass
class TinyBaseCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    student: StudentConfig = MISSING
    train: TinyBaseTrainConfig = field(default_factory=TinyBaseTrainConfig)
    seed: int = setting(0, least=0)
    """Seed of the order of the items, of the questions and of the heads."""

    def find_problems(self, group: str) -> Iterator[str]:
        sizes = self.student.architecture
        if sizes is None:
            yield (
                f"student.model={self.student.model}: a base is trained from random weights; "
                "choose student=tiny_scratch or set student.architecture"
            )
        elif sizes.layers < BASE_LAYERS or sizes.heads < BASE_HEADS:
            yield (
                f"student.architecture.layers={sizes.layers} and heads={sizes.heads}: the training "
                f"of a base needs {BASE_LAYERS} layers with {BASE_HEADS} heads or more"
            )


PRESETS = [{"world": "clevrer"}, {"benchmark": "tiny_base"}, {"student": "tiny_scratch"}]
ConfigStore.instance().store(
    name="base", node={"defaults": ["base_schema", "run_folder", *PRESETS, "_self_"]}
)
