"""Reinforcement learning with TRL's GRPOTrainer, on responses that are judged with the oracle.

TRL 1.16 passes images to the model, but no videos with true times (huggingface/trl issues 4144 and
5373), and it casts the adapters of a 4-bit base to bf16, in which small updates vanish. Both are
fixed here: `MediaGRPOTrainer` computes the probabilities of responses with the project's own
inputs, and keeps the adapters in fp32. It also keeps the order of the items when a run resumes in a
later epoch, leaves items whose responses have equal rewards out of the mean, and stops at a
non-finite loss. Its importance weights and its reference need no pass and no adapters of their own.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import torch
from datasets import Dataset
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence
from transformers import ProcessorMixin
from trl import GRPOConfig, GRPOTrainer

from dynapix.conf.errors import UserError
from dynapix.conf.runs import Run
from dynapix.conf.schema import ReinforceCommand, StudentConfig
from dynapix.data.parallel import batched
from dynapix.models.distributed import split_batch
from dynapix.models.student.collator import pad
from dynapix.train.common.callbacks import EpochCallback
from dynapix.train.common.training_loop import common_arguments
from dynapix.train.on_policy.claim_credit import credit_tokens
from dynapix.train.on_policy.judged_items import PROMPT, EpochSampler, ItemToJudge, PromptRows
from dynapix.train.on_policy.mismatch import Mismatch
from dynapix.train.on_policy.sampling import EncodedPrompt, ResponseSampler, encode_prompt
from dynapix.train.on_policy.served_sampling import build_sampler
from dynapix.train.rewards import REWARDS, JudgedResponse, judge_response
from dynapix.train.student.samples import seeded_rng

ROW = "row"
"""Key of the index of a response among those that were sampled together."""


def make_reward(name: str) -> Callable[..., list[float]]:
    """Return a reward of `REWARDS` in the form that TRL calls."""

    def reward(judged: Sequence[JudgedResponse], **_: Any) -> list[float]:
        return [REWARDS[name](response) for response in judged]

    reward.__name__ = name
    return reward


class StartingStudent:
    """A student as it was before its training: the reference of the divergence. It shares all
    weights but the trained ones.

    TRL's own reference is a second set of adapters, which every checkpoint and product would
    contain, or without adapters a base from the hub.
    """

    def __init__(self, model: nn.Module) -> None:
        self._model = model
        self._start = {p: p.detach().clone() for p in model.parameters() if p.requires_grad}

    def __call__(self, **inputs: Any) -> Any:
        current, training = {p: p.data for p in self._start}, self._model.training
        self._set(self._start)
        try:
            return self._model.eval()(**inputs)
        finally:
            self._set(current)
            self._model.train(training)

    def _set(self, weights: Mapping[nn.Parameter, Tensor]) -> None:
        for parameter, data in weights.items():
            parameter.data = data


class MediaGRPOTrainer(GRPOTrainer):
    """A GRPOTrainer for prompts with clips.

    Args:
        items: The items by split, train and eval.
        response_sampler: Samples the responses.
        beta: See `ReinforceTrainConfig`; that of TRL's arguments is 0.
        importance_cap: See `ReinforceTrainConfig`.
        claim_weight: Weight of the advantages of claims, which their tokens get besides that of
            their response.
    """

    def __init__(
        self,
        model: nn.Module,
        *args: Any,
        items: Mapping[str, Sequence[ItemToJudge]],
        response_sampler: ResponseSampler,
        beta: float,
        importance_cap: float | None,
        claim_weight: float,
        **settings: Any,
    ) -> None:
        trained = {p: p.data for p in model.parameters() if p.requires_grad}
        with warnings.catch_warnings():
            # It warns that `rollout_func` may change; pyproject.toml excludes later versions.
            warnings.filterwarnings("ignore", "You are using 'rollout_func'")
            super().__init__(model, *args, rollout_func=self._respond, **settings)
        for parameter, data in trained.items():
            parameter.data = data
        self.beta = beta
        if beta:
            self.ref_model = StartingStudent(model)
        self._items, self.response_sampler = items, response_sampler
        self._batch_items: list[ItemToJudge] = []
        self._prompts: list[EncodedPrompt] = []
        self._inputs: list[EncodedPrompt] = []
        self._loss_inputs: dict[str, Any] | None = None
        self._importance_cap, self._mismatch = importance_cap, Mismatch(importance_cap)
        self._claim_weight = claim_weight
        self._token_credits: list[Tensor] = []
        self._differ = torch.empty(0, dtype=torch.bool)

    def _send_telemetry(self) -> None:
        """Send nothing."""

    def create_model_card(self, *_: Any, **__: Any) -> None:
        """Write no model card into the run's folder: `train.export` writes one."""

    def _get_train_sampler(self, dataset: Dataset | None = None) -> EpochSampler:
        self._sampler = EpochSampler(
            data_source=self.train_dataset if dataset is None else dataset,
            mini_repeat_count=self.num_generations,
            batch_size=self.args.generation_batch_size // self.num_generations,
            repeat_count=self.num_iterations * self.args.steps_per_generation,
            seed=self.args.seed,
        )
        return self._sampler

    def set_epoch(self, epoch: int) -> None:
        self._sampler.set_epoch(epoch)

    def _generate_and_score_completions(self, inputs: list[dict[str, Any]]) -> dict[str, Any]:
        """Sample and judge a response to each row, and keep the prompts for the loss.

        Responses to an item whose rewards are all equal do not count in the mean over tokens, nor
        do they with `claim_weight` if they also have no claims.
        """
        self._batch_items = [self._items[row["split"]][row["index"]] for row in inputs]
        self._prompts = self._inputs = [row[PROMPT] for row in inputs]
        output = super()._generate_and_score_completions(inputs)
        first = self.accelerator.process_index * len(inputs)
        counted = self._differ[first : first + len(inputs), None]
        if self._claim_weight:
            credits = pad_sequence(self._token_credits, True).to(counted.device)
            counted = counted | credits.any(dim=1, keepdim=True)
            advantages = self._claim_weight * self._scale(credits)
            output["advantages"] = output["advantages"][:, None] + advantages
        # Tokens that it masks are read by the model, but not in the loss.
        output["tool_mask"] = counted.expand_as(output["completion_mask"])
        mode = "train" if self.model.training else "eval"
        self._metrics[mode]["frac_reward_zero_std"][-1] = 1 - self._differ.float().mean().item()
        total = self.accelerator.gather((output["completion_mask"] * counted).sum()).sum()
        output["num_items_in_batch"] = total.clamp(min=1)
        # TRL shuffles and splits the tensors of its output by their rows.
        return {**output, ROW: torch.arange(len(inputs), device=self.accelerator.device)}

    def _scale(self, credits: Tensor) -> Tensor:
        """Return the credits (B, T) in units of their root mean square over the tokens of all
        claims, on all ranks. No mean is subtracted: a true claim would be punished if others have
        larger credits."""
        sums = torch.stack([(credits != 0).sum(), credits.square().sum()]).float()
        count, squares = self.accelerator.reduce(sums)
        return credits / (squares / count.clamp(min=1)).sqrt().clamp(min=1e-6)

    def _calculate_rewards(self, inputs: list[dict[str, Any]], *rest: Any) -> Tensor:
        """Return the rewards of all ranks' responses, (N, rewards), and note for each response
        whether the rewards of the responses to its item differ."""
        rewards = super()._calculate_rewards(inputs, *rest)
        count = self.num_generations if self.model.training else self.num_generations_eval
        sums = (rewards * self.reward_weights.to(rewards.device)).sum(dim=1).view(-1, count)
        # TRL's mean of equal rewards can differ from them by a rounding error.
        self._differ = (sums.amax(dim=1) - sums.amin(dim=1) > 1e-6).repeat_interleave(count)
        return rewards

    def _respond(self, prompts: list[str], _: GRPOTrainer) -> dict[str, Any]:
        """Return token ids of prompts and sampled responses, and the judged responses."""
        training = self.model.training
        mode, step = "train" if training else "eval", self.state.global_step
        seen: Counter[str] = Counter()
        seeds = []
        for entry in self._batch_items:
            name = entry.item.item_id
            # The ranks have consecutive parts of the responses to an item.
            key = (self.args.seed, mode, step, name, seen[name], self.accelerator.process_index)
            seeds.append(int(seeded_rng(*key).integers(2**31)))
            seen[name] += 1
        texts = self.response_sampler.sample(self.model, self._prompts, seeds)
        self.model.train(training)
        judged = [
            judge_response(text.text, text.truncated, entry.item, entry.predicates)
            for text, entry in zip(texts, self._batch_items, strict=True)
        ]
        if training:
            self.response_sampler.check_parsed([j.letter for j in judged], self.accelerator)
        prompt_ids = [prompt.encoded.input_ids for prompt in self._prompts]
        ids = [list(t.ids) for t in texts]
        if self._claim_weight:
            pairs = zip(judged, ids, strict=True)
            self._token_credits = [credit_tokens(*pair, self._tokenizer) for pair in pairs]
        logs = [list(t.log_probabilities) for t in texts]
        return {"prompt_ids": prompt_ids, "completion_ids": ids, "logprobs": logs, "judged": judged}

    def _compute_loss(self, model: nn.Module, inputs: dict[str, Any]) -> Tensor:
        self._inputs = [self._prompts[row] for row in inputs[ROW].tolist()]
        self._loss_inputs = dict(inputs)
        loss = super()._compute_loss(model, self._loss_inputs)
        self._loss_inputs = None
        if not torch.isfinite(loss):
            self._stop("loss", loss.item())
        return loss

    def _get_per_token_logps_and_entropies(
        self,
        model: nn.Module,
        input_ids: Tensor,
        attention_mask: Tensor,
        logits_to_keep: int,
        batch_size: int | None = None,
        **_: Any,
    ) -> tuple[Tensor, Tensor, None]:
        """Return the logarithms of the probabilities of the responses' tokens, and the entropies,
        (B, `logits_to_keep`). The pixels are those of the prompts. A forward pass has up to
        `batch_size` responses."""
        size = batch_size or len(input_ids)
        parts = zip(
            batched(self._inputs, size),
            input_ids.split(size),
            attention_mask.split(size),
            strict=True,
        )
        found = [self._score(model, *part, logits_to_keep) for part in parts]
        logs, entropies = (torch.cat(values) for values in zip(*found, strict=True))
        if self._loss_inputs is not None:
            self._weigh_tokens(self._loss_inputs, logs.detach())
        return logs, entropies, None

    def _weigh_tokens(self, inputs: dict[str, Any], logs: Tensor) -> None:
        """Measure how far the sampler's probabilities are from these, and weigh the advantages with
        the truncated ratio.

        Since each step has one update, the probabilities of the loss are those before the update.
        TRL would compute them in a pass of its own.
        """
        differences = logs - inputs["sampling_per_token_logps"]
        self._mismatch.add(differences[inputs["completion_mask"].bool()])
        if self._importance_cap is not None:
            weights = differences.exp().clamp(max=self._importance_cap)
            # The loss of VESPO reads the weights, and all others read advantages (B, T) per token.
            if self.loss_type == "vespo":
                inputs["importance_sampling_ratio"] = weights
            else:
                advantages = inputs["advantages"]
                columns = advantages[:, None] if advantages.dim() == 1 else advantages
                inputs["advantages"] = columns * weights

    def _score(
        self,
        model: nn.Module,
        prompts: Sequence[EncodedPrompt],
        input_ids: Tensor,
        attention_mask: Tensor,
        logits_to_keep: int,
    ) -> tuple[Tensor, Tensor]:
        batch = pad([prompt.encoded for prompt in prompts], self._tokenizer.pad_token_id)
        length = input_ids.shape[1] - logits_to_keep
        # TRL pads prompts on the left, as `pad` does, and responses on the right.
        inputs = {}
        for name, value in batch.items():
            if name.endswith("type_ids"):
                inputs[name] = torch.zeros_like(input_ids)
                inputs[name][:, length - value.shape[1] : length] = value.to(input_ids.device)
            elif name not in ("input_ids", "attention_mask", "labels"):
                inputs[name] = value.to(input_ids.device)
        with self.accelerator.autocast():
            logits = model(
                input_ids=input_ids,
                attention_mask=attention_mask,
                logits_to_keep=logits_to_keep + 1,
                use_cache=False,
                **inputs,
            ).logits
        logs = torch.log_softmax(logits[:, :-1].float() / self.temperature, dim=-1)
        chosen = logs.gather(-1, input_ids[:, -logits_to_keep:, None])[..., 0]
        with torch.no_grad():
            entropy = -(logs.exp() * logs).sum(dim=-1)
        return chosen, entropy

    def prediction_step(
        self, model: nn.Module, inputs: Any, *_: Any, **__: Any
    ) -> tuple[Tensor, None, None]:
        """Measure the rewards of an evaluation; its loss would be meaningless."""
        self._prepare_inputs(inputs)
        return torch.zeros((), device=self.accelerator.device), None, None

    def log(self, logs: dict[str, float], *args: Any, **settings: Any) -> None:
        """Log the measures of a step, except ratios over no tokens: TRL divides by the tokens of
        responses that do not count.

        Raises:
            UserError: The gradient is not finite. The resulting weights are not saved.
        """
        measures = self._metrics["train" if self.model.training else "eval"]
        for name, values in list(measures.items()):
            measures[name] = [value for value in values if not math.isnan(value)]
            if not measures[name]:
                del measures[name]
        if "loss" in logs:
            logs |= self._mismatch.take(self.accelerator)
        super().log(logs, *args, **settings)
        if not math.isfinite(logs.get("grad_norm", 0.0)):
            self._stop("gradient", logs["grad_norm"])

    def _stop(self, what: str, value: float) -> NoReturn:
        raise UserError(
            f"non-finite {what} ({value}) after step {self.state.global_step}: lower train.lr or "
            "set train.precision=fp32, in another run (run=NAME); checkpoints up to this step are "
            "kept",
            code=f"non-finite-{what}",
        )


