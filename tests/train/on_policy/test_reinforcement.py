"""Reinforcement learning: TRL's loss on responses to prompts with clips."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from accelerate.data_loader import BatchSamplerShard
from torch import nn
from torch.utils.data import BatchSampler

from dynapix.conf.entry import Run
from dynapix.conf.schema import ReinforceCommand, ReinforceTrainConfig, RewardWeights
from dynapix.conf.schema.training import LOSS_TYPES
from dynapix.data.store import Store
from dynapix.models.student.collator import Collator
from dynapix.train import reinforce
from dynapix.train.common.journal import read_journal
from dynapix.train.on_policy import judged_items, reinforcement, sampling
from dynapix.train.student.trainer import token_losses
from tests.train.on_policy.test_distillation import LESS_MEMORY
from tests.user_errors import raises_user_error

pytestmark = pytest.mark.slow


@pytest.fixture
def settings(student: Path, micro_store: Store) -> ReinforceCommand:
    train = ReinforceTrainConfig(
        lr=1e-2, max_steps=4, batch=2, responses=4, micro_batch=4, precision="fp32",
        evaluations=2, validation_items=1, rewards=RewardWeights(form=0),
    )  # fmt: skip
    return ReinforceCommand(
        model=str(student), store=str(micro_store.folder.parent), workers=1, train=train
    )


def run_reinforce(settings: ReinforceCommand, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    reinforce.main.__wrapped__(settings, Run(folder.name, folder))
    return folder


@pytest.fixture
def short_rewards(monkeypatch) -> None:
    """A reward that differs between random texts: minus the number of their letters."""
    monkeypatch.setitem(reinforcement.REWARDS, "answer", lambda r: -len(r.text) / 10)


def test_a_run_that_resumes_with_less_memory_samples_the_same_responses(
    settings, tmp_path, monkeypatch, short_rewards
) -> None:
    sampled: dict[str, list[tuple[int, ...]]] = {"whole": [], "resumed": []}
    sample = reinforcement.ResponseSampler.sample
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"

    def recorded(self, model, prompts, seeds):
        texts = sample(self, model, prompts, seeds)
        if len(prompts) == 8:  # those of a training step
            sampled[current].extend(text.ids for text in texts)
        return texts

    monkeypatch.setattr(reinforcement.ResponseSampler, "sample", recorded)
    current = "whole"
    run_reinforce(settings, whole)
    shutil.copytree(whole / "checkpoint-2", resumed / "checkpoint-2")
    shutil.copy(whole / "metrics.jsonl", resumed)
    current = "resumed"
    run_reinforce(replace(settings, train=replace(settings.train, **LESS_MEMORY)), resumed)
    assert len(sampled["whole"]) == 4 * 8
    assert sampled["resumed"] == sampled["whole"][16:]
    steps = [r for r in read_journal(whole) if "reward" in r]
    assert len(steps) == 4
    assert all(r["rewards/answer/mean"] < 0 for r in steps)
    assert all(r["grad_norm"] > 0 for r in steps)


def test_probabilities_are_those_of_the_student_trainer(
    settings, processor, tmp_path, monkeypatch, short_rewards
) -> None:
    """The summed logarithms of a response's probabilities are minus its cross entropy."""
    checked = []
    compute = reinforcement.MediaGRPOTrainer._get_per_token_logps_and_entropies
    collate = Collator(processor, None)

    def compared(self, model, input_ids, attention_mask, logits_to_keep, *rest, **settings):
        logs, entropies, _ = compute(
            self, model, input_ids, attention_mask, logits_to_keep, *rest, **settings
        )
        mask = attention_mask[:, -logits_to_keep:].bool()
        samples = [
            replace(prompt.sample, response="", response_ids=tuple(ids[kept].tolist()))
            for prompt, ids, kept in zip(
                self._inputs, input_ids[:, -logits_to_keep:], mask, strict=True
            )
        ]
        batch = collate(samples)
        labels = batch.pop("labels")
        with torch.no_grad():
            losses = token_losses(model(**batch, use_cache=False).logits, labels)
        torch.testing.assert_close((logs * mask).sum(dim=-1), -losses[:, 0], atol=1e-3, rtol=1e-3)
        checked.append(len(samples))
        return logs, entropies, None

    monkeypatch.setattr(
        reinforcement.MediaGRPOTrainer, "_get_per_token_logps_and_entropies", compared
    )
    train = replace(settings.train, max_steps=1, evaluations=1)
    run_reinforce(replace(settings, train=train), tmp_path / "run")
    assert sum(checked) >= 8


