"""Identify models: digests of weights and processors in folders, commits of models on the hub.

Stored results and checkpoints may only be used with the model that produced them. A folder is
identified by a digest of its files, a model on the hub by its name and commit.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from dynapix.conf.schema import RetrieverConfig, StudentConfig

Preset = TypeVar("Preset", StudentConfig, RetrieverConfig)

BLOCK = 1 << 12
"""Number of bytes of each tensor that are hashed."""
PROCESSOR_FILES = (
    "*processor_config.json",
    "*token*.json",
    "chat_template*",
    "config_sentence_transformers.json",
    "modules.json",
    "*_Pooling/config.json",
    "additional_chat_templates/*",
    "merges.txt",
    "sentence_bert_config.json",
    "tokenizer.model",
    "vocab.*",
)
"""Patterns of the files that define how text and pixels become a model's input, and how a retriever
pools its output."""


def settings_key(settings: Any) -> str:
    """Return a short hash of settings, under which results with these settings are stored."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def weights_digest(*models: str | Path | None) -> str:
    """Return a short hash of the weights of several models.

    Of a folder, the hash covers the name and size of each safetensors file, the names and shapes of
    its tensors, and a block from the middle of each tensor. A block suffices, because training and
    merging change every entry of a tensor. The folder's location does not matter. Of a hub model,
    the hash covers only the name (with the commit, if given).
    """
    whole = hashlib.sha256()
    for k, model in enumerate(models):
        folder = model is not None and Path(model).is_dir()
        whole.update(f"{k} {'' if folder else model}".encode())
        for path in sorted(Path(model).rglob("*.safetensors")) if folder else []:
            whole.update(f"{path.name} {path.stat().st_size}".encode())
            with open(path, "rb") as file:
                _hash_tensors(file, whole)
    return whole.hexdigest()[:16]


def _hash_tensors(file: BinaryIO, whole: Any) -> None:
    """Hash the header of a safetensors file and a block of each of its tensors."""
    size = os.fstat(file.fileno()).st_size
    header = file.read(min(size, int.from_bytes(file.read(8), "little")))
    whole.update(header)
    try:
        tensors = [
            entry for name, entry in sorted(json.loads(header).items()) if name != "__metadata__"
        ]
        offsets = [(int(begin), int(end)) for begin, end in (t["data_offsets"] for t in tensors)]
    except (ValueError, TypeError, KeyError, AttributeError):
        # Loading the file reports the damage.
        offsets = []
    for begin, end in offsets:
        size = max(0, min(BLOCK, end - begin))
        file.seek(max(0, 8 + len(header) + (begin + end - size) // 2))
        whole.update(file.read(size))


def processor_digest(model: str | Path | None) -> str:
    """Return a short hash of the files of a folder's tokenizer, processor and chat template. Of a
    hub model, only the name is hashed."""
    whole = hashlib.sha256()
    if model is None or not Path(model).is_dir():
        whole.update(f"{model}".encode())
        return whole.hexdigest()[:16]
    for path in sorted({p for pattern in PROCESSOR_FILES for p in Path(model).rglob(pattern)}):
        whole.update(f"{path.relative_to(model)} {path.stat().st_size} ".encode())
        whole.update(path.read_bytes())
    return whole.hexdigest()[:16]


def pin_revisions(cfg: Preset) -> Preset:
    """Return a preset in which the revisions of hub models (branches, tags or None) are commits.

    The owner of a hub model can change what a branch or tag refers to. The commit comes from the
    local cache or, if the model is not cached, from the hub. A revision whose commit cannot be
    determined stays unchanged, and loading the model reports the reason.
    """
    commits = {}
    for model, revision in (("model", "revision"), ("image_model", "image_revision")):
        if is_hub_model(name := getattr(cfg, model, None)):
            requested = getattr(cfg, revision)
            try:
                commits[revision] = find_commit(name, requested)
            except Exception:
                # The hub's client raises the errors of whichever HTTP library is installed.
                commits[revision] = requested
    return replace(cfg, **commits)


def find_commit(model: str, revision: str | None = None) -> str:
    """Return the commit of a hub model from the local cache or, if it is not cached, from the hub.

    The hub gets a single request, whereas loading a model would retry for minutes.

    Raises:
        Exception: The model is neither in the cache nor on the hub, or the hub cannot be reached.
    """
    from huggingface_hub import model_info, try_to_load_from_cache

    # A repository of adapters has no config.json.
    for file in ("config.json", "adapter_config.json"):
        cached = try_to_load_from_cache(model, file, revision=revision)
        if isinstance(cached, str):
            # The cache stores files in a folder named after the commit.
            return Path(cached).parent.name
    return model_info(model, revision=revision, timeout=10).sha


def is_hub_model(model: str | None) -> bool:
    """Return whether `model` is a name on the hub: neither None (a built model) nor an existing
    folder."""
    return model is not None and not Path(model).is_dir()


def model_id(model: str | None, revision: str | None) -> str | None:
    """Return NAME@REVISION for a hub model with a revision; otherwise `model` itself."""
    return f"{model}@{revision}" if is_hub_model(model) and revision else model