def build_trainer(
    cfg: ReinforceCommand,
    run: Run,
    student: StudentConfig,
    model: nn.Module,
    processor: ProcessorMixin,
    training: Sequence[ItemToJudge],
    validation: Sequence[ItemToJudge],
    checkpoint: Path | None,
) -> MediaGRPOTrainer:
    """Return a trainer.

    Args:
        cfg: Settings whose train.precision is bf16 or fp32, not auto.
        checkpoint: The checkpoint that the run resumes from, or None.

    Raises:
        UserError: there are fewer training items than train.batch.
    """
    train = cfg.train
    if len(training) < train.batch:
        raise UserError(
            f"train.batch={train.batch} is more than the {len(training)} training items: lower it",
            code="batch-too-large",
        )
    encode = partial(encode_prompt, processor=processor, max_length=student.max_length)
    weights = {name: getattr(train.rewards, name) for name in REWARDS}
    weights = {name: weight for name, weight in weights.items() if weight}
    names, claim_weight = [*weights], 0.0
    if train.credit == "claims":
        # The reward for true claims is measured, and its tokens get their parts of it instead.
        claim_weight, weights["truth"] = weights["truth"], 0.0
    arguments = GRPOConfig(
        **common_arguments(train, run, cfg.seed, checkpoint),
        per_device_train_batch_size=train.micro_batch,
        per_device_eval_batch_size=train.responses,
        gradient_accumulation_steps=split_batch(train.batch * train.responses, train.micro_batch),
        num_generations=train.responses,
        max_completion_length=student.max_new_tokens,
        temperature=train.temperature,
        loss_type=train.loss_type,
        epsilon=train.epsilon,
        reward_weights=[*weights.values()],
        ddp_find_unused_parameters=not student.lora.rank,
    )
    trainer = MediaGRPOTrainer(
        model=model,
        args=arguments,
        reward_funcs=[make_reward(name) for name in names],
        train_dataset=PromptRows("train", training, encode),
        eval_dataset=PromptRows("eval", validation, encode),
        processing_class=processor,
        items={"train": training, "eval": validation},
        response_sampler=build_sampler(processor, student, train, cfg.sampling_server, run.folder),
        beta=train.beta,
        importance_cap=train.importance_cap,
        claim_weight=claim_weight,
    )
    trainer.add_callback(EpochCallback(trainer))
    return trainer
