"""Train the tiny base in stages: vision, motion, words.

    vision   the vision tower, and the embeddings of the words for colours, materials and shapes,
             learn to see the objects of single pictures
    motion   the whole model learns from clips and candidates where objects are and where they go
    words    the model, but not the vision tower, learns to answer questions in words; the targets
             of both other stages remain

Several ranks share each batch: every rank computes the losses of its samples, and the gradients are
averaged. Only the main rank evaluates and writes.

All stages see the same items. The order of the items, the questions and the candidates depend only
on the seed and the step, so that a resumed run continues as if it had never stopped.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor, distributed
from torch.nn import Parameter
from torch.nn.functional import cross_entropy
from tqdm import tqdm
from transformers import PreTrainedModel, ProcessorMixin

from dynapix.conf.entry import Run
from dynapix.conf.errors import UserError
from dynapix.conf.runs import rank, world_size
from dynapix.data.records import SelectionItem
from dynapix.models.distributed import patient_group
from dynapix.models.student.collator import IGNORED
from dynapix.train.common.curves import plot_curves
from dynapix.train.common.journal import CURVES, JOURNAL, read_journal
from research.tiny_base.collator import OracleCollator, letter_token_ids
from research.tiny_base.heads import OracleHeads
from research.tiny_base.measures import Probe
from research.tiny_base.muon import Muon
from research.tiny_base.oracle_targets import SPATIAL_WORDS, WORDS, OracleTargets
from research.tiny_base.questions import KINDS
from research.tiny_base.samples import ItemSampler
from research.tiny_base.settings import StageConfig, TinyBaseCommand, TinyBaseTrainConfig
from research.tiny_base.trace import (
    MIDDLE,
    NAMING,
    SPEAKING,
    Trace,
    encode_pictures,
    pointing_losses,
    select_tokens,
    trace_forward,
    trace_states,
)

log = logging.getLogger(__name__)

STAGES = ("vision", "motion", "words")
CHECKPOINT = "state.pt"
WARMUP_STEPS, MIN_LR_FACTOR = 40, 0.05
DENSE_WEIGHT = 1.0
"""Weight, in the stage of words, of the losses at visual tokens and of the colours, materials and
shapes at names."""
POINTING_WEIGHT = 0.5
"""Weight, in the stage of words, of the losses of attention heads."""
NAME_WEIGHT = 2.0
"""Weight of the losses of places and motion in texts."""
WORD_WEIGHT = 5.0
"""Weight of the losses of words: of all words, of those for colours, materials and shapes, of those
for places, motion and relations, of the letters after "closest", and of the verdicts in the match
layout. The second and third are a third and a tenth of all words, and harder to predict than the
others. With a weight of 1, the gradient of these losses was a tenth of that of the losses of places
and attention heads, and the base named objects that do not exist. With a weight of 3, its sentences
about two objects were often ungrammatical."""


def vision_losses(
    model: PreTrainedModel, heads: OracleHeads, batch: dict[str, Tensor], targets: OracleTargets
) -> dict[str, Tensor]:
    return heads.vision_losses(encode_pictures(model, batch), targets)


def motion_losses(
    model: PreTrainedModel, heads: OracleHeads, batch: dict[str, Tensor], targets: OracleTargets
) -> dict[str, Tensor]:
    trace = trace_states(model, batch)
    return dense_losses(trace, heads, targets) | pointing_losses(trace, targets)


def words_losses(
    model: PreTrainedModel, heads: OracleHeads, batch: dict[str, Tensor], targets: OracleTargets
) -> dict[str, Tensor]:
    labels = batch["labels"]
    inputs = {k: v for k, v in batch.items() if k != "labels"}
    with trace_forward(model.model.language_model, batch["attention_mask"]) as trace:
        logits = model(**inputs, use_cache=False).logits
    losses = {}
    if len(targets.objects):
        dense = dense_losses(trace, heads, targets)
        losses |= {name: DENSE_WEIGHT * loss for name, loss in dense.items()}
    pointing = pointing_losses(trace, targets)
    losses |= {name: POINTING_WEIGHT * loss for name, loss in pointing.items()}
    if len(targets.names) and len(targets.objects):
        names = heads.name_losses(trace.outputs[NAMING], targets)
        losses |= {f"name {name}": NAME_WEIGHT * loss for name, loss in names.items()}
        described = heads.description_losses(trace.outputs[SPEAKING], targets)
        losses |= {f"description {name}": NAME_WEIGHT * loss for name, loss in described.items()}
    if len(targets.names):
        words = heads.name_word_losses(trace.outputs[MIDDLE], targets)
        losses |= {f"name {kind}": DENSE_WEIGHT * loss for kind, loss in words.items()}
    predicted, following = logits[:, :-1].flatten(0, 1).float(), labels[:, 1:].flatten()
    losses["words"] = WORD_WEIGHT * cross_entropy(predicted, following, ignore_index=IGNORED)
    # The logits and labels are those of the last tokens.
    start = batch["input_ids"].shape[1] - labels.shape[1]
    groups = {
        "object words": targets.object_words,
        "spatial words": targets.spatial_words,
        "choices": targets.choices[:, :2] + torch.tensor([0, 1]),
        "matches": targets.matches[:, :2] + torch.tensor([0, 1]),
    }
    for name, tokens in groups.items():
        row, at = tokens.T
        if len(row):
            predicted = logits[row, at - start - 1].float()
            losses[name] = WORD_WEIGHT * cross_entropy(predicted, labels[row, at - start])
    return losses


def dense_losses(trace: Trace, heads: OracleHeads, targets: OracleTargets) -> dict[str, Tensor]:
    """Return the losses at the visual tokens of the whole model."""
    return {
        **heads.vision_losses(select_tokens(trace.embedded, targets.visual), targets),
        **heads.object_losses(select_tokens(trace.outputs[MIDDLE], targets.visual), targets),
    }


LOSSES: dict[str, Callable[..., dict[str, Tensor]]] = {
    "vision": vision_losses, "motion": motion_losses, "words": words_losses,
}  # fmt: skip


class TinyBaseTrainer:
    """Trains a model and the heads through all stages, with checkpoints.

    Args:
        folder: The run's folder, for the checkpoint, the journal and the curves.
        tokenizer_digest: Every start trains the tokenizer on the texts of the recipe, so another
            digest means another version of the recipe.
    """

    def __init__(
        self,
        cfg: TinyBaseTrainConfig,
        model: PreTrainedModel,
        heads: OracleHeads,
        collate: OracleCollator,
        sampler: ItemSampler,
        probe: Probe,
        folder: Path,
        tokenizer_digest: str,
    ) -> None:
        self.cfg, self.model, self.heads = cfg, model, heads
        self.collate, self.sampler, self.probe, self.folder = collate, sampler, probe, folder
        self.tokenizer_digest = tokenizer_digest
        self.parameters = [*model.parameters(), *heads.parameters()]
        self.stage, self.step = 0, 0

    def run(self) -> None:
        """Train through all stages, from the checkpoint if there is one."""
        self.optimizers = self._new_optimizers()
        self._load()
        for stage in STAGES[self.stage :]:
            self._run_stage(stage, getattr(self.cfg, stage))
            self.stage, self.step = self.stage + 1, 0
            self.optimizers = self._new_optimizers()
            self._save()

    def _new_optimizers(self) -> list[torch.optim.Optimizer]:
        """Return Muon for the matrices of the layers, and AdamW for embeddings, biases, norms and
        heads."""
        named = self.model.named_parameters()
        matrices = [p for name, p in named if p.dim() == 2 and "embed" not in name]
        with_muon = {id(p) for p in matrices}
        others = [p for p in self.parameters if id(p) not in with_muon]
        groups = [
            {"params": [p for p in others if p.dim() > 1]},
            # Biases and the weights of norms do not decay.
            {"params": [p for p in others if p.dim() <= 1], "weight_decay": 0.0},
        ]
        decay, betas = self.cfg.weight_decay, (0.9, self.cfg.adam_beta2)
        return [
            Muon(matrices, weight_decay=decay),
            torch.optim.AdamW(groups, betas=betas, weight_decay=decay),
        ]

    def _run_stage(self, name: str, stage: StageConfig) -> None:
        # Words would make the vision tower worse at what it has learnt from dense targets.
        self.model.model.visual.requires_grad_(name != "words")
        interval = max(1, math.ceil(stage.steps / self.cfg.evaluations))
        bar = tqdm(total=stage.steps, initial=self.step, desc=name, unit="step", disable=rank() > 0)
        with bar:
            while self.step < stage.steps:
                losses = self._train_step(name, stage)
                self.step += 1
                total = sum(losses.values())
                bar.update()
                bar.set_postfix_str(f"loss {total:.3f}")
                if rank() > 0:
                    continue
                done = sum(getattr(self.cfg, s).steps for s in STAGES[: self.stage]) + self.step
                record = {"step": done, "stage": name, "loss": total}
                if self.step % interval == 0 or self.step == stage.steps:
                    record |= {f"eval_{k}": v for k, v in self.probe.measure(name).items()}
                    self._log(record | {f"loss {k}": v for k, v in losses.items()})
                    self._save()
                    continue
                if self.step % self.cfg.log_steps == 0:
                    self._log(record)
                if self.step % self.cfg.checkpoint_steps == 0:
                    self._save()

    def _train_step(self, name: str, stage: StageConfig) -> dict[str, float]:
        """Take one optimizer step, and return the losses."""
        self.model.train()
        samples = self.sampler.make_batch(name, self.step, stage.batch)
        batch, targets = self.collate(samples)
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = stage.lr * learning_rate_factor(self.step, stage.steps)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.cfg.precision == "bf16"):
            losses = LOSSES[name](self.model, self.heads, batch, targets)
        loss = sum(losses.values())
        if not torch.isfinite(loss):
            raise UserError(
                f"the loss of step {self.step} of stage {name} is {loss.item()}; lower "
                f"train.{name}.lr in another run (run=NAME)",
                code="non-finite-loss",
            )
        self.model.zero_grad()
        self.heads.zero_grad()
        loss.backward()
        average_gradients(self.parameters)
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.cfg.max_grad_norm)
        for optimizer in self.optimizers:
            optimizer.step()
        return {k: v.item() for k, v in losses.items()}

    def _log(self, record: dict[str, float | str]) -> None:
        with open(self.folder / JOURNAL, "a") as file:
            file.write(json.dumps(record) + "\n")

    def _save(self) -> None:
        """Write the checkpoint and the curves."""
        if rank() > 0:
            return
        state = {
            "stage": self.stage,
            "step": self.step,
            "tokenizer": self.tokenizer_digest,
            "model": self.model.state_dict(),
            "heads": self.heads.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "journal": (self.folder / JOURNAL).stat().st_size,
        }
        part = self.folder / f"{CHECKPOINT}.tmp"
        torch.save(state, part)
        os.replace(part, self.folder / CHECKPOINT)
        plot_curves(read_journal(self.folder), self.folder / CURVES)

    def _load(self) -> None:
        path = self.folder / CHECKPOINT
        journal = self.folder / JOURNAL
        if not path.exists():
            if rank() == 0:
                journal.write_text("")
            return
        state = torch.load(path, weights_only=True)
        if state["tokenizer"] != self.tokenizer_digest:
            raise UserError(
                f"{path} has another tokenizer: the texts of the recipe have changed since; "
                "delete the run, or give run=NAME",
                code="other-recipe",
            )
        self.stage, self.step = state["stage"], state["step"]
        self.model.load_state_dict(state["model"])
        self.heads.load_state_dict(state["heads"])
        for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(saved)
        if rank() == 0:
            os.truncate(journal, state["journal"])
        log.info("resuming at step %d of stage %s", self.step, [*STAGES, "end"][self.stage])


def learning_rate_factor(step: int, steps: int) -> float:
    """Return the factor of the peak learning rate at a step: a cosine from 1 to `MIN_LR_FACTOR`
    over all steps, multiplied by a linear warm-up in the first `WARMUP_STEPS` steps."""
    cosine = (1 + math.cos(math.pi * step / steps)) / 2
    return min(1, (step + 1) / WARMUP_STEPS) * (MIN_LR_FACTOR + (1 - MIN_LR_FACTOR) * cosine)


def build_trainer(
    cfg: TinyBaseCommand,
    run: Run,
    model: PreTrainedModel,
    processor: ProcessorMixin,
    sampler: ItemSampler,
    held_out: Sequence[SelectionItem],
) -> TinyBaseTrainer:
    """Return the trainer of a run.

    Args:
        cfg: Settings whose train.precision is bf16 or fp32, not auto.
        held_out: Items on which the base is measured.
    """
    words = first_token_ids(processor)
    objects = {kind: words[kind] for kind in WORDS}
    letters = letter_token_ids(processor.tokenizer)
    heads = OracleHeads(model.get_input_embeddings(), objects, letters)
    collate = OracleCollator(processor, cfg.student.max_length)
    samples = [sampler.make_sample(item, "pictures", "held out") for item in held_out]
    worded = {
        kind: [sampler.make_sample(i, kind, "held out") for i in held_out[::2]] for kind in KINDS
    }
    probe = Probe(model, heads, collate, samples, worded, words, cfg.train.precision == "bf16")
    tokenizer = processor.tokenizer.backend_tokenizer.to_str()
    digest = hashlib.sha256(tokenizer.encode()).hexdigest()[:16]
    return TinyBaseTrainer(cfg.train, model, heads, collate, sampler, probe, run.folder, digest)


def first_token_ids(processor: ProcessorMixin) -> dict[str, list[int]]:
    """Return the first tokens of the words for objects, places, motion and relations, by kind."""
    encode = processor.tokenizer.encode
    return {
        kind: [encode(f" {word}", add_special_tokens=False)[0] for word in words]
        for kind, words in (WORDS | SPATIAL_WORDS).items()
    }


def average_gradients(parameters: Iterable[Parameter]) -> None:
    """Replace the gradients of parameters on the CPU by their means over all ranks.

    A gradient that only some ranks have is 0 on the others; one that no rank has stays None, so
    that the optimizer leaves its parameter unchanged.
    """
    if world_size() == 1:
        return
    parameters, group = [*parameters], patient_group()
    present = torch.tensor([float(p.grad is not None) for p in parameters])
    distributed.all_reduce(present, group=group)
    trained = [p for p, ranks in zip(parameters, present.tolist(), strict=True) if ranks]
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in trained]
    joined = torch.cat([g.flatten() for g in gradients])
    distributed.all_reduce(joined, group=group)
    means = (joined / world_size()).split([p.numel() for p in trained])
    for parameter, mean in zip(trained, means, strict=True):
        parameter.grad = mean.view_as(parameter)
