"""Embedders that are measured as they were released, each on its real architecture."""

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

from conf.entry import Run
from conf.errors import UserError
from conf.schema import (
    ContrastiveTrainConfig,
    LoraConfig,
    RetrieveCommand,
    RetrieverConfig,
    SimilarityCommand,
)
from data.records import FPS, FRAMES, LETTERS, FrameRef, sample_prefix_frames
from data.render.frame_cache import FrameReader
from evaluation import retrieve, similarity
from evaluation.embedders.base import EMBEDDINGS
from evaluation.embedders.dual_encoder import unit_rows
from evaluation.embedders.joint_encoder import released_encoder
from evaluation.embedders.languagebind import LanguageBindVideo, spread
from evaluation.retrieval import nearest_candidate
from tests.evaluation.models import released

KINDS = ("clip", "siglip2", "languagebind", "vlm2vec")
ASKED = {
    "query_instruction": "Represent the given video with the following question:",
    "frame_instruction": "Represent the given image.",
}


@pytest.fixture(scope="module")
def presets(tmp_path_factory) -> dict[str, RetrieverConfig]:
    root = tmp_path_factory.mktemp("released")
    videos, images = released.languagebind(root / "videos", root / "images")
    given = {
        "clip": {"encoder": "dual", "model": released.clip(root / "clip"), "widths": [24]},
        "siglip2": {"encoder": "dual", "model": released.siglip2(root / "siglip2")},
        "languagebind": {
            "encoder": "languagebind", "model": videos, "image_model": str(images), "widths": [24],
        },
        "vlm2vec": {
            "encoder": "vlm2vec", "model": released.vlm2vec(root / "base", root / "adapters"),
            **ASKED,
        },
    }  # fmt: skip
    shared = {
        "quantization": "none", "lora": LoraConfig(rank=0), "image_size": released.SIZE,
        "frames": released.TIMES, "widths": [32],
    }  # fmt: skip
    return {
        name: RetrieverConfig(name=name, **{**shared, **g, "model": str(g["model"])})
        for name, g in given.items()
    }


@pytest.fixture(scope="module")
def frames(micro_store) -> FrameReader:
    return FrameReader(micro_store, released.SIZE)


def encoder(preset: RetrieverConfig):
    return released_encoder(preset, "fp32", Path("unused"))


@pytest.mark.parametrize("kind", KINDS)
def test_what_stands_beside_it_changes_no_embedding(kind, presets, frames, micro_store) -> None:
    made, queries = encoder(presets[kind]), micro_store.standard_test()[:4]
    shown = [q.target for q in queries]
    for embed in (
        lambda some: made.queries(some, frames),
        lambda some: made.texts([q.question for q in some]),
    ):
        together = embed(queries)
        alone = np.concatenate([embed([query]) for query in queries])
        np.testing.assert_allclose(together, alone, atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(together, axis=1), 1, atol=1e-5)
    together = made.frames(shown, frames)
    np.testing.assert_allclose(together[::-1], made.frames(shown[::-1], frames), atol=1e-5)
    assert len(np.unique(together.round(5), axis=0)) == len(set(shown))


@pytest.mark.parametrize("kind", ["clip", "siglip2"])
def test_a_query_is_the_sum_of_its_prefix_and_its_question(
    kind, presets, frames, micro_store
) -> None:
    preset, query = presets[kind], micro_store.standard_test()[0]
    model = AutoModel.from_pretrained(preset.model)
    processor = AutoProcessor.from_pretrained(preset.model)
    shown = sample_prefix_frames(query.prefix_start, query.prefix_stop, preset.frames)
    inputs = processor(
        text=[query.question.lower()], images=[frames.image(query.scene_id, f) for f in shown],
        padding="max_length", max_length=model.config.text_config.max_position_embeddings,
        truncation=True, return_tensors="pt",
    )  # fmt: skip
    given = {"input_ids": inputs["input_ids"], "pixel_values": inputs["pixel_values"]}
    with torch.no_grad():
        # The model's own forward gives unit embeddings.
        found = model(**given)
    prefix = unit_rows(found.image_embeds.mean(0, keepdim=True).numpy())
    asked = unit_rows(prefix + found.text_embeds.numpy())
    made = encoder(preset)
    np.testing.assert_allclose(made.queries([query], frames), asked, atol=1e-4)
    np.testing.assert_allclose(made.texts([query.question]), found.text_embeds, atol=1e-4)


