"""Settings of training."""

from __future__ import annotations

from dataclasses import dataclass, field

from conf.schema.checks import check_fraction, check_minimum, check_options, check_positive

REGIMES = ("cot", "cot_no_candidate_analysis", "cot_no_match_layout", "answer_only", "describe")


@dataclass
class TrainConfig:
    """Settings that students and retrievers share."""

    lr: float = 2e-5
    """Peak learning rate."""
    schedule: str = "cosine"
    """Learning rate schedule after the warm-up: cosine, linear or constant."""
    warmup: float = 0.03
    """Warm-up, as a share of the steps."""
    weight_decay: float = 0.0
    """Weight decay of AdamW."""
    adam_beta2: float = 0.999
    """Decay rate of AdamW's second moment."""
    max_grad_norm: float = 1.0
    """Norm to which gradients are clipped."""
    epochs: float = 3.0
    """Passes over the training set."""
    max_steps: int = -1
    """Number of optimizer steps; -1 uses `epochs`."""
    precision: str = "auto"
    """Precision of the forward and backward pass, bf16 or fp32; adapters and optimizer state are
    always fp32. auto uses bf16 if the GPU or CPU has bf16 instructions, otherwise fp32."""
    gradient_checkpointing: bool = False
    """Recompute activations in the backward pass, which saves memory and costs about a third of the
    speed."""
    evaluations: int = 10
    """Number of evaluations, evenly spaced over the run; each saves a checkpoint."""
    keep_checkpoints: int = 2
    """Number of checkpoints to keep, including the best."""
    best_metric: str | None = None
    """Metric in metrics.jsonl that selects the checkpoint to export, such as
    eval_answer_letter_accuracy, eval_reasoning_loss or eval_recall@10: a loss by its lowest value,
    any other metric by its highest. null selects the last step."""
    workers: int = 0
    """For a student, the number of processes that prepare batches in the background. For a
    retriever, the number of mini-batches that a thread prepares in advance. 0 prepares each batch
    when it is needed."""
    report_to: list[str] = field(default_factory=list)
    """Experiment trackers of transformers' Trainer, such as tensorboard, wandb or trackio."""

    def check(self) -> list[str]:
        least = {"weight_decay": 0, "max_grad_norm": 0, "workers": 0}
        least |= {"evaluations": 1, "keep_checkpoints": 1}
        options = {
            "schedule": ("cosine", "linear", "constant"),
            "precision": ("auto", "bf16", "fp32"),
        }
        problems = check_minimum(self, "train.", least)
        problems += check_fraction(self, "train.", ["warmup", "adam_beta2"])
        problems += check_positive(self, "train.", ["lr"])
        problems += check_options(self, "train.", options)
        if self.max_steps < 1 and (self.max_steps != -1 or self.epochs <= 0):
            problems.append(
                f"train.max_steps={self.max_steps} and train.epochs={self.epochs}: give 1 or more "
                "steps, or train.max_steps=-1 and train.epochs above 0"
            )
        return problems


@dataclass
class SftTrainConfig(TrainConfig):
    regime: str = "cot"
    """Content of the student's response: cot (rationale, one line per candidate that says
    whether it matches, answer), cot_no_candidate_analysis (cot without the candidate analysis of
    the rationale), cot_no_match_layout (cot without the lines per candidate), answer_only, or
    describe (a description, for the training of the tiny base)."""
    batch: int = 16
    """Samples per optimizer step, over all micro-batches and ranks."""
    micro_batch: int = 1
    """Samples per forward pass on each rank; changes memory and speed, not the result."""
    reuse_features: bool = False
    """Cache the frozen vision tower's features of each frame in up to half of the free memory,
    about 3 MB per frame with an 8B model."""
    packing: str = "auto"
    """Concatenate the samples of a micro-batch into one sequence without padding, with attention
    limited to each sample: true, false, or auto (only with flash attention; never on a CPU, where
    packing is slower)."""
    permute_candidates: bool = False
    """Shuffle the candidates of each item in every epoch."""
    validation_items: int = 64
    """Number of validation items, from training scenes that are held out."""
    generated_items: int = 8
    """Number of validation items for which each evaluation generates a response in every mode; 0
    generates none."""

    def check(self) -> list[str]:
        least = {"batch": 1, "micro_batch": 1, "validation_items": 1, "generated_items": 0}
        problems = super().check() + check_minimum(self, "train.", least)
        problems += check_options(self, "train.", {"regime": REGIMES})
        if self.micro_batch > 0 and self.batch % self.micro_batch:
            problems.append(
                f"train.micro_batch={self.micro_batch} must divide train.batch={self.batch}"
            )
        if self.packing.lower() not in ("auto", "true", "false"):
            problems.append(f"train.packing={self.packing}: the options are auto, true, false")
        if self.packing.lower() == "true" and self.regime == "describe":
            problems.append(
                "train.packing=true with train.regime=describe: this regime trains on padded "
                "samples; set train.packing=auto"
            )
        if self.permute_candidates and self.regime == "describe":
            problems.append(
                "train.permute_candidates=true with train.regime=describe: descriptions have no "
                "candidates; set train.permute_candidates=false"
            )
        return problems


@dataclass
class ContrastiveTrainConfig(TrainConfig):
    batch: int = 512
    """Queries per optimizer step, over all ranks; each is contrasted with every target and hard
    negative of the batch except the frame of its own target."""
    mini_batch: int = 8
    """Queries or frames per forward pass; changes memory and speed, not the gradient."""
    hard_negatives: int = 1
    """Hard negatives per query: wrong-time frames of the query's own scene."""
    mine_every: int = 0
    """Steps between two minings of hard negatives, which replace a query's hard negatives by the
    wrong frames that the retriever ranks highest; 0 keeps those of the benchmark."""
    mine_margin: float = 24.0
    """Minimum displacement (px at 336 x 336) of a mined frame from the target in the same scene."""
    scale: float = 50.0
    """Inverse temperature: factor of the cosine similarities, or of their sum for
    retriever.late."""
    reuse_features: bool = False
    """Keep the frozen vision tower's features between the two passes of a step, about 30 MB per
    query with an 8B model; does not change the gradient."""
    width_weights: list[float] | None = None
    """Weight of the loss at each width of retriever.widths; null weights them equally."""
    validation_queries: int = 128
    """Number of validation queries, from training scenes that are held out."""

    def check(self) -> list[str]:
        least = {
            "batch": 1,
            "hard_negatives": 0,
            "validation_queries": 1,
            "mine_every": 0,
            "mine_margin": 0,
        }
        problems = super().check() + check_minimum(self, "train.", least)
        problems += check_positive(self, "train.", ["scale"])
        if self.batch < 2 and not self.hard_negatives:
            problems.append(
                f"train.batch={self.batch} with train.hard_negatives=0 leaves no negatives: set "
                "train.batch to 2 or more, or train.hard_negatives to 1 or more"
            )
        if self.mine_every and not self.hard_negatives:
            problems.append(
                f"train.mine_every={self.mine_every} with train.hard_negatives=0 mines nothing: "
                "set train.hard_negatives to 1 or more, or train.mine_every=0"
            )
        if not 1 <= self.mini_batch <= self.batch:
            problems.append(
                f"train.mini_batch={self.mini_batch} must be from 1 to train.batch={self.batch}"
            )
        return problems
