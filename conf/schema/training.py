"""Settings of training."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import ClassVar

from dynapix.conf.schema.benchmark import POOLS
from dynapix.conf.schema.settings import Settings, check_choices, setting

RATIONALE_REGIMES = ("cot", "cot_no_candidate_analysis", "cot_no_match_layout")
REGIMES = (*RATIONALE_REGIMES, "answer_only")
LOSS_TYPES = ("dapo", "grpo", "bnpo", "dr_grpo", "cispo", "sapo", "luspo", "vespo")
"""The values of `loss_type` of TRL's GRPOConfig."""


@dataclass
class TrainConfig(Settings):
    """Training settings that students and retrievers share."""

    lr: float = setting(2e-5, above=0)
    """Peak learning rate."""
    schedule: str = setting("cosine", ("cosine", "linear", "constant"))
    """Learning rate schedule after the warm-up: cosine, linear or constant."""
    warmup: float = setting(0.03, least=0, below=1)
    """Length of the learning rate's warm-up, as a share of all steps."""
    weight_decay: float = setting(0.0, least=0)
    """Weight decay of AdamW."""
    adam_beta2: float = setting(0.999, least=0, below=1)
    """Decay rate of AdamW's second moment."""
    max_grad_norm: float = setting(1.0, least=0)
    """Maximum norm of the gradient, to which it is clipped."""
    epochs: float = 3.0
    """Number of passes over the training set."""
    max_steps: int = -1
    """Number of optimizer steps; -1 uses `epochs`."""
    precision: str = setting("auto", ("auto", "bf16", "fp32"))
    """Precision of the forward and backward pass, bf16 or fp32; trained weights and optimizer state
    are always fp32. auto uses bf16 if the GPU or CPU has bf16 instructions, otherwise fp32."""
    gradient_checkpointing: bool = False
    """Recompute activations in the backward pass. This saves memory and costs about a third of the
    speed."""
    hold_out: bool = True
    """Hold out a tenth of the training scenes, on whose items or queries the evaluations of the run
    are measured. false trains on all of them, as the paper does; the evaluations are then measured
    on a sample of what the run trains on."""
    evaluations: int = setting(10, least=1)
    """Number of evaluations, evenly spaced over the run and in addition to one before the first
    step. A run saves as many checkpoints, also evenly spaced, but at least two."""
    keep_checkpoints: int = setting(2, least=1)
    """Number of checkpoints to keep."""
    workers: int = setting(0, least=0)
    """For a student, the number of background processes that prepare batches. For a retriever, the
    number of mini-batches that a background thread prepares in advance. 0 prepares each batch when
    it is needed."""
    report_to: list[str] = field(default_factory=list)
    """Experiment trackers of transformers' Trainer, such as tensorboard, wandb or trackio."""

    def find_problems(self, group: str) -> Iterator[str]:
        if self.max_steps < 1 and (self.max_steps != -1 or self.epochs <= 0):
            yield (
                f"{group}max_steps={self.max_steps} and {group}epochs={self.epochs}: give 1 or "
                f"more steps, or {group}max_steps=-1 and {group}epochs above 0"
            )


@dataclass
class StudentTrainConfig(TrainConfig):
    """Training settings that `train.sft` and `train.distill` share."""

    batch: int = setting(16, least=1)
    """Number of samples per optimizer step, over all micro-batches and ranks."""
    micro_batch: int = setting(1, least=1)
    """Number of samples per forward pass on each rank; changes memory and speed, not the result."""
    permute_candidates: bool = False
    """Shuffle the order of each item's candidates in every epoch."""
    validation_items: int = setting(64, least=1)
    """Number of validation items, from scenes of the training split that are not trained on."""
    generated_items: int = setting(8, least=0)
    """Number of validation items for which each evaluation generates responses, in every mode that
    the student is trained in; 0 generates none."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        micro_batch = self.micro_batch or 1
        if micro_batch > 0 and self.batch % micro_batch:
            yield f"{group}micro_batch={micro_batch} must divide {group}batch={self.batch}"


@dataclass
class SftTrainConfig(StudentTrainConfig):
    regime: str = setting("cot", REGIMES)
    """Content of the responses that the student is trained on: cot (the rationale; one line per
    candidate that says whether it matches; the answer), cot_no_candidate_analysis (cot, but the
    rationale has no candidate analysis), cot_no_match_layout (cot without the lines per candidate),
    or answer_only (the answer)."""
    facts: bool = False
    """Show the facts of an item as text instead of its frames. Such a model can be the teacher of
    train.distill; it cannot be evaluated."""
    weighting: str = setting("token", options=("token", "sample"))
    """What the loss is a mean over: the supervised tokens of a step, as in the paper, or its
    samples. An answer has about 1% of the tokens of a rationale."""
    answers: int = setting(1, least=1)
    """Number of samples in answer mode of each item in an epoch, beside one with the rationale. In
    answer mode, a student learns more slowly and a sample costs less."""
    reuse_features: bool = False
    """Cache the frozen vision tower's features of each frame in up to half of the free memory. With
    an 8B model, the features of a frame take about 3 MB."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        if self.facts and self.regime == "answer_only":
            yield (
                f"{group}facts=true with {group}regime=answer_only: facts need a regime with "
                f"rationales, such as {group}regime=cot"
            )


