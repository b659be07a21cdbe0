"""Makes what the retriever's forward takes from names of queries and frames."""

from __future__ import annotations

from functools import partial
from itertools import islice
from typing import Any

import torch
from sentence_transformers import SentenceTransformer
from transformers.models.qwen3_vl.modeling_qwen3_vl import BaseModelOutputWithDeepstackFeatures

from conf.schema import RetrieverConfig
from data.render.frame_cache import FrameReader
from models.retriever.embedder import frame_input
from models.student.collator import MEDIA
from train.retriever.batches import Batch
from train.retriever.shared_prefixes import give_own, shared_input
from train.student.lazy_samples import STAMP, TOKEN

SEEN = "seen"
"""With a kind of media: the tower's outputs, (1 + deepstack layers, tokens, width)."""


class RetrieverInputs:
    """Makes inputs of a model, which is prepared to take them."""

    def __init__(
        self, model: SentenceTransformer, frames: FrameReader, cfg: RetrieverConfig, precision: str
    ) -> None:
        self._model, self._frames, self._cfg = model, frames, cfg
        self._bf16 = precision == "bf16"
        self._device = model.device
        self._shown = round(cfg.image_size / TOKEN) ** 2 + STAMP
        model[0].register_forward_pre_hook(give_seen)
        model[0].register_forward_hook(partial(give_own, last=cfg.late is None))

    def of_prefixes(self, batch: Batch, first: int, last: int) -> dict[str, Any]:
        """Of the queries of a range of the batch's prefixes."""
        groups = batch.groups(first, last)
        return shared_input(self._model, groups, self._frames, self._cfg)

    def of_frames(self, batch: Batch, first: int, last: int) -> dict[str, Any]:
        """Of a range of the batch's frames."""
        shown = [frame_input(frame, self._frames) for frame in batch.frames[first:last]]
        return self._model.preprocess(shown, prompt=self._cfg.frame_instruction)

    def prefix_lengths(self, batch: Batch) -> list[int]:
        """About how many tokens each prefix and its questions have."""
        questions = [query.question for query in batch.queries]
        asked = iter(self._model.tokenizer(questions, add_special_tokens=False).input_ids)
        # The tower sees a clip as pairs of frames.
        clip = self._shown * -(-self._cfg.frames // 2)
        return [clip + sum(map(len, islice(asked, count))) for count in batch.prefixes]

    def frame_lengths(self, batch: Batch) -> list[int]:
        """About how many tokens each frame has."""
        return [self._shown] * len(batch.frames)

    def on_device(self, inputs: dict[str, Any]) -> dict[str, Any]:
        return {
            name: value.to(self._device, non_blocking=True) if torch.is_tensor(value) else value
            for name, value in inputs.items()
        }

    def seen(self, inputs: dict[str, Any]) -> dict[str, Any]:
        """Inputs with the tower's outputs in place of the pixels."""
        given = dict(inputs)
        for kind, (pixels, grid) in MEDIA.items():
            if pixels in given:
                with (
                    torch.no_grad(),
                    torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16),
                ):
                    # A clip passes the tower as its pairs of frames do.
                    found = self._model[0].model.get_image_features(given.pop(pixels), given[grid])
                layers = [found.pooler_output, *found.deepstack_features]
                given[f"{SEEN}_{kind}"] = torch.stack([torch.cat(layer) for layer in layers])
        return given


def give_seen(module: Any, given: tuple[dict[str, Any]]) -> None:
    """Before the transformer, as a hook of its forward: hand over the tower's outputs that stand in
    the features under the name that the model has for them."""
    (features,) = given
    outputs = {}
    for kind in MEDIA:
        if (layers := features.pop(f"{SEEN}_{kind}", None)) is not None:
            merged, *deepstack = layers.unbind()
            outputs[kind] = BaseModelOutputWithDeepstackFeatures(
                pooler_output=(merged,), deepstack_features=[(layer,) for layer in deepstack]
            )
    if outputs:
        features["mm_encoder_outputs"] = outputs
