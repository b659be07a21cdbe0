"""How students and retrievers are trained."""

from __future__ import annotations

from dataclasses import dataclass, field

from conf.schema.checks import no_share, too_small

REGIMES = ("cot", "cot_no_candidate_analysis", "cot_no_match_layout", "answer_only", "describe")


@dataclass
class TrainConfig:
    """Settings that both trainers share."""

    lr: float = 2e-5
    schedule: str = "cosine"
    """cosine, linear or constant, after the warm-up."""
    warmup: float = 0.03
    """Share of the steps."""
    weight_decay: float = 0.0
    adam_beta2: float = 0.999
    """How much of the squared gradients' mean AdamW keeps from step to step."""
    max_grad_norm: float = 1.0
    epochs: float = 3.0
    max_steps: int = -1
    """Optimizer steps; -1 leaves it to `epochs`."""
    precision: str = "auto"
    """bf16 or fp32: what the passes compute in; adapters and optimizer stay fp32. auto is bf16 on a
    GPU or CPU that has instructions for it, and else fp32, which is then several times as fast."""
    gradient_checkpointing: bool | str = "auto"
    """Whether activations are computed again in the backward pass: less memory, more time. auto
    does so only where they do not fit."""
    evaluations: int = 10
    """Evaluations, evenly spread over the run, each followed by a checkpoint."""
    keep: int = 2
    """Checkpoints kept, the best one among them."""
    best: str | None = None
    """The measure by which the best checkpoint is kept and becomes the student or retriever, by its
    name in metrics.jsonl, such as eval_answer_letter_accuracy, eval_reasoning_loss or
    eval_recall@10; a loss is best when least, all others when greatest. null takes the last
    step."""
    workers: int = 0
    """Processes that prepare batches while the model computes; for a retriever, mini-batches that a
    thread prepares ahead. 0 leaves it to the trainer's own process."""
    report_to: list[str] = field(default_factory=list)
    """Trackers of transformers' Trainer, such as tensorboard, wandb or trackio."""

    def check(self) -> list[str]:
        problems = too_small(
            self,
            "train.",
            {
                "weight_decay": 0,
                "max_grad_norm": 0,
                "evaluations": 1,
                "keep": 1,
                "workers": 0,
            },
        )
        problems += no_share(self, "train.", ["warmup", "adam_beta2"])
        if self.gradient_checkpointing not in (True, False, "auto"):
            problems.append(
                f"train.gradient_checkpointing={self.gradient_checkpointing}: the options are "
                "auto, true and false"
            )
        if self.lr <= 0:
            problems.append(f"train.lr={self.lr} must be above 0")
        if self.schedule not in ("cosine", "linear", "constant"):
            problems.append(
                f"train.schedule={self.schedule}: the options are cosine, linear and constant"
            )
        if self.precision not in ("auto", "bf16", "fp32"):
            problems.append(
                f"train.precision={self.precision}: the options are auto, bf16 and fp32"
            )
        if self.max_steps < 1 and (self.max_steps != -1 or self.epochs <= 0):
            problems.append(
                f"train.max_steps={self.max_steps} and train.epochs={self.epochs}: give one or "
                "more steps, or -1 and epochs above 0"
            )
        return problems


@dataclass
class SftTrainConfig(TrainConfig):
    regime: str = "cot"
    """What a student writes: cot (the rationale, whether each candidate matches it, the answer),
    cot_no_candidate_analysis, cot_no_match_layout, answer_only, or describe (the recipe of the
    tiny base)."""
    batch: int = 16
    """Samples a step, over all its micro-batches and ranks."""
    micro_batch: int | str = 1
    """Samples that pass a rank's model at once; moves memory and time, not what is learnt. auto
    takes the fastest number that fits, by trying the longest samples."""
    reuse_features: bool = False
    """Whether what the frozen vision tower makes of a frame is kept in memory and used wherever
    the frame is shown again; about 3 MB a frame of an 8B model, in half of the free memory."""
    packing: str = "auto"
    """Whether a micro-batch's samples stand in one row without padding, kept from seeing each
    other: true, false, or auto, where flash attention does so at no cost (never on a CPU, where it
    is slower)."""
    permute_candidates: bool = False
    """Whether each epoch shows every item's candidates in an order of its own."""
    validation_items: int = 64
    """Training-split items of held-out training scenes that measure the run."""
    generated_items: int = 8
    """How many of these the student answers in full at each evaluation, in each mode, all at once;
    0 asks for no answers."""

    def check(self) -> list[str]:
        problems = super().check() + too_small(
            self, "train.", {"batch": 1, "validation_items": 1, "generated_items": 0}
        )
        if isinstance(self.micro_batch, str):
            if self.micro_batch != "auto":
                problems.append(f"train.micro_batch={self.micro_batch}: give a number or auto")
        elif self.micro_batch < 1:
            problems.append(f"train.micro_batch={self.micro_batch} must be 1 or more")
        elif self.batch % self.micro_batch:
            problems.append(
                f"train.micro_batch={self.micro_batch} must divide train.batch={self.batch}"
            )
        if self.packing.lower() not in ("auto", "true", "false"):
            problems.append(f"train.packing={self.packing}: the options are auto, true and false")
        if self.regime not in REGIMES:
            problems.append(f"train.regime={self.regime}: the options are {', '.join(REGIMES)}")
        if self.packing.lower() == "true" and self.regime == "describe":
            problems.append(
                "train.packing=true with train.regime=describe: what each visual token shows is "
                "learnt from padded samples, leave train.packing=auto"
            )
        if self.permute_candidates and self.regime == "describe":
            problems.append(
                "train.permute_candidates=true with train.regime=describe: descriptions have no "
                "candidates"
            )
        return problems