def test_a_step_encodes_each_prompt_once(settings, tmp_path, monkeypatch, short_rewards) -> None:
    encoded: list[str] = []
    encode = sampling.encode

    def counted(sample, *rest):
        encoded.append(sample.sample_id)
        return encode(sample, *rest)

    monkeypatch.setattr(sampling, "encode", counted)
    train = replace(settings.train, max_steps=3, evaluations=1, micro_batch=1)
    run_reinforce(replace(settings, train=train), tmp_path / "run")
    # Two evaluations of one item, and the two items of each step; the data loader reads the next.
    assert len(encoded) == 2 * 1 + (3 + 1) * 2
    assert len(set(encoded)) == 1 + 4 * 2


@pytest.mark.parametrize("rank", [0, 1])
def test_each_rank_reads_the_prompts_of_a_step_once(rank) -> None:
    """Two ranks with two micro-batches of two responses, four to each of two items a step."""
    sampler = judged_items.EpochSampler(
        range(4), mini_repeat_count=4, batch_size=2, repeat_count=2, seed=0
    )
    batches = BatchSamplerShard(BatchSampler(sampler, 4, False), 2, rank)
    read = list(batches)
    assert len(read) == 2 * 2
    for used, repeated in (read[:2], read[2:]):
        assert all(k >= 0 for k in used)
        assert repeated == [~k for k in used]


def test_a_sampler_with_the_trainers_distribution_has_no_mismatch(
    settings, tmp_path, monkeypatch, short_rewards
) -> None:
    # The trainer's distribution contains the tokens that the sampler suppresses.
    monkeypatch.setattr(
        sampling, "SuppressTokensLogitsProcessor", lambda *_, **__: lambda ids, scores: scores
    )
    train = replace(settings.train, max_steps=2, evaluations=1, temperature=0.7)
    folder = run_reinforce(replace(settings, train=train), tmp_path / "run")
    steps = [r for r in read_journal(folder) if "loss" in r]
    assert len(steps) == 2
    assert all(r["mismatch_max"] < 1e-4 for r in steps)
    assert all(r["mismatch_ratio"] == pytest.approx(1, abs=1e-5) for r in steps)
    assert all("mismatch_capped" not in r for r in steps)


def change_sampled_logs(monkeypatch, change: Callable[[float], float]) -> None:
    """Apply a function to each log-probability that the sampler returns."""
    sample = reinforcement.ResponseSampler.sample

    def changed(self, model, prompts, seeds):
        texts = sample(self, model, prompts, seeds)
        return [
            replace(text, log_probabilities=tuple(map(change, text.log_probabilities)))
            for text in texts
        ]

    monkeypatch.setattr(reinforcement.ResponseSampler, "sample", changed)


