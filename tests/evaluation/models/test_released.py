"""Released embedders, as tiny models of their real architectures."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from peft import PeftModel
from safetensors.torch import load_file, save_file
from transformers import AutoModel, AutoProcessor, CLIPModel, Qwen2VLForConditionalGeneration

from dynapix.conf.entry import Run
from dynapix.conf.errors import UserError
from dynapix.conf.files import read_json_lines
from dynapix.conf.schema import (
    ContrastiveTrainConfig,
    LoraConfig,
    RetrieverConfig,
    SimilarityCommand,
)
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import FPS, FRAMES, LETTERS, FrameRef, sample_prefix_frames
from dynapix.evaluation import similarity
from dynapix.evaluation.embedders.dual_encoder import unit_rows
from dynapix.evaluation.embedders.embedder import EMBEDDINGS
from dynapix.evaluation.embedders.joint_encoder import load_encoder
from dynapix.evaluation.embedders.languagebind import LanguageBindVideo, spread
from dynapix.evaluation.metrics.selection import choose_letters, credit_choices
from tests.evaluation.models import released
from tests.user_errors import raises_user_error

KINDS = ("clip", "siglip2", "languagebind", "vlm2vec")
INSTRUCTIONS = {
    "query_instruction": "Represent the given video with the following question:",
    "frame_instruction": "Represent the given image.",
}


@pytest.fixture(scope="module")
def presets(tmp_path_factory) -> dict[str, RetrieverConfig]:
    root = tmp_path_factory.mktemp("released")
    videos, images = released.languagebind(root / "videos", root / "images")
    settings = {
        "clip": {"encoder": "dual", "model": released.clip(root / "clip"), "widths": [24]},
        "siglip2": {"encoder": "dual", "model": released.siglip2(root / "siglip2")},
        "languagebind": {
            "encoder": "languagebind", "model": videos, "image_model": str(images), "widths": [24],
        },
        "vlm2vec": {
            "encoder": "vlm2vec", "model": released.vlm2vec(root / "base", root / "adapters"),
            **INSTRUCTIONS,
        },
    }  # fmt: skip
    shared = {
        "quantization": "none", "lora": LoraConfig(rank=0), "image_size": released.IMAGE_SIZE,
        "frames": released.CLIP_FRAMES, "widths": [32],
    }  # fmt: skip
    return {
        name: RetrieverConfig(name=name, **{**shared, **own, "model": str(own["model"])})
        for name, own in settings.items()
    }


@pytest.fixture(scope="module")
def frames(micro_store) -> FrameReader:
    return FrameReader(micro_store, released.IMAGE_SIZE)


def load(preset: RetrieverConfig):
    return load_encoder(preset, "fp32", None)


@pytest.mark.parametrize("kind", KINDS)
def test_an_embedding_is_independent_of_its_batch(kind, presets, frames, micro_store) -> None:
    encoder, queries = load(presets[kind]), micro_store.standard_test()[:4]
    targets = [q.target for q in queries]
    for embed in (
        lambda some: encoder.embed_queries(some, frames),
        lambda some: encoder.embed_texts([q.question for q in some]),
    ):
        together = embed(queries)
        alone = np.concatenate([embed([query]) for query in queries])
        np.testing.assert_allclose(together, alone, atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(together, axis=1), 1, atol=1e-5)
    together = encoder.embed_frames(targets, frames)
    np.testing.assert_allclose(
        together[::-1], encoder.embed_frames(targets[::-1], frames), atol=1e-5
    )
    assert len(np.unique(together.round(5), axis=0)) == len(set(targets))


@pytest.mark.parametrize("kind", ["clip", "siglip2"])
def test_a_query_is_the_sum_of_its_prefix_and_its_question(
    kind, presets, frames, micro_store
) -> None:
    preset, query = presets[kind], micro_store.standard_test()[0]
    model = AutoModel.from_pretrained(preset.model)
    processor = AutoProcessor.from_pretrained(preset.model)
    prefix = sample_prefix_frames(query.prefix_start, query.prefix_stop, preset.frames)
    inputs = processor(
        text=[query.question.lower()], images=[frames.image(query.scene_id, f) for f in prefix],
        padding="max_length", max_length=model.config.text_config.max_position_embeddings,
        truncation=True, return_tensors="pt",
    )  # fmt: skip
    with torch.no_grad():
        # The embeddings that the model's `forward` returns have length 1.
        output = model(input_ids=inputs["input_ids"], pixel_values=inputs["pixel_values"])
    mean = unit_rows(output.image_embeds.mean(0, keepdim=True).numpy())
    expected = unit_rows(mean + output.text_embeds.numpy())
    encoder = load(preset)
    np.testing.assert_allclose(encoder.embed_queries([query], frames), expected, atol=1e-4)
    np.testing.assert_allclose(encoder.embed_texts([query.question]), output.text_embeds, atol=1e-4)


def test_languagebind_without_attention_over_time_is_clip(presets, frames, micro_store) -> None:
    preset, query = presets["languagebind"], micro_store.standard_test()[0]
    video = LanguageBindVideo.from_pretrained(preset.model)
    pixels = torch.randn(2 * released.CLIP_FRAMES, 3, released.IMAGE_SIZE, released.IMAGE_SIZE)
    plain = CLIPModel(video.config).eval()
    loaded = plain.load_state_dict(video.state_dict(), strict=False)
    assert not loaded.missing_keys
    with torch.no_grad():
        with_time = video.eval().get_image_features(pixels).pooler_output
        # A clip does not attend over the frames of another clip.
        second_clip = video.get_image_features(pixels[released.CLIP_FRAMES :]).pooler_output
        torch.testing.assert_close(with_time[released.CLIP_FRAMES :], second_clip)
        for layer in video.vision_model.encoder.layers:
            layer.temporal_embedding.zero_()
            layer.temporal_attn.out_proj.weight.zero_()
            layer.temporal_attn.out_proj.bias.zero_()
        without_time = video.get_image_features(pixels).pooler_output
        torch.testing.assert_close(without_time, plain.get_image_features(pixels).pooler_output)
    assert (with_time - without_time).abs().max() > 1e-3

    # The order of frames matters, and a short prefix repeats some frames.
    encoder = load(preset)
    clip = frames.stack(query.scene_id, [0, 10, 20, 30])
    assert np.abs(encoder.embed_clips([clip]) - encoder.embed_clips([clip[::-1]])).max() > 1e-5
    np.testing.assert_allclose(
        encoder.embed_clips([clip[:2]]), encoder.embed_clips([clip[[0, 0, 1, 1]]])
    )
    assert spread(8, 4) == [0, 2, 5, 7]


def test_vlm2vec_reads_media_at_text_positions_without_start_tokens(
    presets, frames, micro_store
) -> None:
    preset, query = presets["vlm2vec"], micro_store.standard_test()[0]
    base = json.loads((Path(preset.model) / "adapter_config.json").read_text())
    plain = Qwen2VLForConditionalGeneration.from_pretrained(base["base_model_name_or_path"])
    model = PeftModel.from_pretrained(plain, preset.model).merge_and_unload().eval()
    processor = AutoProcessor.from_pretrained(preset.model)
    prefix = sample_prefix_frames(query.prefix_start, query.prefix_stop, preset.frames)
    clip = torch.from_numpy(frames.stack(query.scene_id, prefix)).permute(0, 3, 1, 2)
    times = {"fps": float(FPS), "total_num_frames": FRAMES, "frames_indices": prefix}
    video = processor(
        text=[f"<|video_pad|> {INSTRUCTIONS['query_instruction']} {query.question}"], videos=[clip],
        do_sample_frames=False, video_metadata=[times], return_tensors="pt",
        videos_kwargs={
            "size": {"shortest_edge": 28 * 28, "longest_edge": 8 * released.IMAGE_SIZE**2}
        },
    )  # fmt: skip
    image = processor(
        text=[f"<|image_pad|> {INSTRUCTIONS['frame_instruction']}"],
        images=[frames.image(query.scene_id, prefix[0])], return_tensors="pt",
    )  # fmt: skip
    encoder, frame = load(preset), FrameRef(query.scene_id, prefix[0])
    embedded = encoder.embed_queries([query], frames), encoder.embed_frames([frame], frames)
    for inputs, embedding in zip((video, image), embedded, strict=True):
        # Equal positions in time, height and width, as text has them.
        positions = torch.arange(inputs["input_ids"].shape[1]).expand(3, 1, -1)
        with torch.no_grad():
            output = model(**inputs, position_ids=positions, output_hidden_states=True)
        last = unit_rows(output.hidden_states[-1][:, -1].numpy())
        np.testing.assert_allclose(embedding, last, atol=1e-4)


@pytest.fixture
def measure(tmp_path, micro, micro_store) -> Callable[..., dict]:
    shutil.copytree(micro_store.folder, tmp_path / "store" / "micro")
    shutil.rmtree(tmp_path / "store" / "micro" / EMBEDDINGS, ignore_errors=True)

    def run(command, settings: type, preset: RetrieverConfig, name: str) -> dict:
        folder = tmp_path / name
        folder.mkdir()
        cfg = settings(
            benchmark=micro,
            retriever=preset,
            store=str(tmp_path / "store"),
            batch=16,
            train=ContrastiveTrainConfig(precision="fp32"),
        )
        command.main.__wrapped__(cfg, Run(name, folder))
        return json.loads((folder / "report.json").read_text())

    return run


def test_the_nearest_candidate_is_chosen_and_embeddings_are_computed_once(
    measure, presets, frames, micro_store, tmp_path
) -> None:
    preset = replace(
        presets["clip"], model=str(shutil.copytree(presets["clip"].model, tmp_path / "clip"))
    )
    report = measure(similarity, SimilarityCommand, preset, "first")
    items, encoder = micro_store.selection("test"), load(preset)
    query_rows = encoder.embed_queries(items, frames).astype(float)
    candidates = np.stack([encoder.embed_frames(list(item.candidates), frames) for item in items])
    scores = np.einsum("id,icd->ic", query_rows, candidates)
    right = scores.argmax(1) == [item.answer for item in items]
    (row,) = report["rows"]
    assert (row["name"], row["mode"], row["n"]) == ("clip", "similarity", len(items))
    assert row["micro"]["value"] == pytest.approx(right.mean())
    for family, accuracy in row["families"].items():
        in_family = [item.family == family for item in items]
        assert accuracy["value"] == pytest.approx(right[in_family].mean())
    assert set(report["subtypes"]["clip"]) == {f"{i.family}/{i.subtype}" for i in items}
    stored = list(read_json_lines(tmp_path / "first" / "scores.jsonl"))
    assert [row["item_id"] for row in stored] == [item.item_id for item in items]
    assert np.array([row["scores"] for row in stored]) == pytest.approx(scores, abs=1e-5)
    text = (tmp_path / "first" / "report.txt").read_text()
    assert "SigLIP 2" in text
    assert all(subtype in text for subtype in report["subtypes"]["clip"])
    # A second evaluation loads no model: without config.json, the model could not be loaded.
    (tmp_path / "clip" / "config.json").unlink()
    assert measure(similarity, SimilarityCommand, preset, "second") == report


def test_tied_candidates_share_the_credit() -> None:
    scores = np.array([[1, 1, 0, 0], [1, 1, 1, 1], [0, 2, 1, 0], [3, 3, 3, 4]], np.float32)
    assert credit_choices(scores, [1, 0, 1, 0]).tolist() == [0.5, 0.25, 1, 0]


def test_a_tie_is_not_a_choice() -> None:
    rng = np.random.default_rng(0)
    scores, answers = rng.integers(3, size=(200, 4)).astype(np.float32), rng.integers(4, size=200)
    chosen = choose_letters(scores)
    # The chosen letter is right exactly where the credit is 1.
    credits = credit_choices(scores, answers)
    right = [c == LETTERS[a] for c, a in zip(chosen, answers, strict=True)]
    assert right == (credits == 1).tolist()


def delete_file(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def drop_weight(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    weights.pop("text_projection.weight")
    save_file(weights, folder / "model.safetensors", {"format": "pt"})


@pytest.mark.parametrize(
    ("damage", "codes"),
    [
        (delete_file("model.safetensors"), ["unloadable-model"]),
        (delete_file("tokenizer.json"), ["unloadable-model", "incomplete-model"]),
        (delete_file("processor_config.json"), ["unloadable-model", "incomplete-model"]),
        (drop_weight, ["incomplete-model"]),
        (lambda folder: (folder / "config.json").write_text("{"), ["unloadable-model"]),
    ],
)
def test_an_incomplete_model_is_refused(damage, codes, presets, tmp_path) -> None:
    folder = shutil.copytree(presets["clip"].model, tmp_path / "clip")
    damage(folder)
    with pytest.raises(UserError) as caught:
        load(replace(presets["clip"], model=str(folder)))
    assert caught.value.code in codes
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "changes", "code", "contains"),
    [
        ("clip", {"model": "languagebind"}, "unloadable-model", "retriever.model="),
        ("clip", {"image_size": 28}, "wrong-image-size", "set retriever.image_size=56"),
        ("clip", {"model": "no/such-model"}, "missing-model", "no/such-model"),
        ("vlm2vec", {"model": "clip"}, "wrong-model-type", "VLM2Vec"),
        ("languagebind", {"model": "clip"}, "wrong-model-type", "retriever.model="),
        ("languagebind", {"frames": 12}, "wrong-frame-count", "set retriever.frames=4"),
        ("languagebind", {"image_model": "siglip2"}, "incomplete-model", "image_model="),
        ("languagebind", {"image_model": "languagebind"}, "wrong-model-type", "image_model="),
    ],
)  # fmt: skip
def test_a_model_of_another_kind_is_refused(kind, changes, code, contains, presets) -> None:
    folders = {name: preset.model for name, preset in presets.items()}
    changes = {key: folders.get(value, value) for key, value in changes.items()}
    with raises_user_error(code, contains=contains):
        load(replace(presets[kind], **changes))
