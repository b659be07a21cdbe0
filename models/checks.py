"""Holds against each other what is put together to be trained or measured: a base, its processor,
adapters, pooling and widths, and the run that they belong to."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

from safetensors import safe_open

from conf.errors import UserError
from conf.runs import write_json
from conf.schema import RetrieverConfig, StudentConfig
from data.store import Store

if TYPE_CHECKING:
    from torch import nn
    from transformers import PreTrainedConfig, PreTrainedTokenizerBase, ProcessorMixin

Preset = TypeVar("Preset", StudentConfig, RetrieverConfig)

BASE = "base.json"
DATA = "data.json"
MODULES = "modules.json"
"""In which sentence-transformers lists a model's parts."""
PEFT = "base_model.model."
"""What peft puts before the names of the modules that it adapts."""
BLOCK = 1 << 12
"""Bytes that a hash takes of a tensor."""
PROCESSOR = (
    "*processor_config.json",
    "*token*.json",
    "chat_template*",
    "additional_chat_templates/*",
    "merges.txt",
    "sentence_bert_config.json",
    "tokenizer.model",
    "vocab.*",
)
"""Files, beside the weights, that say how text and pixels become a model's input."""
METADATA = "__metadata__"
"""What stands among the tensors in a file's head and is none."""
UNTRAINED_MODULES = ("Transformer", "Pooling", "Normalize")
"""Kinds of modules that a retriever of one vector here has, of which the first alone is trained."""
DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError)
"""What reading a file of modules raises that is not whole."""
POOLING = "lasttoken"
"""How the library calls what makes a retriever's one vector."""


def check_tower(group: str, model: str, config: PreTrainedConfig) -> None:
    """Raises UserError where a base has no vision tower."""
    if getattr(config, "vision_config", None) is None:
        raise UserError(
            f"{group}.model={model} ({config.model_type}) has no vision tower: give a "
            "vision-language model, such as Qwen3-VL"
        )


def check_family(model: str, config: PreTrainedConfig) -> None:
    """Raises UserError where a base of a retriever is no Qwen3-VL, whose masks, positions and
    features the sharing of prefixes goes by."""
    if config.model_type != "qwen3_vl":
        raise UserError(
            f"retriever.model={model} is a {config.model_type}; retriever.encoder=qwen3_vl reads "
            "and trains Qwen3-VL models alone, such as Qwen3-VL-Embedding: give one of these"
        )


def check_processor(
    group: str,
    model: str,
    config: PreTrainedConfig,
    processor: ProcessorMixin | PreTrainedTokenizerBase,
) -> None:
    """Raises UserError where a base's processor does not go with its weights."""
    if problem := _mismatch(config, processor):
        raise UserError(
            f"{group}.model={model} holds a processor of another model, {type(processor).__name__} "
            f"({problem}): put the processor and tokenizer files there that came with the weights"
        )


def _mismatch(config: PreTrainedConfig, processor: Any) -> str | None:
    """How a processor does not go with a model; None where it does."""
    for name in ("tokenizer", "image_processor", "video_processor"):
        if not hasattr(processor, name):
            return f"it has no {name.replace('_', ' ')}"
    tokens, known = len(processor.tokenizer), config.get_text_config().vocab_size
    if tokens > known:
        return f"its tokenizer has {tokens} tokens, the model {known}"
    for part in (processor.image_processor, processor.video_processor):
        for name, own in (("patch_size", "patch_size"), ("merge_size", "spatial_merge_size")):
            there, here = getattr(part, name, None), getattr(config.vision_config, own, None)
            if there != here:
                what = name.replace("_", " ")
                return f"its {what} is {there}, that of the vision tower {here}"
    for name in ("image_token_id", "video_token_id"):
        there, here = getattr(processor, name, None), getattr(config, name, None)
        if there != here:
            return f"its {name} is {there}, the model's {here}"
    return None


def check_adapters(folder: Path, base: nn.Module, cfg: StudentConfig) -> None:
    """Hold the adapters in a folder to the base, with adapters of its own or without, that they are
    laid over, and to the preset's rank. A whole model has none, nor have FSDP's checkpoints.

    Raises:
        UserError: they are of another base or rank.
        SafetensorError: they cannot be read.
    """
    if not (path := folder / "adapter_model.safetensors").exists():
        return
    modules = {name.removeprefix(PEFT): module for name, module in base.named_modules()}
    with safe_open(path, "pt") as file:
        shapes = {name: file.get_slice(name).get_shape() for name in file.keys()}  # noqa: SIM118
    for name, shape in shapes.items():
        adapted, _, side = name.removeprefix(PEFT).partition(".lora_")
        # A is (rank, inputs), B is (outputs, rank).
        rank, there = shape if side.startswith("A") else reversed(shape)
        if rank != cfg.lora.rank:
            raise UserError(
                f"{folder} holds adapters of rank {rank}, and student.lora.rank is "
                f"{cfg.lora.rank}: give student.lora.rank={rank}, or train in a run of its own "
                "(run=NAME)"
            )
        module = modules.get(adapted)
        here = module and getattr(module, "in_features" if side[0] == "A" else "out_features")
        if here != there:
            found = f"{there} wide there and {here} here" if module else "not in this one"
            raise UserError(
                f"{folder} holds adapters of another base than {cfg.model} ({adapted} is {found}): "
                "give the base that they were trained over with student.model=FOLDER, or train "
                "again"
            )