def test_the_gradient_is_that_of_truncated_weights(
    settings, tmp_path, monkeypatch, short_rewards
) -> None:
    cap, checked = 1.5, []
    rng = np.random.default_rng(0)
    change_sampled_logs(monkeypatch, lambda log: log + rng.normal())
    compute = reinforcement.MediaGRPOTrainer._compute_loss

    def compared(self, model, inputs):
        for name in (*LOSS_TYPES[1:], LOSS_TYPES[0]):
            self.loss_type = name
            loss = compute(self, model, inputs)
        ids = torch.cat([inputs["prompt_ids"], inputs["completion_ids"]], dim=1)
        mask = torch.cat([inputs["prompt_mask"], inputs["completion_mask"]], dim=1)
        count = inputs["completion_ids"].shape[1]
        logs, _, _ = self._get_per_token_logps_and_entropies(model, ids, mask, count)
        ratios = (logs.detach() - inputs["sampling_per_token_logps"]).exp()
        counted = inputs["completion_mask"] * inputs["tool_mask"]
        weights = ratios.clamp(max=cap) * inputs["advantages"][:, None] * counted
        direct = -(weights * logs).sum() / inputs["num_items_in_batch"]
        trained = [p for p in model.parameters() if p.requires_grad]
        ours = torch.autograd.grad(loss, trained, retain_graph=True)
        expected = torch.autograd.grad(direct, trained)
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-6)
        checked.append((ratios > cap)[inputs["completion_mask"].bool()])
        return loss

    monkeypatch.setattr(reinforcement.MediaGRPOTrainer, "_compute_loss", compared)
    train = replace(settings.train, max_steps=1, evaluations=1, importance_cap=cap)
    folder = run_reinforce(replace(settings, train=train), tmp_path / "run")
    (step,) = (r for r in read_journal(folder) if "loss" in r)
    truncated = torch.cat(checked).float().mean().item()
    assert 0.2 < truncated < 0.5
    assert step["mismatch_capped"] == pytest.approx(truncated)


def test_the_tokens_of_claims_get_their_own_advantages(
    settings, tmp_path, monkeypatch, short_rewards
) -> None:
    """In a step of eight responses, of which every third token has a credit of each sign."""
    credits: list[torch.Tensor] = []
    checked = 0

    def credit(response, ids, tokenizer) -> torch.Tensor:
        credits.append(torch.zeros(len(ids)))
        credits[-1][::3], credits[-1][1::3] = 0.5, -0.1
        return credits[-1]

    monkeypatch.setattr(reinforcement, "credit_tokens", credit)
    compute = reinforcement.MediaGRPOTrainer._compute_loss

    def compared(self, model, inputs):
        nonlocal checked
        loss = compute(self, model, inputs)
        found = torch.cat(credits[-8:])
        found = found[found != 0]
        mask, advantages = inputs["completion_mask"].bool(), inputs["advantages"]
        columns = torch.arange(mask.shape[1])
        for row, kept in zip(advantages, mask, strict=True):
            # Tokens without a credit have the advantage of their response.
            own = row[2]
            for start, value in ((0, 0.5), (1, -0.1)):
                part = value / found.square().mean().sqrt()
                expected = own + settings.train.rewards.truth * part
                tokens = row[kept & (columns % 3 == start)]
                torch.testing.assert_close(tokens, expected.expand_as(tokens), rtol=1e-3, atol=1e-4)
                checked += len(tokens)
            torch.testing.assert_close(row[2::3], own.expand_as(row[2::3]))
        return loss

    monkeypatch.setattr(reinforcement.MediaGRPOTrainer, "_compute_loss", compared)
    train = replace(settings.train, max_steps=1, evaluations=1, credit="claims")
    folder = run_reinforce(replace(settings, train=train), tmp_path / "run")
    (step,) = (r for r in read_journal(folder) if "loss" in r)
    assert checked > 20
    assert step["grad_norm"] > 0
    assert "rewards/truth/mean" in step
    # The weighted sum leaves it out.
    parts = asdict(settings.train.rewards).items()
    total = sum(w * step[f"rewards/{name}/mean"] for name, w in parts if w and name != "truth")
    assert step["reward"] == pytest.approx(total, rel=1e-4)


def test_the_reference_is_the_student_before_this_training(
    settings, tmp_path, short_rewards
) -> None:
    train = replace(settings.train, beta=0.5)
    whole = run_reinforce(replace(settings, train=train), tmp_path / "whole")
    resumed = tmp_path / "resumed"
    shutil.copytree(whole / "checkpoint-2", resumed / "checkpoint-2")
    shutil.copy(whole / "metrics.jsonl", resumed)
    run_reinforce(replace(settings, train=train), resumed)
    first, second = ([r["kl"] for r in read_journal(f) if "kl" in r] for f in (whole, resumed))
    assert first[0] == pytest.approx(0, abs=1e-6)
    assert first[-1] > 1e-6
    assert first == pytest.approx(second, rel=1e-3)
    # The product has no second set of adapters.
    assert len(list((whole / "student").rglob("adapter_model.safetensors"))) == 1