@dataclass
class ContrastiveTrainConfig(TrainConfig):
    batch: int = 512
    """Queries a step, over all ranks; each is contrasted with every target and hard negative of
    the batch."""
    batches: str = "random"
    """How a batch is composed: random; scenes, where some queries of a scene stand together, so
    that it has many frames of one scene; or spread, with as few of a scene as can be."""
    scene_queries: int = 4
    """Queries of a scene that stand together in train.batches=scenes."""
    mini_batch: int | str = 8
    """Prefixes or frames that pass the model at once; moves memory and time, not the gradient. auto
    takes the fastest number that fits, by trying the longest prefixes."""
    mini_batch_tokens: int | None = None
    """Tokens that pass the model at once, in place of train.mini_batch."""
    hard_negatives: int = 1
    """Same-scene wrong-time frames a query."""
    mine_every: int = 0
    """Steps after which hard negatives are mined anew: the wrong frames that the retriever then
    ranks highest. 0 keeps the benchmark's. What is mined for one query may be another's target, so
    that this masks as train.mask_identical=true does."""
    mine_margin: float = 24.0
    """Mined frames of the target's scene are displaced by so many px (at 336 x 336) from it."""
    scale: float = 50.0
    """Inverse temperature of the scores: cosine similarities, which retriever.late sums up."""
    distinct_frames: bool = True
    """Whether a frame that several queries of a rank's share name is embedded once; moves no
    gradient."""
    shared_prefixes: bool = True
    """Whether a prefix that several queries of a rank's share have in common passes once; moves no
    gradient."""
    reuse_features: bool = False
    """Whether the frozen tower's outputs are kept between the two passes of a step, in memory that
    grows with the batch (about 30 MB a query of an 8B model); moves no gradient."""
    mask_identical: bool = False
    """Whether the frame of a query's target, where it is shown for another query too, is left out
    of its negatives. This changes the objective."""
    mask_near: float = 0.0
    """Frames of the target's scene that are displaced by less than so many px (at 336 x 336) from
    it are left out of a query's negatives. Above 0 this changes the objective."""
    hard_weight: float = 1.0
    """How many other negatives a query's own hard negatives count for. Other than 1 this changes
    the objective."""
    width_weights: list[float] | None = None
    """Weight of the loss at each of retriever.widths; null weighs all alike."""
    validation_queries: int = 128
    """Queries of held-out training scenes that measure the run."""

    def check(self) -> list[str]:
        problems = super().check() + too_small(
            self,
            "train.",
            {
                "batch": 1,
                "hard_negatives": 0,
                "validation_queries": 1,
                "scene_queries": 1,
                "mini_batch_tokens": 1,
                "mask_near": 0,
                "mine_every": 0,
                "mine_margin": 0,
            },
        )
        for name in ("scale", "hard_weight"):
            if getattr(self, name) <= 0:
                problems.append(f"train.{name}={getattr(self, name)} must be above 0")
        if self.batches not in ("random", "scenes", "spread"):
            problems.append(
                f"train.batches={self.batches}: the options are random, scenes and spread"
            )
        if self.batch < 2 and not self.hard_negatives:
            problems.append(
                f"train.batch={self.batch} with train.hard_negatives=0 leaves no negatives: give a "
                "batch of 2 or more, or hard negatives"
            )
        if self.batches == "scenes" and self.scene_queries > self.batch:
            problems.append(
                f"train.scene_queries={self.scene_queries} must be at most train.batch={self.batch}"
            )
        if self.mine_every and not self.hard_negatives:
            problems.append(
                f"train.mine_every={self.mine_every} with train.hard_negatives=0 mines nothing: "
                "give hard negatives, or leave train.mine_every=0"
            )
        if self.mini_batch == "auto":
            if self.mini_batch_tokens is not None:
                problems.append(
                    f"train.mini_batch=auto with train.mini_batch_tokens={self.mini_batch_tokens}: "
                    "give one of them"
                )
        elif isinstance(self.mini_batch, str):
            problems.append(f"train.mini_batch={self.mini_batch}: give a number or auto")
        elif not 1 <= self.mini_batch <= self.batch:
            problems.append(
                f"train.mini_batch={self.mini_batch} must lie between 1 and "
                f"train.batch={self.batch}"
            )
        return problems
