"""Measure what the tiny base knows of held-out scenes: read by linear heads, in the words that it
predicts, and in the answers that it generates, whose claims are compared with the oracle.

generated_name_precision/parse   share of the names in answers to `parse` that an object of the
                                 scene has
generated_color/parse            share of the names whose colour is that of the object with which
                                 the name shares most words; likewise for material and shape
generated_name_recall/parse      share of the objects named in the true answers to `parse` that the
                                 generated ones name too
generated_moving/parse           share of the statements about an object's speed at the cut that say
                                 rightly whether the object moves
generated_heading/parse          share of the headings stated of moving objects at the cut that are
                                 right
generated_region/predict         share of the claims about regions in answers to `predict` that the
                                 oracle supports, of those that it can decide; likewise for other
                                 kinds of claims
generated_outcome/explain        share of the answers to `explain` that name a closest candidate, of
                                 those whose true answers do
generated_choice/explain         share of these in which the candidate is the one that shows the
                                 named object closest to its place at the target
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import dist, inf

import torch
from torch import Tensor
from transformers import PreTrainedModel, ProcessorMixin

from dynapix.conf.schema import StudentConfig
from dynapix.data.records import LETTERS, SelectionItem
from dynapix.models.student.collator import Collator
from dynapix.models.student.generation import generate
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.facts import Predicates
from dynapix.teacher.predicates.relations import Places
from dynapix.teacher.reading.claims import CUT, Claim
from dynapix.teacher.validation.claim_extraction import extract_claims
from research.tiny_base.collator import OracleCollator
from research.tiny_base.heads import OracleHeads
from research.tiny_base.mentions import CLOSEST, NAME
from research.tiny_base.oracle_targets import WORDS
from research.tiny_base.questions import Question
from research.tiny_base.samples import ItemSampler, OracleSample
from research.tiny_base.trace import MIDDLE, encode_pictures, select_tokens, trace_states

BATCH = 16
SECTION_PREFIXES = {"parse": "", "predict": "", "describe": "Candidate analysis: "}
"""The kinds of questions whose answers are read, and what they lack to be read as sections of a
rationale. Answers to `compare` state predictions that need not be true. `explain` repeats what the
other kinds ask for; of its answers, only the outcome is read."""


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
        "closest", given the correct words before it."""
        found: dict[str, list[Tensor]] = defaultdict(list)
        for kind, samples in self.worded.items():
            for k in range(0, len(samples), BATCH):
                batch, targets = self.collate(samples[k : k + BATCH])
                labels = batch.pop("labels")[:, 1:]
                length = batch["input_ids"].shape[1]
                logits = self.model(**batch, use_cache=False).logits
                predicted = logits[:, :-1].argmax(dim=-1)
                for words, ids in self.word_ids.items():
                    of_kind = torch.isin(labels, ids)
                    found[f"words_{words}/{kind}"].append((predicted == labels)[of_kind].float())
                row, before, _ = targets.choices.T
                before = before - (length - labels.shape[1] - 1)
                chosen = predicted[row, before] == labels[row, before]
                found[f"words_choice/{kind}"].append(chosen.float())
        return average(found)


def average(found: Mapping[str, Sequence[Tensor]]) -> dict[str, float]:
    """Return the mean of the values of each measure that has any."""
    joined = {name: torch.cat([*values]) for name, values in found.items()}
    return {name: values.mean().item() for name, values in joined.items() if len(values)}


