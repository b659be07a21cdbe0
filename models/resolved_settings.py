"""`resolved.yaml`, the values that a training run determines once, before its first step.

    precision: bf16                  precision of the forward and backward passes
    base: Qwen/Qwen3-VL-8B-Instruct@0c351dd01ed8...
                                     name and commit of a hub model, or a digest of local weights
    data: 5f0f9a4a3c1d2e77           digest of the training data

Resuming, evaluating or exporting the run uses this precision (an evaluation may override it) and
this commit, and is refused if a local base has changed. Resuming is also refused if the data have
changed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import yaml

from dynapix.conf.errors import UserError
from dynapix.conf.files import write_text
from dynapix.models.fingerprints import (
    Preset,
    is_hub_model,
    model_id,
    pin_revisions,
    weights_digest,
)

RESOLVED = "resolved.yaml"


def resolve_run(folder: Path, precision: str, preset: Preset, data: str) -> tuple[str, Preset]:
    """Resolve a run's precision and its base's commit, or read them if the run is resumed.

    Call this in `main_first`: the main rank writes resolved.yaml, and the other ranks read it.

    Args:
        folder: The run's folder.
        precision: bf16, fp32 or auto.
        data: What `data_digest` returns for the run.

    Returns:
        The precision, bf16 or fp32, and the preset with the commit as revision.

    Raises:
        UserError: The folder contains a run with other data or another base.
    """
    preset = pin_revisions(with_resolved_commit(folder, preset))
    check_base(folder, preset)
    if resolved := read_resolved(folder):
        if resolved["data"] != data:
            raise UserError(
                f"{folder} was started with other training data: the benchmark, its rationales or "
                "the prompts have changed. Restore them, or train in another folder (run=NAME)",
                code="other-data",
            )
        return resolved["precision"], preset
    precision = resolve_precision(precision)
    # If the commit of a hub model cannot be determined, loading the model reports the reason.
    if not is_hub_model(preset.model) or preset.revision:
        resolved = {"precision": precision, "base": base_id(preset), "data": data}
        write_text(folder / RESOLVED, yaml.safe_dump(resolved, sort_keys=False))
    return precision, preset


def resolve_precision(precision: str, *, on_cpu: bool = False) -> str:
    """Resolve auto to bf16 or fp32; return bf16 and fp32 unchanged.

    auto is bf16 if the GPU or CPU has instructions for bf16. A CPU without them takes several times
    as long in bf16 as in fp32.

    Args:
        on_cpu: Whether the model computes on the CPU even if there is a GPU.
    """
    if precision != "auto":
        return precision
    import torch

    if torch.cuda.is_available() and not on_cpu:
        has_bf16 = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        capabilities = torch.cpu.get_capabilities()
        has_bf16 = any(has for name, has in capabilities.items() if "bf16" in name)
    return "bf16" if has_bf16 else "fp32"


def read_resolved(folder: Path) -> dict[str, str]:
    """Return the content of a run's resolved.yaml, or an empty dict if the file does not exist.

    Raises:
        UserError: The file is damaged.
    """
    path = folder / RESOLVED
    try:
        resolved = yaml.safe_load(path.read_text())
        return {name: str(resolved[name]) for name in ("precision", "base", "data")}
    except FileNotFoundError:
        return {}
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} is damaged: delete {folder} and train again", code="damaged-file"
        ) from error


def with_resolved_commit(folder: Path, preset: Preset) -> Preset:
    """Return a run's preset whose revision is the commit of its hub model in resolved.yaml."""
    name, _, commit = read_resolved(folder).get("base", "").rpartition("@")
    return replace(preset, revision=commit) if name and name == preset.model else preset


def check_base(folder: Path, preset: Preset) -> None:
    """Raise UserError if a local base has other weights than when the run in `folder` started."""
    resolved = read_resolved(folder)
    if not resolved or is_hub_model(preset.model):
        return
    if resolved["base"] != base_id(preset):
        raise UserError(
            f"the weights in {preset.model} have changed since the run in {folder} was started: "
            "restore them, or delete the run and train again",
            code="other-base",
        )


def base_id(preset: Preset) -> str:
    """Return NAME@COMMIT of a hub model, or the digest of a local base."""
    if is_hub_model(preset.model):
        return model_id(preset.model, preset.revision)
    return weights_digest(preset.model)


def data_digest(store_identity: str, texts: Iterable[str]) -> str:
    """Return a digest of a run's training data.

    Args:
        texts: What identifies the training samples, in order: the texts of a student's samples, or
            the ids of items or queries. Runs that train the student of another run further add the
            digest of its weights.
    """
    whole = hashlib.sha256(store_identity.encode())
    for text in texts:
        whole.update(hashlib.sha256(text.encode()).digest())
    return whole.hexdigest()[:16]
