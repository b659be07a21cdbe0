"""Loading a student returns the model of its preset, or raises an error that names the problem."""

from __future__ import annotations

import copy
import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dynapix.conf.compose import compose
from dynapix.conf.schema import SftCommand
from dynapix.models import compat, loading
from dynapix.models.student.collator import Collator
from dynapix.models.student.prompts import selection_sample
from dynapix.models.towers import check_parameter_counts, count_parameters
from dynapix.train.student.trainer import token_mean
from tests.tiny_models import randomize_adapters
from tests.user_errors import raises_user_error


@pytest.fixture
def sample(micro_store, frames, nf4_cfg):
    item = micro_store.selection("train")[0]
    return selection_sample(item, "answer", "cot", frames, nf4_cfg.frames, "Answer: A")


def test_only_the_language_tower_is_trained_also_after_an_evaluation(nf4_cfg, sample) -> None:
    """It is quantised and adapted. On some CPUs, bitsandbytes repacks 4-bit weights for an
    evaluation, after which no gradients pass through them."""
    model, processor = loading.load_student(nf4_cfg, "bf16", list)
    counts = count_parameters(model)
    check_parameter_counts(counts, "nf4", "nf4", nf4_cfg.lora.rank)
    hidden, forward, rank = 64, 128, 4
    layer = 4 * hidden * hidden + 3 * hidden * forward
    lora = rank * (4 * 2 * hidden + 3 * (hidden + forward))
    kinds = ["4-bit", "LoRA", "trainable"]
    assert counts.loc["language", kinds].tolist() == [2 * layer, 2 * lora, 2 * lora]
    assert counts.loc["vision", ["4-bit", "trainable"]].tolist() == [0, 0]
    trained = [p for p in model.parameters() if p.requires_grad]
    assert {p.dtype for p in trained} == {torch.float32}

    batch = Collator(processor, 1500)([sample])
    labels = batch.pop("labels")

    def gradients() -> list[torch.Tensor]:
        model.zero_grad()
        with torch.autocast("cpu", torch.bfloat16):
            token_mean(model.train()(**batch), labels).backward()
        return [p.grad.clone() for p in trained]

    before = gradients()
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        model.eval()(**batch)
    for one, two in zip(before, gradients(), strict=True):
        torch.testing.assert_close(one, two)


def test_saved_adapters_give_the_same_logits_and_name_their_base(
    nf4_cfg, sample, tmp_path, monkeypatch
) -> None:
    """They name the place where the base is now, also from another directory and if they are
    trained further. A save needs no look at the hub."""

    def look_up(*_: object) -> None:
        raise AssertionError("a save needs no network")

    monkeypatch.setattr("peft.utils.save_and_load.check_file_exists_on_hf_hub", look_up)
    base, folder = Path(nf4_cfg.model), tmp_path / "student"
    monkeypatch.chdir(base.parent)
    cfg = replace(nf4_cfg, model=base.name)
    model, processor = loading.load_student(cfg, "fp32", list)
    randomize_adapters(model, 0.1)
    loading.save_student(model, processor, folder, "fp32")
    settings = json.loads((folder / "adapter_config.json").read_text())
    assert settings["base_model_name_or_path"] == str(base)
    again, reader = loading.load_trained(nf4_cfg, "fp32", folder)
    batch = Collator(reader, 1500)([replace(sample, response=None)])
    # Some CPUs round 4-bit products differently once the weights are packed for inference.
    compat.keep_differentiable(again)
    with torch.no_grad():
        one, two = model.eval()(**batch).logits, again(**batch).logits
    torch.testing.assert_close(one, two, atol=1e-5, rtol=0)

    settings["base_model_name_or_path"] = "/gone"
    (folder / "adapter_config.json").write_text(json.dumps(settings))
    further, _ = loading.load_trainable(cfg, "fp32", folder)
    assert further.peft_config["default"].base_model_name_or_path == str(base)
    for each in (model, further):
        each.peft_config["default"].base_model_name_or_path = "acme/tiny"
        each.save_pretrained(tmp_path / "saved")
    assert (tmp_path / "saved" / "adapter_model.safetensors").exists()


@pytest.mark.parametrize("local_rank", ["0", "1"])
def test_one_rank_of_a_sharded_training_loads_the_weights(nf4_cfg, monkeypatch, local_rank) -> None:
    """An evaluation that accelerate starts in the same way has all weights."""
    for name in ("ACCELERATE_USE_FSDP", "FSDP_CPU_RAM_EFFICIENT_LOADING"):
        monkeypatch.setenv(name, "true")
    monkeypatch.setenv("LOCAL_RANK", local_rank)
    plain = replace(nf4_cfg, quantization="none")
    model, _ = loading.load_student(plain, "fp32", list)
    for weight in model.parameters():
        # accelerate needs the trained weights of all ranks.
        has_values = weight.requires_grad or local_rank == "0"
        assert weight.device.type == ("cpu" if has_values else "meta")
    base, _ = loading.load_base(plain, "fp32", list)
    assert {weight.device.type for weight in base.parameters()} == {"cpu"}


def test_an_error_names_a_model_that_cannot_be_loaded(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    cfg = compose("train.sft", SftCommand, ["student=qwen3_vl_8b"]).student
    with raises_user_error("missing-model", contains="student.model=FOLDER"):
        loading.load_student(cfg, "bf16", list)
    (tmp_path / "empty").mkdir()
    with raises_user_error("unloadable-model"):
        loading.load_student(replace(cfg, model=str(tmp_path / "empty")), "bf16", list)


def test_a_frame_has_one_size_in_images_and_clips(processor) -> None:
    """Also at native 192 x 128, at other aspect ratios, and in clips of other lengths."""
    processor = copy.deepcopy(processor)
    sizes = [(192, 128), (128, 192), (480, 320), (64, 32), (640, 96), (40, 300)]
    for edge, frames in itertools.product((96, 120, 336), (2, 3, 7, 12, 16)):
        loading.pin_sizes(processor, edge, 12)
        for width, height in [*sizes, (edge, edge)]:
            frame = np.zeros((height, width, 3), np.uint8)
            image = processor.image_processor([frame], return_tensors="pt").image_grid_thw[0]
            clip = processor.video_processor([np.stack([frame] * frames)], return_tensors="pt")
            assert clip.video_grid_thw[0, 1:].tolist() == image[1:].tolist(), (edge, width, height)
        assert image[1:].tolist() == [2 * round(edge / 32)] * 2
