"""Blind models: small networks that answer selection items without the prefix.

One model sees the four candidates, and the other sees the last observed frame as well. Their
accuracy is a lower bound of what can be guessed without watching the motion. They read the frozen
features of the tiny base's vision encoder, and are trained on items of the training split.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import nn
from tqdm import tqdm

from dynapix.conf.errors import UserError
from dynapix.data.frames.frame_cache import render_frames
from dynapix.data.parallel import batched
from dynapix.data.records import FrameRef, SelectionItem
from dynapix.data.seeded_order import named_rng
from dynapix.data.store import Store

ENCODER = Path("checkpoints/bases/tiny")
"""Folder of the model whose vision encoder the blind models use."""
FRAME_SIZE = 192, 128
"""Width and height in px of the rendered frames."""
IMAGE_SIZE = 128
"""Side in px of the images that the encoder receives."""
TRAIN_ITEMS = 4_000
"""Maximum number of items on which a blind model is trained."""
WIDTH, HEADS = 96, 4
EPOCHS, BATCH, LEARNING_RATE, WEIGHT_DECAY = 30, 64, 1e-3, 0.05
VALIDATION = 0.1
"""Share of the training items that selects the best epoch."""
CHUNK = 64
"""Number of frames that are encoded together."""


class BlindModel(nn.Module):
    """Scores four candidates together, whatever their order.

    Attention first runs over the tokens of each candidate, and then over the four candidates.
    """

    def __init__(self, tokens: int, features: int) -> None:
        super().__init__()
        self.project = nn.Linear(features, WIDTH)
        self.places = nn.Parameter(0.02 * torch.randn(tokens, WIDTH))
        self.within, self.across = (
            nn.TransformerEncoderLayer(
                WIDTH, HEADS, 2 * WIDTH, dropout=0.1, batch_first=True, norm_first=True
            )
            for _ in range(2)
        )
        self.score = nn.Linear(WIDTH, 1)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return scores (B, 4) of candidates whose features are (B, 4, tokens, features)."""
        batch, count, tokens, _ = features.shape
        hidden = self.project(features) + self.places
        hidden = self.within(hidden.reshape(batch * count, tokens, -1)).mean(dim=1)
        return self.score(self.across(hidden.reshape(batch, count, -1))).squeeze(-1)


def score_blind_models(
    items: Sequence[SelectionItem], store: Store, seed: int
) -> dict[str, np.ndarray]:
    """Train both blind models, and return by model whether they are right on each item of the test
    split, (N,): NaN for items of the training split. Raises UserError if the encoder is missing, or
    a split has no items."""
    splits = np.array([item.split for item in items])
    rng = named_rng(seed, "blind")
    train = rng.permutation(np.flatnonzero(splits == "train"))[:TRAIN_ITEMS]
    test = np.flatnonzero(splits == "test")
    if not len(train) or not len(test):
        raise UserError(
            f"blind=true: {store.folder} needs selection items of both splits", code="empty-split"
        )
    used = np.concatenate([train, test])
    last, candidates = encode_items([items[k] for k in used], store)
    answers = torch.tensor([items[k].answer for k in used])
    both = torch.cat([candidates, last[:, None].expand_as(candidates)], dim=-1)
    views = {"blind, candidates alone": candidates, "blind, last frame and candidates": both}
    right = {}
    for name, features in views.items():
        torch.manual_seed(seed)
        model = train_model(name, features[: len(train)], answers[: len(train)], seed)
        right[name] = np.full(len(items), np.nan)
        right[name][test] = is_right(model, features[len(train) :], answers[len(train) :]).numpy()
    return right


def train_model(name: str, features: torch.Tensor, answers: torch.Tensor, seed: int) -> BlindModel:
    """Train a blind model, and return it as after its best epoch on held-out training items."""
    model = BlindModel(features.shape[2], features.shape[3])
    optimizer = torch.optim.AdamW(model.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(features), generator=generator)
    count = max(1, int(VALIDATION * len(order)))
    held, kept = order[:count], order[count:]
    best, state = -1.0, model.state_dict()
    for _ in tqdm(range(EPOCHS), desc=f"training {name}", unit="epoch"):
        model.train()
        for batch in kept[torch.randperm(len(kept), generator=generator)].split(BATCH):
            loss = nn.functional.cross_entropy(model(features[batch].float()), answers[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        accuracy = is_right(model, features[held], answers[held]).mean().item()
        if accuracy > best:
            best = accuracy
            state = {key: value.clone() for key, value in model.state_dict().items()}
    model.load_state_dict(state)
    return model


@torch.no_grad()
def is_right(model: BlindModel, features: torch.Tensor, answers: torch.Tensor) -> torch.Tensor:
    """Return whether a model chooses the target of each item, (N,) as 0 or 1."""
    model.eval()
    chosen = [model(part.float()).argmax(dim=-1) for part in features.split(4 * BATCH)]
    return (torch.cat(chosen) == answers).float()


def encode_items(items: Sequence[SelectionItem], store: Store) -> tuple[torch.Tensor, torch.Tensor]:
    """Encode the last observed frames (N, tokens, features) and the candidates
    (N, 4, tokens, features) of items, in half precision."""
    frames = [f for i in items for f in (FrameRef(i.scene_id, i.prefix_stop), *i.candidates)]
    encode = _load_encoder()
    chunks = tqdm([*batched(frames, CHUNK)], desc="encoding frames", unit="batch")
    features = torch.cat([encode([_image(ref, store) for ref in chunk]) for chunk in chunks])
    features = features.reshape(len(items), 5, *features.shape[1:])
    return features[:, 0], features[:, 1:]


def _image(ref: FrameRef, store: Store) -> Image.Image:
    width, height = FRAME_SIZE
    size = {"width": width, "height": height}
    scene = store.scene(ref.scene_id)
    pixels = render_frames(scene, [ref.frame], store.manifest["config"] | size)[ref.frame]
    return Image.fromarray(pixels).resize((IMAGE_SIZE, IMAGE_SIZE), Image.Resampling.BICUBIC)


def _load_encoder() -> Callable[[list[Image.Image]], torch.Tensor]:
    """Return a function that encodes images as features (N, tokens, features)."""
    from transformers import AutoImageProcessor, AutoModelForImageTextToText

    if not (ENCODER / "config.json").exists():
        raise UserError(
            f"blind=true uses the vision encoder of {ENCODER}, which is missing: run the command "
            "in the repository's folder",
            code="missing-file",
        )
    processor = AutoImageProcessor.from_pretrained(ENCODER)
    tower = AutoModelForImageTextToText.from_pretrained(ENCODER, dtype=torch.float32).model.visual

    @torch.no_grad()
    def encode(images: list[Image.Image]) -> torch.Tensor:
        inputs = processor(images, return_tensors="pt")
        output = tower(inputs["pixel_values"], inputs["image_grid_thw"]).pooler_output
        return output.reshape(len(images), -1, output.shape[-1]).half()

    return encode
