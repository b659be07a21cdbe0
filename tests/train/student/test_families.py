"""Students of other families than Qwen3-VL are trained, resumed, exported and evaluated alike."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from transformers import AutoModelForImageTextToText, AutoProcessor

from dynapix.conf.entry import Run
from dynapix.conf.runs import open_run
from dynapix.conf.schema import (
    ExportModelCommand,
    LoraConfig,
    SelectCommand,
    SftCommand,
    StudentConfig,
)
from dynapix.data.records import LETTERS
from dynapix.evaluation import select
from dynapix.models import loading
from dynapix.models.student.chat_format import find_end_token, write_prompt
from dynapix.models.student.collator import IGNORED, Collator, encode
from dynapix.models.student.prompts import Sample, selection_sample
from dynapix.train import export, sft
from dynapix.train.student.dataset import tokenizer_corpus
from tests.families import FAMILIES, IMAGE_SIZE, save_family
from tests.train.common.test_resume import check_same_weights

END = {
    "qwen2_5_vl": "<|im_end|>", "qwen3_5": "<|im_end|>", "smolvlm": "<end_of_utterance>",
    "internvl": "<|im_end|>", "gemma3": "<end_of_turn>", "llava_onevision": "<|im_end|>",
}  # fmt: skip
"""The token that ends a turn in each family."""
VIDEO = ("qwen2_5_vl", "qwen3_5")
"""Families whose processors tell the times of a clip's frames."""


