"""Digests of a model's weights."""

from __future__ import annotations

import json
import shutil

import torch
from safetensors.torch import load_file, save_file

from dynapix.models.fingerprints import weights_digest

SHAPES = {"first": (300, 200), "middle": (7,), "visual": (2000, 300)}


def test_the_digest_covers_every_tensor(tmp_path) -> None:
    """A merged student differs from its base in only some of the tensors."""
    one, other = tmp_path / "one", tmp_path / "other"
    one.mkdir()
    save_file({n: torch.randn(s) for n, s in SHAPES.items()}, one / "model.safetensors")
    shutil.copytree(one, other)
    assert weights_digest(one) == weights_digest(other)
    for changed in SHAPES:
        tensors = load_file(one / "model.safetensors")
        tensors[changed] *= 1.01
        save_file(tensors, other / "model.safetensors")
        assert weights_digest(one) != weights_digest(other), changed


def test_a_damaged_file_has_a_digest_too(tmp_path) -> None:
    tensor = {"dtype": "F32", "shape": [1], "data_offsets": [-9, 2]}
    head = json.dumps({"weight": tensor}).encode()
    with_offsets = len(head).to_bytes(8, "little") + head
    for content in (b"", b"\xff" * 100, b"\x02" + bytes(7) + b"[]", with_offsets):
        (tmp_path / "model.safetensors").write_bytes(content)
        assert len(weights_digest(tmp_path)) == 16, content
