"""Released embedders, as tiny models of their real architectures."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from peft import PeftModel
from transformers import AutoModel, AutoProcessor, CLIPModel, Qwen2VLForConditionalGeneration

from dynapix.conf.files import read_json_lines
from dynapix.conf.schema import ContrastiveTrainConfig, RetrieverConfig, SimilarityCommand
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import FPS, FRAMES, FrameRef, sample_prefix_frames
from dynapix.evaluation import similarity
from dynapix.evaluation.embedders.joint_encoder import load_encoder
from dynapix.evaluation.embedders.languagebind import LanguageBindVideo, spread, unit_rows
from dynapix.evaluation.reporting.run_responses import nearest_candidates
from tests.evaluation.models import released
from tests.evaluation.models.conftest import NO_LORA, new_run
from tests.user_errors import raises_user_error

INSTRUCTIONS = {
    "query_instruction": "Represent the given video with the following question:",
    "frame_instruction": "Represent the given image.",
}


@pytest.fixture(scope="module")
def presets(tmp_path_factory) -> dict[str, RetrieverConfig]:
    root = tmp_path_factory.mktemp("released")
    videos, images = released.languagebind(root / "videos", root / "images")
    models = {
        "clip": ("dual", released.clip(root / "clip")),
        "siglip2": ("dual", released.siglip2(root / "siglip2")),
        "languagebind": ("languagebind", videos),
        "vlm2vec": ("vlm2vec", released.vlm2vec(root / "base", root / "adapters")),
    }
    shared = {**NO_LORA, "image_size": released.IMAGE_SIZE, "frames": released.CLIP_FRAMES}
    more = {"languagebind": {"image_model": str(images)}, "vlm2vec": INSTRUCTIONS}
    return {
        name: RetrieverConfig(
            name=name, encoder=encoder, model=str(model), widths=[24], **shared,
            **more.get(name, {}),
        )
        for name, (encoder, model) in models.items()
    }  # fmt: skip


@pytest.fixture(scope="module")
def frames(micro_store) -> FrameReader:
    return FrameReader(micro_store, released.IMAGE_SIZE)


def load(preset: RetrieverConfig):
    return load_encoder(preset, "fp32", None)


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
    encoder, refs = load(preset), [FrameRef(query.scene_id, frame) for frame in prefix]
    np.testing.assert_allclose(encoder.embed_queries([query], frames), expected, atol=1e-4)
    np.testing.assert_allclose(encoder.embed_texts([query.question]), output.text_embeds, atol=1e-4)
    np.testing.assert_allclose(encoder.embed_frames(refs, frames), output.image_embeds, atol=1e-4)


def test_languagebind_without_attention_over_time_is_clip(presets, frames, micro_store) -> None:
    preset, queries = presets["languagebind"], micro_store.standard_test()[:3]
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
    clip = frames.stack(queries[0].scene_id, [0, 10, 20, 30])
    assert np.abs(encoder.embed_clips([clip]) - encoder.embed_clips([clip[::-1]])).max() > 1e-5
    repeated = encoder.embed_clips([clip[[0, 0, 1, 1]]])
    np.testing.assert_allclose(encoder.embed_clips([clip[:2]]), repeated)
    assert spread(8, 4) == [0, 2, 5, 7]
    together = encoder.embed_queries(queries, frames)
    alone = [encoder.embed_queries([query], frames)[0] for query in queries]
    np.testing.assert_allclose(together, np.stack(alone), atol=1e-5)


def test_vlm2vec_reads_media_at_text_positions_without_start_tokens(
    presets, frames, micro_store
) -> None:
    preset, queries = presets["vlm2vec"], micro_store.standard_test()[:2]
    base = json.loads((Path(preset.model) / "adapter_config.json").read_text())
    plain = Qwen2VLForConditionalGeneration.from_pretrained(base["base_model_name_or_path"])
    model = PeftModel.from_pretrained(plain, preset.model).merge_and_unload().eval()
    processor = AutoProcessor.from_pretrained(preset.model)

    def last_state(**inputs) -> np.ndarray:
        inputs = processor(**inputs, return_tensors="pt")
        # Equal positions in time, height and width, as text has them.
        positions = torch.arange(inputs["input_ids"].shape[1]).expand(3, 1, -1)
        with torch.no_grad():
            output = model(**inputs, position_ids=positions, output_hidden_states=True)
        return unit_rows(output.hidden_states[-1][:, -1].numpy())[0]

    size = {"shortest_edge": 28 * 28, "longest_edge": 8 * released.IMAGE_SIZE**2}
    videos, images = [], []
    for query in queries:
        prefix = sample_prefix_frames(query.prefix_start, query.prefix_stop, preset.frames)
        clip = torch.from_numpy(frames.stack(query.scene_id, prefix)).permute(0, 3, 1, 2)
        times = {"fps": float(FPS), "total_num_frames": FRAMES, "frames_indices": prefix}
        text = f"<|video_pad|> {INSTRUCTIONS['query_instruction']} {query.question}"
        videos.append(
            last_state(
                text=[text], videos=[clip], do_sample_frames=False, video_metadata=[times],
                videos_kwargs={"size": size},
            )
        )  # fmt: skip
        text, target = f"<|image_pad|> {INSTRUCTIONS['frame_instruction']}", query.target
        images.append(last_state(text=[text], images=[frames.image(target.scene_id, target.frame)]))
    encoder = load(preset)
    np.testing.assert_allclose(encoder.embed_queries(queries, frames), np.stack(videos), atol=1e-4)
    targets = encoder.embed_frames([query.target for query in queries], frames)
    np.testing.assert_allclose(targets, np.stack(images), atol=1e-4)


def test_the_nearest_candidate_is_chosen(presets, frames, micro, micro_store, tmp_path) -> None:
    store = shutil.copytree(micro_store.folder, tmp_path / "store" / "micro").parent
    cfg = SimilarityCommand(
        benchmark=micro, retriever=presets["clip"], store=str(store), batch=16,
        train=ContrastiveTrainConfig(precision="fp32"),
    )  # fmt: skip
    run = new_run(tmp_path / "run")
    similarity.main.__wrapped__(cfg, run)
    report = json.loads((run.folder / "report.json").read_text())
    items, encoder = micro_store.selection("test"), load(presets["clip"])
    query_rows = encoder.embed_queries(items, frames).astype(float)
    candidates = np.stack([encoder.embed_frames(list(item.candidates), frames) for item in items])
    scores = np.einsum("id,icd->ic", query_rows, candidates)
    right = scores.argmax(1) == [item.answer for item in items]
    (row,) = report["rows"]
    assert (row["name"], row["mode"], row["n"]) == ("clip", "similarity", len(items))
    assert row["micro"]["value"] == pytest.approx(right.mean())
    stored = list(read_json_lines(run.folder / "scores.jsonl"))
    assert [row["item_id"] for row in stored] == [item.item_id for item in items]
    assert np.array([row["scores"] for row in stored]) == pytest.approx(scores, abs=1e-5)


def test_tied_candidates_share_the_credit_and_none_is_chosen() -> None:
    scores = [[1, 1, 0, 0], [1, 1, 1, 1], [0, 2, 1, 0], [3, 3, 3, 4]]
    nearest = [nearest_candidates(each) for each in scores]
    assert [n.credit(x) for n, x in zip(nearest, "BABA", strict=True)] == [0.5, 0.25, 1, 0]
    assert [n.letter for n in nearest] == [None, None, "B", "D"]


@pytest.mark.parametrize(
    ("kind", "changes", "code", "contains"),
    [
        ("clip", {"model": "languagebind"}, "unloadable-model", "retriever.model="),
        ("vlm2vec", {"model": "clip"}, "wrong-model-type", "VLM2Vec"),
        ("languagebind", {"model": "clip"}, "wrong-model-type", "retriever.model="),
        ("languagebind", {"frames": 12}, "wrong-frame-count", "set retriever.frames=4"),
        ("languagebind", {"image_model": "siglip2"}, "incomplete-model", "image_model="),
    ],
)
def test_a_model_of_another_kind_is_refused(kind, changes, code, contains, presets) -> None:
    folders = {name: preset.model for name, preset in presets.items()}
    changes = {key: folders.get(value, value) for key, value in changes.items()}
    with raises_user_error(code, contains=contains):
        load(replace(presets[kind], **changes))


def test_a_model_without_its_tokenizer_is_refused(presets, tmp_path) -> None:
    folder = shutil.copytree(presets["clip"].model, tmp_path / "clip")
    (folder / "tokenizer.json").unlink()
    with raises_user_error("incomplete-model", contains=str(folder)):
        load(replace(presets["clip"], model=str(folder)))
