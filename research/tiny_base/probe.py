"""Measure what the tiny base knows of held-out scenes: read by linear heads, and in its words."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from transformers import PreTrainedModel

from research.tiny_base.collator import OracleCollator
from research.tiny_base.heads import OracleHeads
from research.tiny_base.samples import OracleSample
from research.tiny_base.trace import (
    MIDDLE,
    NAMING,
    SPEAKING,
    encode_pictures,
    select_tokens,
    trace_forward,
    trace_states,
)

BATCH = 16


class Probe:
    """Measures a model and its heads on held-out samples.

    Args:
        samples: Held-out samples without a question.
        worded: Held-out samples by kind of question.
        word_ids: First tokens of words by kind of word.
        bf16: Whether the model computes in bf16.
    """

    def __init__(
        self,
        model: PreTrainedModel,
        heads: OracleHeads,
        collate: OracleCollator,
        samples: Sequence[OracleSample],
        worded: dict[str, Sequence[OracleSample]],
        word_ids: dict[str, list[int]],
        bf16: bool,
    ) -> None:
        self.model, self.heads, self.collate = model, heads, collate
        self.samples, self.worded, self.bf16 = samples, worded, bf16
        self.word_ids = {kind: torch.tensor(ids) for kind, ids in word_ids.items()}

    @torch.no_grad()
    def measure(self, stage: str) -> dict[str, float]:
        """Return the measures of a stage by name."""
        self.model.eval()
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bf16):
            measures = self._read_heads(with_motion=stage != "vision")
            if stage == "words":
                measures |= self._measure_predicted_words()
        return measures

    def _read_heads(self, with_motion: bool) -> dict[str, float]:
        found: dict[str, list[Tensor]] = defaultdict(list)
        for k in range(0, len(self.samples), BATCH):
            batch, targets = self.collate(self.samples[k : k + BATCH])
            if not with_motion:
                tokens, hidden = encode_pictures(self.model, batch), None
            else:
                trace = trace_states(self.model, batch)
                tokens = select_tokens(trace.embedded, targets.visual)
                hidden = select_tokens(trace.outputs[MIDDLE], targets.visual)
            for name, values in self.heads.measures(tokens, hidden, targets).items():
                found[name].append(values.float())
        return average(found)

    def _measure_predicted_words(self) -> dict[str, float]:
        """Return the accuracy of the first token of each kind of word, and of the letters after
        "closest", given the correct words before it, and the errors of what the heads read at names
        and after them."""
        found: dict[str, list[Tensor]] = defaultdict(list)
        for kind, samples in self.worded.items():
            for k in range(0, len(samples), BATCH):
                batch, targets = self.collate(samples[k : k + BATCH])
                labels = batch.pop("labels")[:, 1:]
                language, mask = self.model.model.language_model, batch["attention_mask"]
                with trace_forward(language, mask) as trace:
                    logits = self.model(**batch, use_cache=False).logits
                predicted = logits[:, :-1].argmax(dim=-1)
                for words, ids in self.word_ids.items():
                    of_kind = torch.isin(labels, ids)
                    found[f"words_{words}/{kind}"].append((predicted == labels)[of_kind].float())
                row, before, _ = targets.choices.T
                before = before - (mask.shape[1] - labels.shape[1] - 1)
                chosen = predicted[row, before] == labels[row, before]
                found[f"words_choice/{kind}"].append(chosen.float())
                measures = self.heads.name_measures(trace.outputs[NAMING], targets)
                measures |= self.heads.description_measures(trace.outputs[SPEAKING], targets)
                for name, values in measures.items():
                    found[f"{name}/{kind}"].append(values)
        return average(found)


def average(found: Mapping[str, Sequence[Tensor]]) -> dict[str, float]:
    """Return the mean of the values of each measure that has any."""
    joined = {name: torch.cat([*values]) for name, values in found.items()}
    return {name: values.mean().item() for name, values in joined.items() if len(values)}