@pytest.fixture(scope="module", params=FAMILIES)
def family(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def folder(family, micro_store, tmp_path_factory) -> Path:
    corpus = tokenizer_corpus(micro_store, [])
    return save_family(family, corpus, tmp_path_factory.mktemp(family))


@pytest.fixture(scope="module")
def student(family, folder) -> StudentConfig:
    return StudentConfig(
        name=family, model=str(folder), quantization="nf4", lora=LoraConfig(rank=4), frames=4,
        image_size=IMAGE_SIZE, max_length=2000, max_new_tokens=8,
    )  # fmt: skip


@pytest.fixture(scope="module")
def base(student) -> tuple[torch.nn.Module, object]:
    plain = replace(student, quantization="none")
    return loading.load_base(plain, "fp32", list)


def samples(store, frames, count: int, **options: object) -> list[Sample]:
    items = store.selection("train")[:count]
    return [selection_sample(i, "answer", "cot", frames, 4, **options) for i in items]


def test_a_prompt_shows_each_candidate_after_its_letter(family, base, micro_store, frames) -> None:
    """Also in families whose template writes all images before the texts."""
    _, processor = base
    (sample,) = samples(micro_store, frames, 1)
    if family in VIDEO:
        text = write_prompt(sample, processor, thinking=False)
    else:
        ids = encode(sample, processor, None).input_ids
        text = processor.tokenizer.decode(ids)
        seconds = [f"At {k / sample.clip.fps:.2f} s:" for k in sample.clip.indices]
        times = [text.index(time) for time in seconds]
        assert times == sorted(times)
        assert text.index(sample.content[1]["text"].strip()) > times[-1]
    labels = [text.index(f"Candidate {letter}:") for letter in LETTERS]
    assert labels == sorted(labels)
    parts = [text[a:b] for a, b in zip(labels, [*labels[1:], None], strict=True)]
    shown = "<|image_pad|>" if family in VIDEO else "<image"
    shown = {"internvl": "<IMG_CONTEXT>"}.get(family, shown)
    assert all(shown in part for part in parts)


def test_a_response_ends_with_the_token_that_ends_a_turn(family, base, micro_store, frames) -> None:
    _, processor = base
    assert processor.tokenizer.decode([find_end_token(processor)]) == END[family]
    (sample,) = samples(micro_store, frames, 1, response="Answer: B")
    encoded = encode(sample, processor, None)
    supervised = [label for label in encoded.labels if label != IGNORED]
    assert processor.tokenizer.decode(supervised) == f"Answer: B{END[family]}"


def test_special_tokens_are_written_once(base, micro_store, frames) -> None:
    _, processor = base
    (sample,) = samples(micro_store, frames, 1)
    ids = encode(sample, processor, None).input_ids
    start = processor.tokenizer.decode(ids[:2])
    assert len(set(ids[:2])) == 2, start


def test_times_reach_the_model(family, base, micro_store, frames) -> None:
    """A slower clip of the same frames is another input."""
    _, processor = base
    (sample,) = samples(micro_store, frames, 1)
    slow = replace(sample, clip=replace(sample.clip, fps=sample.clip.fps / 2))
    fast, slow = (Collator(processor, None)([s]) for s in (sample, slow))
    assert any(
        fast[name].shape != slow[name].shape or not torch.equal(fast[name], slow[name])
        for name in fast
    )
    if family == "qwen2_5_vl":
        steps = np.diff(sample.clip.indices).mean()
        expected = 2 * steps / sample.clip.fps
        assert fast["second_per_grid_ts"].tolist() == pytest.approx([expected], rel=1e-6)


@torch.inference_mode()
def test_a_sample_has_the_same_logits_alone_and_in_a_batch(base, micro_store, frames) -> None:
    model, processor = base
    several = samples(micro_store, frames, 3, response="Answer: C")
    # A longer response pads the others, and a prompt without a clip has fewer pictures.
    several[0] = replace(several[0], response="The sphere is near the top.\nAnswer: A")
    content = [part for part in several[1].content if part["type"] != "video"]
    several[1] = replace(several[1], content=content, clip=None)
    collator = Collator(processor, None)
    batch = collator(several)
    together = model.eval()(**batch).logits
    for k, sample in enumerate(several):
        alone = model(**collator([sample])).logits[0]
        torch.testing.assert_close(together[k, -len(alone) :], alone, atol=2e-5, rtol=2e-4)


@pytest.mark.slow
def test_a_student_is_trained_resumed_exported_and_evaluated(
    few_steps, student, micro_store, tmp_path
) -> None:
    settings = replace(few_steps(reuse_features=True, generated_items=1), student=student)
    whole, resumed = tmp_path / "sft" / "whole", tmp_path / "sft" / "resumed"
    train(settings, whole)
    shutil.copytree(whole / "checkpoint-2", resumed / "checkpoint-2")
    train(settings, resumed)
    check_same_weights(*(f / "student" / "adapter_model.safetensors" for f in (whole, resumed)))
    adapters = load_file(whole / "student" / "adapter_model.safetensors")
    assert adapters
    assert all(".layers." in n and "vision" not in n and "visual" not in n for n in adapters)

    arguments = {"store": settings.store, "checkpoints": str(tmp_path), "workers": 1}
    exported = tmp_path / "exported"
    exported.mkdir()
    cfg = ExportModelCommand(run="whole", format="fp32", **arguments)
    export.main.__wrapped__(cfg, Run("whole/fp32", exported))
    AutoModelForImageTextToText.from_pretrained(exported / "student")
    AutoProcessor.from_pretrained(exported / "student")

    answers = []
    for model in (whole, exported / "student"):
        cfg = SelectCommand(
            benchmark=settings.benchmark, student=student, store=settings.store, model=str(model),
            batch=2, limit=2, modes=["reasoning", "answer"],
        )  # fmt: skip
        evaluated = tmp_path / "select" / str(len(answers))
        evaluated.mkdir(parents=True)
        select.main.__wrapped__(cfg, Run(evaluated.name, evaluated))
        lines = map(json.loads, (evaluated / "answers.jsonl").read_text().splitlines())
        answers.append({(x["item_id"], x["mode"]): x["text"] for x in lines if "item_id" in x})
    assert answers[0] == answers[1]
    assert len(answers[0]) == 4


def train(settings: SftCommand, folder: Path) -> None:
    folder.mkdir(exist_ok=True, parents=True)
    open_run(run := Run(folder.name, folder), asdict(settings), "train.sft")
    (folder / "metrics.json").write_text(json.dumps(sft.main.__wrapped__(settings, run)))