def measure_generated_answers(
    model: PreTrainedModel,
    processor: ProcessorMixin,
    sampler: ItemSampler,
    items: Sequence[SelectionItem],
    student: StudentConfig,
    precision: str,
) -> dict[str, float]:
    """Return the measures of answers about held-out items, by name."""
    collate = Collator(processor, student.max_length)
    model.eval()
    found: dict[str, list[bool]] = defaultdict(list)
    for kind in (*SECTION_PREFIXES, "explain"):
        for k in range(0, len(items), BATCH):
            asked = [sampler.ask_question(item, kind, "held out") for item in items[k : k + BATCH]]
            samples = [
                replace(sampler.show_question(item, question).sample, response=None)
                for item, question in asked
            ]
            batch = collate(samples)
            texts = generate(model, processor, batch, student.max_new_tokens, precision)
            for (item, question), text in zip(asked, texts, strict=True):
                if kind == "explain":
                    read = _read_outcome(text.text, item, question, sampler)
                else:
                    read = _read(SECTION_PREFIXES[kind] + text.text, item, kind, sampler)
                    names = set(NAME.findall(text.text))
                    true_names = set(NAME.findall(question.answer))
                    read += [("name_recall", name in names) for name in true_names]
                for name, right in read:
                    found[f"generated_{name}/{kind}"].append(right)
    return {name: sum(values) / len(values) for name, values in found.items()}


def _read_outcome(
    text: str, item: SelectionItem, question: Question, sampler: ItemSampler
) -> list[tuple[str, bool]]:
    """Return whether an answer to `explain` names a closest candidate, and whether it is right. If
    the true answer names none, nothing is returned."""
    if not CLOSEST.search(question.answer):
        return []
    outcome = CLOSEST.search(text)
    if outcome is None:
        return [("outcome", False)]
    shown = [*item.candidates]
    if question.instead is not None:
        shown[item.answer] = question.instead
    scene = sampler.frames.scene
    name = outcome["name"]
    target = Places.from_frame(scene(item.scene_id), item.target_frame).image.get(name)
    places = [Places.from_frame(scene(c.scene_id), c.frame).image.get(name) for c in shown]
    distances = [dist(target, place) if target and place else inf for place in places]
    chosen = distances[LETTERS.index(outcome["letter"])] if outcome["letter"] in LETTERS else inf
    return [("outcome", True), ("choice", chosen == min(distances) < inf)]


def _read(
    text: str, item: SelectionItem, kind: str, sampler: ItemSampler
) -> list[tuple[str, bool]]:
    """Return what an answer says, by the kind of word or claim, and whether it is right."""
    scene = sampler.frames.scene
    predicates = extract_predicates(item, scene(item.scene_id), scene)
    claims = [c for c in extract_claims(text, predicates) if c.kind != "mention"]
    decided = [c for c in claims if c.verdict != "unknown"]
    read = [(claim.kind, claim.verdict == "supported") for claim in decided]
    read += _read_motions(claims, predicates)
    objects = _scene_names(item, kind, sampler)
    for match in NAME.finditer(text):
        said = match.group().split()
        # The object with most words in common is the one that is meant.
        closest = max(objects, key=lambda o: sum(a == b for a, b in zip(o, said, strict=True)))
        equal = [a == b for a, b in zip(closest, said, strict=True)]
        read += [*zip(WORDS, equal, strict=True), ("name_precision", all(equal))]
    return read


def _read_motions(claims: Sequence[Claim], predicates: Predicates) -> list[tuple[str, bool]]:
    """Return what claims say of the motion of single objects at the cut, and whether it is right:
    whether each object moves, and the heading of those that move. Names are unique in a scene."""
    facts = {each.object: each for each in predicates.objects}
    read = []
    for claim in claims:
        if claim.when != CUT or claim.candidate is not None or not claim.affirmed:
            continue
        own = facts.get(claim.subjects[0]) if len(claim.subjects) == 1 else None
        if own is None or own.speed is None:
            continue
        moves = own.speed != "stationary"
        if claim.kind in ("speed", "still"):
            is_said_still = claim.kind == "still" or claim.value == "stationary"
            read.append(("moving", moves != is_said_still))
        if claim.kind == "direction" and moves and own.heading is not None:
            read.append(("heading", claim.value == own.heading))
    return read


def _scene_names(item: SelectionItem, kind: str, sampler: ItemSampler) -> list[list[str]]:
    """Return the words of the names of all objects in the scenes that a kind of question shows."""
    shows_candidates = kind == "describe"
    scenes = {c.scene_id for c in item.candidates} if shows_candidates else {item.scene_id}
    names = {o.noun_phrase for scene in scenes for o in sampler.frames.scene(scene).objects}
    return [name.split() for name in sorted(names)]