def test_languagebind_is_clip_where_no_time_passes(presets, frames, micro_store) -> None:
    preset, query = presets["languagebind"], micro_store.standard_test()[0]
    video = LanguageBindVideo.from_pretrained(preset.model)
    pixels = torch.randn(2 * released.TIMES, 3, released.SIZE, released.SIZE)
    plain = CLIPModel(video.config).eval()
    lacking = plain.load_state_dict(video.state_dict(), strict=False)
    assert not lacking.missing_keys
    with torch.no_grad():
        timed = video.eval().get_image_features(pixels).pooler_output
        # Each of its two clips by itself.
        one = video.get_image_features(pixels[released.TIMES :]).pooler_output
        torch.testing.assert_close(timed[released.TIMES :], one)
        for layer in video.vision_model.encoder.layers:
            layer.temporal_embedding.zero_()
            layer.temporal_attn.out_proj.weight.zero_()
            layer.temporal_attn.out_proj.bias.zero_()
        still = video.get_image_features(pixels).pooler_output
        torch.testing.assert_close(still, plain.get_image_features(pixels).pooler_output)
    assert (timed - still).abs().max() > 1e-3

    # Time has a direction, and a short prefix shows some frames twice.
    made = encoder(preset)
    shown = frames.stack(query.scene_id, [0, 10, 20, 30])
    assert np.abs(made.embed_clips([shown]) - made.embed_clips([shown[::-1]])).max() > 1e-5
    np.testing.assert_allclose(
        made.embed_clips([shown[:2]]), made.embed_clips([shown[[0, 0, 1, 1]]])
    )
    assert spread(8, 4) == [0, 2, 5, 7]


def test_vlm2vec_reads_bare_media_at_flat_positions(presets, frames, micro_store) -> None:
    preset, query = presets["vlm2vec"], micro_store.standard_test()[0]
    base = json.loads((Path(preset.model) / "adapter_config.json").read_text())
    plain = Qwen2VLForConditionalGeneration.from_pretrained(base["base_model_name_or_path"])
    model = PeftModel.from_pretrained(plain, preset.model).merge_and_unload().eval()
    processor = AutoProcessor.from_pretrained(preset.model)
    shown = sample_prefix_frames(query.prefix_start, query.prefix_stop, preset.frames)
    clip = torch.from_numpy(frames.stack(query.scene_id, shown)).permute(0, 3, 1, 2)
    times = {"fps": float(FPS), "total_num_frames": FRAMES, "frames_indices": shown}
    inputs = processor(
        text=[f"<|video_pad|> {ASKED['query_instruction']} {query.question}"], videos=[clip],
        do_sample_frames=False, video_metadata=[times], return_tensors="pt",
        videos_kwargs={"size": {"shortest_edge": 28 * 28, "longest_edge": 8 * released.SIZE**2}},
    )  # fmt: skip
    flat = torch.arange(inputs["input_ids"].shape[1]).expand(3, 1, -1)
    with torch.no_grad():
        found = model(**inputs, position_ids=flat, output_hidden_states=True)
    last = unit_rows(found.hidden_states[-1][:, -1].numpy())
    made = encoder(preset)
    np.testing.assert_allclose(made.queries([query], frames), last, atol=1e-4)

    image = processor(
        text=[f"<|image_pad|> {ASKED['frame_instruction']}"],
        images=[frames.image(query.scene_id, shown[0])], return_tensors="pt",
    )  # fmt: skip
    flat = torch.arange(image["input_ids"].shape[1]).expand(3, 1, -1)
    with torch.no_grad():
        found = model(**image, position_ids=flat, output_hidden_states=True)
    last = unit_rows(found.hidden_states[-1][:, -1].numpy())
    frame = FrameRef(query.scene_id, shown[0])
    np.testing.assert_allclose(made.frames([frame], frames), last, atol=1e-4)


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


