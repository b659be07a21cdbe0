"""Sampling of responses: temperature, restriction to the most likely tokens, and seeds."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
import torch

from dynapix.conf.schema import StudentConfig
from dynapix.models.student.collator import Collator
from dynapix.models.student.generation import generate, sampling_processors
from dynapix.models.student.prompts import selection_sample

LOGITS = torch.tensor([2.0, 1.0, 0.5, 0.0, -1.0, -3.0])


def sampling_cfg(**changes: object) -> StudentConfig:
    return StudentConfig(name="any", model="any", **{"temperature": 1.0, **changes})


def frequencies(cfg: StudentConfig, count: int = 20_000) -> np.ndarray:
    """Return the relative frequency of each token among samples with `count` seeds."""
    steps = sampling_processors(cfg, range(count))
    scores = LOGITS.expand(count, -1).clone()
    tokens = steps(torch.zeros(count, 1, dtype=torch.long), scores).argmax(1)
    return np.bincount(tokens, minlength=len(LOGITS)) / count


@pytest.mark.parametrize("temperature", [0.6, 1.0, 2.0])
def test_tokens_are_sampled_from_the_softmax(temperature) -> None:
    share = torch.softmax(LOGITS / temperature, 0).numpy()
    assert frequencies(sampling_cfg(temperature=temperature)) == pytest.approx(share, abs=0.015)


def test_only_the_most_likely_tokens_are_sampled() -> None:
    share = torch.softmax(LOGITS[:3], 0).tolist()
    assert frequencies(sampling_cfg(top_k=3)) == pytest.approx([*share, 0, 0, 0], abs=0.015)
    # The first two tokens have a probability of 0.77, and the first three of more than 0.8.
    assert frequencies(sampling_cfg(top_p=0.8)) == pytest.approx([*share, 0, 0, 0], abs=0.015)


def test_a_row_depends_on_its_seed_only() -> None:
    cfg, ids = sampling_cfg(), torch.zeros(3, 1, dtype=torch.long)
    steps = {seeds: sampling_processors(cfg, seeds) for seeds in ((5, 6, 7), (6,), (7, 6, 5))}
    for _ in range(20):
        rows = {
            seeds: step(ids[: len(seeds)], LOGITS.expand(len(seeds), -1).clone())
            for seeds, step in steps.items()
        }
        assert torch.equal(rows[5, 6, 7][1], rows[6,][0])
        assert torch.equal(rows[5, 6, 7][0], rows[7, 6, 5][2])
        assert not torch.equal(rows[5, 6, 7][0], rows[5, 6, 7][1])


def test_decoding_without_a_temperature_is_greedy() -> None:
    assert not sampling_processors(StudentConfig(name="any", model="any"), [0])


def test_a_response_is_independent_of_its_batch(
    model, processor, micro_store, frames, student_cfg
) -> None:
    items = micro_store.selection("test")[:4]

    def responses(group: list[int], seed: int = 0) -> list[str]:
        samples = [
            selection_sample(items[k], "answer", "cot", frames, student_cfg.frames) for k in group
        ]
        steps = sampling_processors(sampling_cfg(top_k=50), [100 * seed + k for k in group])
        inputs = Collator(processor, 1500)(samples)
        return [r.text for r in generate(model.eval(), processor, inputs, 12, "fp32", steps)]

    together = responses([0, 1, 2, 3])
    assert responses([2]) + responses([3, 0]) == [together[k] for k in (2, 3, 0)]
    assert len(set(together)) == 4
    assert responses([0, 1, 2, 3], seed=1) != together


@pytest.mark.parametrize("thinking", [True, False])
def test_a_think_tag_that_the_prompt_opens_begins_the_text(
    thinking, model, processor, micro_store, frames, student_cfg
) -> None:
    thinker = deepcopy(processor)
    thinker.chat_template += "{{ '<think>\n' if enable_thinking else '<think>\n\n</think>\n\n' }}"
    [item, *_] = micro_store.selection("test")
    sample = selection_sample(item, "answer", "cot", frames, student_cfg.frames)
    [response] = generate(
        model.eval(), thinker, Collator(thinker, 1500, thinking)([sample]), 4, "fp32"
    )
    assert response.text.startswith("<think>") == thinking
    assert response.truncated


def test_the_generation_config_of_a_model_has_no_effect(
    micro_store, frames, student_cfg, model, processor
) -> None:
    item = micro_store.selection("train")[0]
    batch = Collator(processor, 1500)([selection_sample(item, "answer", "cot", frames, 4)])
    [plain] = generate(model, processor, batch, 12, "fp32")
    own = model.generation_config = deepcopy(model.generation_config)
    own.update(
        repetition_penalty=5.0, no_repeat_ngram_size=1, do_sample=True, temperature=9.0, top_k=3,
        suppress_tokens=[plain.ids[0]],
    )  # fmt: skip
    assert generate(model, processor, batch, 12, "fp32") == [plain]
    assert model.generation_config is own
    assert model.generate(**batch, max_new_tokens=12)[0, -12:].tolist() != list(plain.ids)