def model_file(model: str | Path, name: str, revision: str | None = None) -> Path:
    """Where a file of a model is: in its folder, or in the hub's cache, which it is fetched into.

    Raises:
        FileNotFoundError: the model has no such file, as far as can be known here.
    """
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import EntryNotFoundError

    if Path(model).is_dir():
        return Path(model) / name
    try:
        return Path(hf_hub_download(str(model), name, revision=revision))
    except EntryNotFoundError as error:
        raise FileNotFoundError(f"{model} has no {name}") from error


def is_retriever(model: str | Path, revision: str | None = None) -> bool:
    """Whether a model, in a folder or of the hub, says what comes after its backbone."""
    try:
        return model_file(model, MODULES, revision).exists()
    except FileNotFoundError:
        return False


def check_modules(saved: str | Path, revision: str | None = None) -> None:
    """Raises UserError where a saved retriever, which is to be a base, has trained modules after
    its backbone: a new retriever would begin without them."""
    try:
        kinds = [m["type"].rpartition(".")[2] for m in _modules(saved, revision)]
    except DAMAGED as error:
        raise _damaged(saved, error) from error
    if lost := [kind for kind in kinds if kind not in UNTRAINED_MODULES]:
        raise UserError(
            f"{saved} has modules after its backbone that a retriever trained over it would lose "
            f"({', '.join(lost)}): give a base, or measure it as the run that trained it "
            "(model=RUN)"
        )


def check_pooling(saved: str | Path, revision: str | None = None) -> None:
    """Raises UserError where a saved retriever, in a folder or of the hub, does not pool the last
    token."""
    try:
        parts = [m["path"] for m in _modules(saved, revision) if m["type"].endswith(".Pooling")]
        files = [model_file(saved, f"{part}/config.json", revision) for part in parts]
        modes = [mode for file in files for mode in _pooling_modes(json.loads(file.read_text()))]
    except DAMAGED as error:
        raise _damaged(saved, error) from error
    if modes != [POOLING]:
        told = f"with {' and '.join(map(str, modes))} pooling" if modes else "without pooling"
        raise UserError(
            f"{saved} was saved {told}, and a retriever here is read at its last token "
            f"({POOLING}): give one that is, such as a run of train.contrastive or a "
            "Qwen3-VL-Embedding"
        )


def _modules(saved: str | Path, revision: str | None) -> list[dict[str, Any]]:
    return json.loads(model_file(saved, MODULES, revision).read_text())


def _damaged(saved: str | Path, error: Exception) -> UserError:
    return UserError(
        f"{saved} is damaged: what it says of its modules cannot be read ({error}); delete what "
        "wrote it and train or fetch it again"
    )


def _pooling_modes(config: dict[str, Any]) -> list[str]:
    if (mode := config.get("pooling_mode")) is not None:
        return [mode] if isinstance(mode, str) else list(mode)
    # As sentence-transformers wrote them before its sixth version.
    flags = {key.removeprefix("pooling_mode_"): on for key, on in config.items() if "_mode_" in key}
    return [mode for mode, on in flags.items() if on]


def check_widths(cfg: RetrieverConfig, entries: int) -> None:
    """Raises UserError where a retriever has a width that embeddings of so many entries lack."""
    if cfg.widths[0] > entries:
        fitting = ",".join(str(w) for w in cfg.widths if w <= entries) or entries
        raise UserError(
            f"retriever.widths asks for {cfg.widths[0]}, and the embeddings of {cfg.name} "
            f"have {entries} entries: give retriever.widths=[{fitting}]"
        )


