"""Reinforcement learning with TRL's GRPOTrainer, on responses that the simulator judges.

TRL 1.16 passes images to the model, but no videos with true times (huggingface/trl issues 4144 and
5373), and it casts the adapters of a 4-bit base to bf16, in which small updates vanish. Both are
mended here: `MediaGRPOTrainer` computes the probabilities of responses with the project's own
inputs, and keeps the adapters in fp32.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from datasets import Dataset
from torch import Tensor, nn
from transformers import ProcessorMixin
from trl import GRPOConfig, GRPOTrainer

from conf.runs import Run
from conf.schema import ReinforceCommand, ReinforceTrainConfig, SftCommand, StudentConfig
from data.records import SelectionItem
from data.render.frame_cache import FrameReader
from data.store import Store
from models.distributed import split_batch
from models.student.collator import MEDIA_INPUTS, Collator
from models.student.prompts import Sample, selection_sample
from teacher.predicates.facts import RelationalPredicates
from teacher.vocabulary import describe_item
from train.common.arguments import common_arguments
from train.common.held_out import check_not_empty
from train.rewards import REWARDS, JudgedResponse, judge_response
from train.student.dataset import split_items
from train.student.distillation import ResponseSampler
from train.student.lazy_samples import seeded_rng
from train.student.paired_prompts import PairedPrompts

ROW = "row"
"""Key of the index of a response among those that were sampled together."""


@dataclass(frozen=True)
class JudgedItem:
    """An item, its prompt without response, and what judges a response to it."""

    item: SelectionItem
    predicates: RelationalPredicates
    render: Callable[[], Sample]


def load_items(
    cfg: ReinforceTrainConfig, trained: SftCommand, store: Store, seed: int
) -> tuple[list[JudgedItem], list[JudgedItem]]:
    """Return the training items, and held-out items, that have predicates.

    Raises:
        UserError: there are none.
    """
    frames = FrameReader(store, trained.student.image_size)

    def judged(items: Sequence[SelectionItem]) -> list[JudgedItem]:
        found = []
        for item in items:
            predicates = describe_item(item, store, trained.teacher)
            if predicates is not None:
                found.append(JudgedItem(item, predicates, lambda item=item: prompt(item)))
        return found

    def prompt(item: SelectionItem) -> Sample:
        regime, count = trained.train.regime, trained.student.frames
        return selection_sample(item, "reasoning", regime, frames, count)

    training, validation = map(judged, split_items(store, cfg.validation_items, seed))
    check_not_empty(len(training), "training items with predicates")
    check_not_empty(len(validation), "held-out items with predicates")
    return training, validation


def make_rows(items: Sequence[JudgedItem], split: str) -> Dataset:
    """Return the rows of TRL's dataset: the index of each item. TRL needs a prompt, but the prompts
    are rendered later."""
    ids = [judged.item.item_id for judged in items]
    return Dataset.from_dict(
        {"prompt": ids, "index": list(range(len(ids))), "split": [split] * len(ids)}
    )


def make_reward(name: str) -> Callable[..., list[float]]:
    """Return a reward of `REWARDS` in the form that TRL calls."""

    def reward(judged: Sequence[JudgedResponse], **_: Any) -> list[float]:
        return [REWARDS[name](response) for response in judged]

    reward.__name__ = name
    return reward


class MediaGRPOTrainer(GRPOTrainer):
    """A GRPOTrainer for prompts with clips.

    Args:
        items: The items by split, train and eval.
        sampler: Samples the responses.
        collator: Makes the model's inputs.
    """

    def __init__(
        self,
        *args: Any,
        items: Mapping[str, Sequence[JudgedItem]],
        sampler: ResponseSampler,
        collator: Collator,
        seed: int,
        **settings: Any,
    ) -> None:
        with warnings.catch_warnings():
            # It warns that `rollout_func` may change; pyproject.toml excludes later versions.
            warnings.filterwarnings("ignore", "You are using 'rollout_func'")
            super().__init__(*args, rollout_func=self._respond, **settings)
        for parameter in self.model.parameters():
            if parameter.requires_grad:
                parameter.data = parameter.data.float()
        self._items, self._sampler, self._collator, self._seed = items, sampler, collator, seed
        self._prompts: list[Sample] = []
        self._inputs: list[Sample] = []

    def _generate_and_score_completions(self, inputs: list[dict[str, Any]]) -> dict[str, Any]:
        """Sample and judge a response to each row, and keep the prompts for the loss."""
        self._judged = [self._items[row["split"]][row["index"]] for row in inputs]
        self._prompts = [judged.render() for judged in self._judged]
        output = super()._generate_and_score_completions(inputs)
        # TRL shuffles and splits the tensors of its output by their rows.
        return {**output, ROW: torch.arange(len(inputs), device=self.accelerator.device)}

    def _respond(self, prompts: list[str], _: GRPOTrainer) -> dict[str, Any]:
        """Return token ids of prompts and sampled responses, and the judged responses."""
        mode = "train" if self.model.training else "eval"
        keys = (self._seed, mode, self.state.global_step, self.accelerator.process_index)
        seeds = seeded_rng(*keys).integers(2**31, size=len(prompts)).tolist()
        asked = [
            PairedPrompts(sample, sample, judged.item.letter, seed)
            for sample, judged, seed in zip(self._prompts, self._judged, seeds, strict=True)
        ]
        training = self.model.training
        texts = self._sampler.sample(self.model, asked)
        self.model.train(training)
        batch = self._collator(self._prompts)
        prompt_ids = [
            ids[mask.bool()].tolist()
            for ids, mask in zip(batch["input_ids"], batch["attention_mask"], strict=True)
        ]
        judged = [
            judge_response(t.text, t.cut, j.item, j.predicates)
            for t, j in zip(texts, self._judged, strict=True)
        ]
        ids = [list(t.ids) for t in texts]
        return {"prompt_ids": prompt_ids, "completion_ids": ids, "logprobs": None, "judged": judged}

    def _compute_loss(self, model: nn.Module, inputs: dict[str, Any]) -> Tensor:
        self._inputs = [self._prompts[row] for row in inputs[ROW].tolist()]
        return super()._compute_loss(model, inputs)

    def _get_per_token_logps_and_entropies(
        self,
        model: nn.Module,
        input_ids: Tensor,
        attention_mask: Tensor,
        logits_to_keep: int,
        *_: Any,
        **__: Any,
    ) -> tuple[Tensor, Tensor, None]:
        """Return the logarithms of the probabilities of the responses' tokens, and the entropies,
        (B, `logits_to_keep`). The pixels are those of the prompts."""
        batch = self._collator(self._inputs)
        length = input_ids.shape[1] - logits_to_keep
        # TRL pads prompts on the left, as the collator does, and responses on the right.
        assert batch["input_ids"].shape[1] <= length
        types = torch.zeros_like(input_ids)
        prompt_types = batch["mm_token_type_ids"].to(types.device)
        types[:, length - prompt_types.shape[1] : length] = prompt_types
        media = {k: batch[k].to(input_ids.device) for k in MEDIA_INPUTS if k in batch}
        with self.accelerator.autocast():
            logits = model(
                input_ids=input_ids,
                attention_mask=attention_mask,
                mm_token_type_ids=types,
                logits_to_keep=logits_to_keep + 1,
                use_cache=False,
                **media,
            ).logits
        logs = torch.log_softmax(logits[:, :-1].float() / self.temperature, dim=-1)
        chosen = logs.gather(-1, input_ids[:, -logits_to_keep:, None])[..., 0]
        return chosen, -(logs.exp() * logs).sum(dim=-1), None


def build_trainer(
    cfg: ReinforceCommand,
    run: Run,
    student: StudentConfig,
    model: nn.Module,
    processor: ProcessorMixin,
    training: Sequence[JudgedItem],
    validation: Sequence[JudgedItem],
    checkpoint: Path | None,
) -> MediaGRPOTrainer:
    """Return a trainer.

    Args:
        cfg: Settings whose train.precision is bf16 or fp32, not auto.
        checkpoint: The checkpoint that the run resumes from, or None.
    """
    train = cfg.train
    names = [name for name in REWARDS if getattr(train.rewards, name)]
    arguments = GRPOConfig(
        **common_arguments(train, run, cfg.seed, checkpoint),
        per_device_train_batch_size=train.micro_batch,
        per_device_eval_batch_size=train.responses,
        gradient_accumulation_steps=split_batch(train.batch * train.responses, train.micro_batch),
        num_generations=train.responses,
        max_completion_length=student.max_new_tokens,
        temperature=train.temperature,
        # No reference model: the few steps and the small adapters keep the student close.
        beta=0.0,
        reward_weights=[getattr(train.rewards, name) for name in names],
    )
    return MediaGRPOTrainer(
        model=model,
        args=arguments,
        reward_funcs=[make_reward(name) for name in names],
        train_dataset=make_rows(training, "train"),
        eval_dataset=make_rows(validation, "eval"),
        processing_class=processor,
        items={"train": training, "eval": validation},
        sampler=ResponseSampler(processor, student, train),
        collator=Collator(processor, student.max_length),
        seed=cfg.seed,
    )