def test_a_reference_keeps_the_weights_and_the_mode_of_its_student() -> None:
    model = nn.Sequential(nn.Linear(2, 2), nn.Dropout(0.5))
    model[0].bias.requires_grad_(False)
    model.forward = lambda x: nn.Sequential.forward(model, x)
    inputs = torch.ones(1, 2)
    before = model.eval()(inputs)
    reference = reinforcement.StartingStudent(model.train())
    with torch.no_grad():
        model[0].weight.add_(1)
        assert torch.equal(reference(x=inputs), before)
        assert model.training
        assert not torch.equal(model.eval()(inputs), before)


def test_a_run_resumes_in_its_second_epoch(settings, tmp_path, monkeypatch, short_rewards) -> None:
    """Each epoch has its own order of the items."""
    seen: dict[str, list[list[str]]] = {"whole": [], "resumed": []}
    respond = reinforcement.MediaGRPOTrainer._respond
    load = judged_items.load_items

    def recorded(self, prompts, trainer):
        if self.model.training:
            seen[current].append([entry.item.item_id for entry in self._batch_items[::4]])
        return respond(self, prompts, trainer)

    def four_items(*arguments):
        training, validation = load(*arguments)
        return training[:4], validation

    monkeypatch.setattr(reinforcement.MediaGRPOTrainer, "_respond", recorded)
    monkeypatch.setattr(judged_items, "load_items", four_items)
    train = replace(settings.train, max_steps=6, evaluations=2)
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    current = "whole"
    run_reinforce(replace(settings, train=train), whole)
    shutil.copytree(whole / "checkpoint-3", resumed / "checkpoint-3")
    current = "resumed"
    run_reinforce(replace(settings, train=train), resumed)
    assert seen["resumed"] == seen["whole"][3:]
    epochs = [seen["whole"][k] + seen["whole"][k + 1] for k in (0, 2, 4)]
    assert all(sorted(epoch) == sorted(epochs[0]) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1


def test_equal_rewards_give_no_gradient(settings, tmp_path, monkeypatch) -> None:
    # The mean of six of these rewards in TRL's precision differs from them.
    monkeypatch.setitem(reinforcement.REWARDS, "answer", lambda _: 9 / 37)
    for name in ("truth", "following", "no_numbers"):
        monkeypatch.setitem(reinforcement.REWARDS, name, lambda _: 0.0)
    train = replace(settings.train, max_steps=1, evaluations=1, responses=6)
    folder = run_reinforce(replace(settings, train=train), tmp_path / "run")
    (step,) = (r for r in read_journal(folder) if "reward" in r)
    assert step["frac_reward_zero_std"] == 1
    assert step["grad_norm"] == 0
    assert all(math.isfinite(value) for value in step.values())


def test_a_non_finite_loss_stops_the_run(settings, tmp_path, monkeypatch, short_rewards) -> None:
    compute = reinforcement.GRPOTrainer._compute_loss
    monkeypatch.setattr(
        reinforcement.GRPOTrainer, "_compute_loss", lambda *args: compute(*args) * torch.nan
    )
    with raises_user_error("non-finite-loss", contains="train.lr"):
        run_reinforce(settings, tmp_path / "run")


def test_responses_without_answers_stop_the_run(settings, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(sampling, "MAX_UNPARSED", 8)
    judge = reinforcement.judge_response
    monkeypatch.setattr(
        reinforcement, "judge_response", lambda *args: replace(judge(*args), letter=None)
    )
    with raises_user_error("nothing-parsed", contains="last 8 sampled responses"):
        run_reinforce(settings, tmp_path / "run")


def test_a_step_needs_enough_items(settings, tmp_path) -> None:
    train = replace(settings.train, batch=1000)
    with raises_user_error("batch-too-large", contains="train.batch=1000"):
        run_reinforce(replace(settings, train=train), tmp_path / "run")