def weights_digest(*models: str | Path | None) -> str:
    """A short hash of the safetensors of models in folders, wherever the folder is, by each file's
    name and size, the names and shapes of its tensors, and a block of each tensor's middle: what is
    trained, or merged, changes all of a tensor. A hub's name stands for itself, with its commit or
    without."""
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
    """Add the head of a file of safetensors to a hash, and a block of each of its tensors."""
    size = os.fstat(file.fileno()).st_size
    head = file.read(min(size, int.from_bytes(file.read(8), "little")))
    whole.update(head)
    try:
        tensors = [told for name, told in sorted(json.loads(head).items()) if name != METADATA]
        places = [(int(first), int(last)) for first, last in (t["data_offsets"] for t in tensors)]
    except (ValueError, TypeError, KeyError, AttributeError):
        # What loads the file tells that it is damaged.
        places = []
    for first, last in places:
        size = max(0, min(BLOCK, last - first))
        file.seek(max(0, 8 + len(head) + (first + last - size) // 2))
        whole.update(file.read(size))


def processor_digest(model: str | Path | None) -> str:
    """A short hash of what makes a model's input in a folder: the files of its tokenizer, its
    processor and its chat template; a hub's name stands for itself."""
    whole = hashlib.sha256()
    if model is None or not Path(model).is_dir():
        whole.update(f"{model}".encode())
        return whole.hexdigest()[:16]
    for path in sorted({p for pattern in PROCESSOR for p in Path(model).rglob(pattern)}):
        whole.update(f"{path.relative_to(model)} {path.stat().st_size} ".encode())
        whole.update(path.read_bytes())
    return whole.hexdigest()[:16]


def pin_revisions(cfg: Preset) -> Preset:
    """A preset with the commits of its hub's models as their revisions: a name stands for other
    weights once its owner changes them. A commit in the cache comes first. Where none can be known
    the preset stays as it is, and what loads the model tells why it cannot be had."""
    commits = {}
    for model, revision in (("model", "revision"), ("image_model", "image_revision")):
        if is_hub_model(name := getattr(cfg, model, None)):
            asked = getattr(cfg, revision)
            commits[revision] = _commit(name, asked) or asked
    return replace(cfg, **commits)


def _commit(model: str, revision: str | None) -> str | None:
    from huggingface_hub import model_info, try_to_load_from_cache

    try:
        # Adapters have no settings of a whole model beside them.
        for file in ("config.json", "adapter_config.json"):
            there = try_to_load_from_cache(model, file, revision=revision)
            if isinstance(there, str):
                # Within the cache, files stand in a folder that goes by the commit.
                return Path(there).parent.name
        return model_info(model, revision=revision, timeout=10).sha
    except Exception:
        # The hub's client raises errors of whichever HTTP library it has.
        return None


def is_hub_model(model: str | None) -> bool:
    """Whether a preset's model is a hub's, and neither a folder here nor built from a seed."""
    return model is not None and not Path(model).is_dir()


def model_id(cfg: Preset) -> str | None:
    """A preset's model: its folder, or the hub's name with the revision."""
    return _named(cfg.model, cfg.revision)


def image_model_id(cfg: RetrieverConfig) -> str | None:
    """The same of what embeds frames alone."""
    return _named(cfg.image_model, cfg.image_revision)


def _named(model: str | None, revision: str | None) -> str | None:
    at = f"@{revision}" if is_hub_model(model) and revision else ""
    return model and f"{model}{at}"


def based(folder: Path, cfg: Preset) -> Preset:
    """A run's preset with the commit that the run has noted of its hub's base, where there is a
    note: whatever the hub has by then, the run goes on, and is measured, over the same weights."""
    note = folder / BASE
    there = json.loads(note.read_text()) if note.exists() else ""
    name, _, commit = there.rpartition("@")
    return replace(cfg, revision=commit) if name and name == cfg.model else cfg


def note_base(folder: Path, cfg: Preset) -> None:
    """Note in a run's folder which weights it is trained over, a hub's by name and commit, others
    by their hash, and hold these to an earlier note: a run that goes on goes on over the same."""
    check_base(folder, cfg)
    if not is_hub_model(cfg.model):
        write_json(folder / BASE, weights_digest(cfg.model))
    elif cfg.revision:
        write_json(folder / BASE, model_id(cfg))


def note_data(folder: Path, store: Store, *told: Iterable[str]) -> None:
    """Note in a run's folder a hash of what it learns from, and hold it to an earlier note.

    Args:
        told: texts in which everything shows that the benchmark does not hold, in their order.

    Raises:
        UserError: the run was begun on other data.
    """
    whole = hashlib.sha256(store.identity.encode())
    for texts in told:
        for text in texts:
            whole.update(hashlib.sha256(text.encode()).digest())
    digest = whole.hexdigest()[:16]
    note = folder / DATA
    if note.exists() and json.loads(note.read_text()) != digest:
        raise UserError(
            f"{folder} was begun on other data than {store.folder} holds now: the benchmark, its "
            "rationales or how they are told have changed. Put those back, or train in a run of "
            "its own (run=NAME)"
        )
    write_json(note, digest)


def check_base(folder: Path, cfg: Preset) -> None:
    """Raises UserError where a run's base is in a folder, and not the one that it was trained
    over."""
    note = folder / BASE
    if is_hub_model(cfg.model) or not note.exists():
        return
    if json.loads(note.read_text()) != weights_digest(cfg.model):
        raise UserError(
            f"the weights in {cfg.model} are not those that {folder} is trained over: put those "
            "back, or delete that run and train again"
        )
