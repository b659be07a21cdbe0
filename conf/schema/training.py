"""Settings of training."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from conf.schema.settings import Settings, setting

REGIMES = ("cot", "cot_no_candidate_analysis", "cot_no_match_layout", "answer_only", "describe")
WITHOUT_RATIONALES = ("answer_only", "describe")
"""Regimes that train on no rationales."""


@dataclass
class TrainConfig(Settings):
    """Settings that students and retrievers share."""

    lr: float = setting(2e-5, above=0)
    """Peak learning rate."""
    schedule: str = setting("cosine", ("cosine", "linear", "constant"))
    """Learning rate schedule after the warm-up: cosine, linear or constant."""
    warmup: float = setting(0.03, least=0, below=1)
    """Warm-up, as a share of the steps."""
    weight_decay: float = setting(0.0, least=0)
    """Weight decay of AdamW."""
    adam_beta2: float = setting(0.999, least=0, below=1)
    """Decay rate of AdamW's second moment."""
    max_grad_norm: float = setting(1.0, least=0)
    """Norm to which gradients are clipped."""
    epochs: float = 3.0
    """Passes over the training set."""
    max_steps: int = -1
    """Number of optimizer steps; -1 uses `epochs`."""
    precision: str = setting("auto", ("auto", "bf16", "fp32"))
    """Precision of the forward and backward pass, bf16 or fp32; adapters and optimizer state are
    always fp32. auto uses bf16 if the GPU or CPU has bf16 instructions, otherwise fp32."""
    gradient_checkpointing: bool = False
    """Recompute activations in the backward pass, which saves memory and costs about a third of the
    speed."""
    evaluations: int = setting(10, least=1)
    """Number of evaluations, evenly spaced over the run; each saves a checkpoint."""
    keep_checkpoints: int = setting(2, least=1)
    """Number of checkpoints to keep, including the best."""
    best_metric: str | None = None
    """Metric in metrics.jsonl that selects the checkpoint to export, such as
    eval_answer_letter_accuracy, eval_reasoning_loss or eval_recall@10: a loss by its lowest value,
    any other metric by its highest. null selects the last step."""
    workers: int = setting(0, least=0)
    """For a student, the number of processes that prepare batches in the background. For a
    retriever, the number of mini-batches that a thread prepares in advance. 0 prepares each batch
    when it is needed."""
    report_to: list[str] = field(default_factory=list)
    """Experiment trackers of transformers' Trainer, such as tensorboard, wandb or trackio."""

    def find_problems(self, group: str) -> Iterator[str]:
        if self.max_steps < 1 and (self.max_steps != -1 or self.epochs <= 0):
            yield (
                f"{group}max_steps={self.max_steps} and {group}epochs={self.epochs}: give 1 or "
                f"more steps, or {group}max_steps=-1 and {group}epochs above 0"
            )


@dataclass
class SftTrainConfig(TrainConfig):
    regime: str = setting("cot", REGIMES)
    """Content of the student's response: cot (rationale, one line per candidate that says
    whether it matches, answer), cot_no_candidate_analysis (cot without the candidate analysis of
    the rationale), cot_no_match_layout (cot without the lines per candidate), answer_only, or
    describe (a description, for the training of the tiny base)."""
    batch: int = setting(16, least=1)
    """Samples per optimizer step, over all micro-batches and ranks."""
    micro_batch: int = setting(1, least=1)
    """Samples per forward pass on each rank; changes memory and speed, not the result."""
    reuse_features: bool = False
    """Cache the frozen vision tower's features of each frame in up to half of the free memory,
    about 3 MB per frame with an 8B model."""
    permute_candidates: bool = False
    """Shuffle the candidates of each item in every epoch."""
    validation_items: int = setting(64, least=1)
    """Number of validation items, from training scenes that are held out."""
    generated_items: int = setting(8, least=0)
    """Number of validation items for which each evaluation generates a response in every mode; 0
    generates none."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        if self.micro_batch > 0 and self.batch % self.micro_batch:
            yield f"{group}micro_batch={self.micro_batch} must divide {group}batch={self.batch}"
        if self.permute_candidates and self.regime == "describe":
            yield (
                f"{group}permute_candidates=true with {group}regime=describe: descriptions "
                f"have no candidates; set {group}permute_candidates=false"
            )


@dataclass
class ContrastiveTrainConfig(TrainConfig):
    batch: int = setting(512, least=1)
    """Queries per optimizer step, over all ranks; each is contrasted with every target and hard
    negative of the batch except the frame of its own target."""
    mini_batch: int = 8
    """Queries or frames per forward pass; changes memory and speed, not the gradient."""
    hard_negatives: int = setting(1, least=0)
    """Hard negatives per query: wrong-time frames of the query's own scene."""
    scale: float = setting(50.0, above=0)
    """Inverse temperature: factor of the cosine similarities, or of their sum for
    retriever.late."""
    reuse_features: bool = False
    """Keep the frozen vision tower's features between the two passes of a step, about 30 MB per
    query with an 8B model; does not change the gradient."""
    width_weights: list[float] | None = None
    """Weight of the loss at each width of retriever.widths; null weights them equally."""
    validation_queries: int = setting(128, least=1)
    """Number of validation queries, from training scenes that are held out."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        if self.batch < 2 and not self.hard_negatives:
            yield (
                f"{group}batch={self.batch} with {group}hard_negatives=0 leaves no negatives: set "
                f"{group}batch to 2 or more, or {group}hard_negatives to 1 or more"
            )
        if not 1 <= self.mini_batch <= self.batch:
            yield f"{group}mini_batch={self.mini_batch} must be from 1 to {group}batch={self.batch}"
