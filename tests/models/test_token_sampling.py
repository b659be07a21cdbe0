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


@pytest.mark.parametrize(
    ("settings", "count"),
    [({"temperature": 0.6}, 6), ({"temperature": 2.0}, 6), ({"top_k": 3}, 3), ({"top_p": 0.8}, 3)],
)
def test_tokens_are_sampled_from_the_softmax_of_the_most_likely(settings, count) -> None:
    """The first two tokens have a probability of 0.77, and the first three of more than 0.8."""
    seeds = 20_000
    steps = sampling_processors(sampling_cfg(**settings), range(seeds))
    scores = LOGITS.expand(seeds, -1).clone()
    tokens = steps(torch.zeros(seeds, 1, dtype=torch.long), scores).argmax(1)
    shares = torch.softmax(LOGITS[:count] / settings.get("temperature", 1.0), 0).tolist()
    expected = [*shares, *[0] * (len(LOGITS) - count)]
    assert np.bincount(tokens, minlength=len(LOGITS)) / seeds == pytest.approx(expected, abs=0.015)
    # Without a temperature, decoding is greedy.
    assert not sampling_processors(StudentConfig(name="any", model="any"), [0])


def test_a_response_depends_on_its_seed_and_not_on_its_batch(
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


def test_the_template_and_not_the_generation_config_of_a_model_has_an_effect(
    micro_store, frames, model, processor
) -> None:
    """A think tag that the template opens begins the text."""
    thinker = deepcopy(processor)
    thinker.chat_template += "{{ '<think>\n' if enable_thinking else '<think>\n\n</think>\n\n' }}"
    sample = selection_sample(micro_store.selection("train")[0], "answer", "cot", frames, 4)
    for thinking in (True, False):
        inputs = Collator(thinker, 1500, thinking)([sample])
        [response] = generate(model.eval(), thinker, inputs, 4, "fp32")
        assert response.text.startswith("<think>") == thinking
        assert response.truncated

    batch = Collator(processor, 1500)([sample])
    [plain] = generate(model, processor, batch, 12, "fp32")
    own = model.generation_config = deepcopy(model.generation_config)
    own.update(
        repetition_penalty=5.0, no_repeat_ngram_size=1, do_sample=True, temperature=9.0, top_k=3,
        suppress_tokens=[plain.ids[0]],
    )  # fmt: skip
    assert generate(model, processor, batch, 12, "fp32") == [plain]
    assert model.generation_config is own
    assert model.generate(**batch, max_new_tokens=12)[0, -12:].tolist() != list(plain.ids)