@dataclass
class OnPolicyTrainConfig(TrainConfig):
    """Training settings that `train.distill` and `train.reinforce` share."""

    LR_SHARE: ClassVar[float]
    """Share of the peak learning rate of the student's training that `lr` is by default."""
    lr: float | None = setting(None, above=0)
    """Peak learning rate. null takes a share of that of the student's training: 0.5 in
    train.distill, and 0.15 in train.reinforce."""
    gradient_checkpointing: bool | None = None
    """Recompute activations in the backward pass; null does as the student's training did."""
    epochs: float = 1.0
    """Number of passes over the training items."""
    temperature: float = setting(1.0, above=0)
    """Temperature at which responses are sampled."""
    sampling_batch: int | None = setting(None, least=1)
    """Number of responses that a rank samples at once; changes memory and speed, and probabilities
    by rounding. null samples all responses of a step."""


@dataclass
class DistillTrainConfig(OnPolicyTrainConfig, StudentTrainConfig):
    LR_SHARE: ClassVar[float] = 0.5
    micro_batch: int | None = setting(None, least=1)
    """Number of samples per forward pass on each rank; changes memory and speed, not the result.
    null takes that of the student's training."""
    permute_candidates: bool | None = None
    """Shuffle the order of each item's candidates in every epoch; null does as the student's
    training did."""


@dataclass
class RewardWeights(Settings):
    """Weights of the rewards of `train.rewards`. A reward with weight 0 is not computed."""

    answer: float = setting(1.0, least=0)
    """Weight of 1 for the right letter."""
    truth: float = setting(0.5, least=0)
    """Weight of the share of claims that the oracle supports less that of those it contradicts."""
    following: float = setting(0.25, least=0)
    """Weight of 1 for an answer that follows from a text with more supported than contradicted
    claims."""
    no_numbers: float = setting(0.5, least=0)
    """Weight of -1 for a text with numbers."""
    form: float = setting(0.5, least=0)
    """Weight of -1 for a text that is cut off, or whose sections are out of order or repeated."""

    def find_problems(self, group: str) -> Iterator[str]:
        if not any(getattr(self, f.name) for f in fields(self)):
            yield f"{group.rstrip('.')}: all weights are 0; give one of them a weight above 0"


@dataclass
class ReinforceTrainConfig(OnPolicyTrainConfig):
    # With half of it, the rewards of a tiny student fell by 40% in 15 steps.
    LR_SHARE: ClassVar[float] = 0.15
    batch: int = setting(8, least=1)
    """Number of items per optimizer step, over all ranks."""
    responses: int = setting(8, least=2)
    """Number of responses that are sampled to each item of a step. The advantage of a response is
    its reward relative to those of the others."""
    micro_batch: int = setting(8, least=1)
    """Number of responses per forward pass on each rank; changes memory and speed, not the
    result."""
    validation_items: int = setting(16, least=1)
    """Number of items of held-out training scenes on which the rewards are measured."""
    rewards: RewardWeights = field(default_factory=RewardWeights)
    credit: str = setting("response", options=("response", "claims"))
    """Which tokens get the reward for true claims: all tokens of a response, or those of each claim
    their part of it."""
    loss_type: str = setting("dapo", LOSS_TYPES)
    """Loss of TRL's GRPOTrainer. dapo is the mean over all tokens of a step. With bnpo, the result
    also depends on `micro_batch`."""
    beta: float = setting(0.0, least=0)
    """Weight of the Kullback-Leibler divergence from the student as it was before this training. 0
    computes no divergence; above 0, a step has one forward pass more."""
    epsilon: float = setting(0.2, above=0)
    """Range to which the ratio of a token's probabilities after and before an update is clipped.
    Since each step has one update, the ratio is 1, and only the scale of loss_type=cispo depends on
    this."""
    importance_cap: float | None = setting(None, least=1)
    """Weight each token by the ratio of its probabilities in training and in sampling, but at most
    by this number (truncated importance sampling). null weights all tokens equally."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        if self.credit == "claims" and not self.rewards.truth:
            yield f"{group}credit=claims needs a {group}rewards.truth above 0"
        if self.micro_batch > 0 and (self.batch * self.responses) % self.micro_batch:
            yield (
                f"{group}micro_batch={self.micro_batch} must divide the {self.batch} x "
                f"{self.responses} responses of a step ({group}batch x {group}responses)"
            )


@dataclass
class ContrastiveTrainConfig(TrainConfig):
    pools: list[str] = field(default_factory=lambda: ["future"])
    """Pools whose queries are trained on: future, counterfactual, or both. The first hard negative
    of a counterfactual query shows the factual scene at the target's moment."""
    batch: int = setting(512, least=1)
    """Number of queries per optimizer step, over all ranks. The negatives of a query are all
    targets and hard negatives of the batch, except the query's own target frame."""
    mini_batch: int = 8
    """Number of queries or frames per forward pass; changes memory and speed, not the gradient. If
    it equals `batch`, a single process embeds a batch once instead of twice, and keeps the
    activations of the whole batch."""
    hard_negatives: int = setting(1, least=0)
    """Number of hard negatives per query that are trained on, of those that the benchmark has."""
    scale: float = setting(50.0, above=0)
    """Inverse temperature: the factor by which the cosine similarities, or their sum with
    retriever.late, are multiplied in the loss."""
    reuse_features: bool = False
    """Keep the frozen vision tower's features between the two forward passes of a step, which does
    not change the gradient. With an 8B model, the features of a query take about 30 MB. No effect
    if a batch is embedded once."""
    validation_queries: int = setting(128, least=1)
    """Number of validation queries, from scenes of the training split that are not trained on."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        yield from check_choices(f"{group}pools", self.pools, POOLS)
        if self.batch < 2 and not self.hard_negatives:
            yield (
                f"{group}batch={self.batch} with {group}hard_negatives=0 leaves no negatives: set "
                f"{group}batch to 2 or more, or {group}hard_negatives to 1 or more"
            )
        if not 1 <= self.mini_batch <= self.batch:
            yield f"{group}mini_batch={self.mini_batch} must be from 1 to {group}batch={self.batch}"