def test_the_nearest_candidate_is_chosen_once_and_read_back(
    measure, presets, frames, micro_store, tmp_path
) -> None:
    preset = replace(
        presets["clip"], model=str(shutil.copytree(presets["clip"].model, tmp_path / "clip"))
    )
    report = measure(similarity, SimilarityCommand, preset, "first")
    items, made = micro_store.selection("test"), encoder(preset)
    asked = made.queries(items, frames).astype(float)
    shown = np.stack([made.frames(list(item.candidates), frames) for item in items])
    scores = np.einsum("id,icd->ic", asked, shown)
    right = scores.argmax(1) == [item.answer for item in items]
    (row,) = report["rows"]
    assert (row["name"], row["mode"], row["n"]) == ("clip", "similarity", len(items))
    assert row["micro"]["value"] == pytest.approx(right.mean())
    for family, found in row["families"].items():
        of = [item.family == family for item in items]
        assert found["value"] == pytest.approx(right[of].mean())
    assert set(report["subtypes"]["clip"]) == {f"{i.family}/{i.subtype}" for i in items}
    chosen = report["positions"]["clip"]["chosen"]
    assert chosen == {x: int((scores.argmax(1) == k).sum()) for k, x in enumerate(LETTERS)}
    lines = (tmp_path / "first" / "scores.jsonl").read_text().splitlines()
    kept = [json.loads(line) for line in lines]
    assert [k["item_id"] for k in kept] == [item.item_id for item in items]
    assert np.array([k["scores"] for k in kept]) == pytest.approx(scores, abs=1e-5)
    text = (tmp_path / "first" / "report.txt").read_text()
    assert "SigLIP 2" in text
    assert all(subtype in text for subtype in report["subtypes"]["clip"])
    # What was embedded is kept: there are no settings any more to load a model by.
    (tmp_path / "clip" / "config.json").unlink()
    assert measure(similarity, SimilarityCommand, preset, "second") == report


def test_released_models_are_ranked_as_retrievers(measure, presets) -> None:
    report = measure(retrieve, RetrieveCommand, presets["vlm2vec"], "ranked")
    (row,) = [r for r in report["rows"] if r["builder"] is None]
    assert (row["name"], row["width"]) == ("vlm2vec", 32)


def test_a_tie_is_shared() -> None:
    scores = np.array([[1, 1, 0, 0], [1, 1, 1, 1], [0, 2, 1, 0], [3, 3, 3, 4]], np.float32)
    assert nearest_candidate.credit_choices(scores, [1, 0, 1, 0]).tolist() == [0.5, 0.25, 1, 0]


def test_a_tie_is_no_choice() -> None:
    rng = np.random.default_rng(0)
    scores, answers = rng.integers(3, size=(200, 4)).astype(np.float32), rng.integers(4, size=200)
    scores[:5, 1:] = np.nan
    scores[5] = np.nan
    chosen = nearest_candidate.choose_letters(scores)
    assert chosen[:6] == ["A"] * 5 + [None]
    # What is chosen is right where the credit is whole.
    credits = nearest_candidate.credit_choices(scores, answers)
    right = [c == LETTERS[a] for c, a in zip(chosen, answers, strict=True)]
    assert right == (credits == 1).tolist()


def without(part: str) -> Callable[[Path], None]:
    return lambda folder: (folder / part).unlink()


def drop_weight(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    weights.pop("text_projection.weight")
    save_file(weights, folder / "model.safetensors", {"format": "pt"})


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (without("model.safetensors"), "cannot be loaded from that folder"),
        (without("config.json"), "cannot be loaded from that folder"),
        (without("tokenizer.json"), "cannot be loaded|a tokenizer of"),
        (without("processor_config.json"), "cannot be loaded|lacks its image processor"),
        (drop_weight, r"text_projection\.weight"),
        (lambda folder: (folder / "config.json").write_text("{"), "cannot be loaded"),
    ],
)
def test_a_model_that_lacks_a_part_is_told(damage, said, presets, tmp_path) -> None:
    folder = shutil.copytree(presets["clip"].model, tmp_path / "clip")
    damage(folder)
    with pytest.raises(UserError, match=said):
        encoder(replace(presets["clip"], model=str(folder)))


@pytest.mark.parametrize(
    ("kind", "changes", "said"),
    [
        ("clip", {"model": "vlm2vec"}, r"neither CLIP nor SigLIP|cannot be loaded"),
        ("clip", {"image_size": 28}, "set retriever.image_size=56"),
        ("clip", {"model": "no/such-model-anywhere"}, "no/such-model-anywhere"),
        ("vlm2vec", {"model": "clip"}, "not a VLM2Vec"),
        ("languagebind", {"model": "clip"}, "has no attention over time"),
        ("languagebind", {"frames": 12}, "set retriever.frames=4"),
        ("languagebind", {"image_model": "no/such"}, r"retriever\.image_model=no/such"),
        ("languagebind", {"image_model": "siglip2"}, "retriever.image_model="),
        ("languagebind", {"image_model": "languagebind"}, "is a video model"),
        ("clip", {"model": "./no/such"}, "retriever.model=./no/such"),
    ],
)  # fmt: skip
def test_a_model_of_another_kind_is_told(kind, changes, said, presets) -> None:
    folders = {name: preset.model for name, preset in presets.items()}
    changes = {key: folders.get(value, value) for key, value in changes.items()}
    with pytest.raises(UserError, match=said):
        encoder(replace(presets[kind], **changes))
