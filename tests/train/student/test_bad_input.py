"""Unsuitable bases, adapters, checkpoints and rationales are refused before training."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from safetensors.torch import load_file, save_file
from transformers import (
    AutoProcessor,
    CLIPImageProcessor,
    CLIPProcessor,
    PreTrainedTokenizerFast,
    Qwen3Config,
    Qwen3ForCausalLM,
)

from dynapix.conf.entry import Run
from dynapix.conf.errors import UserError
from dynapix.conf.runs import open_run
from dynapix.conf.schema import (
    LoraConfig,
    RetrieverConfig,
    SelectCommand,
    SftCommand,
    StudentConfig,
)
from dynapix.data.store import JOURNAL
from dynapix.evaluation import select
from dynapix.models import loading, resolved_settings
from dynapix.models.retriever import embedder
from dynapix.models.tiny_qwen3_vl import build_model
from dynapix.teacher.journal import Journal
from dynapix.teacher.narrate import ensure_rationales
from dynapix.train import sft
from dynapix.train.common.training_loop import newest_checkpoint
from tests.user_errors import raises_user_error


@pytest.fixture(scope="module")
def settings(few_steps) -> SftCommand:
    return few_steps(regime="answer_only", max_steps=2)


@pytest.fixture(scope="module")
def trained(settings, tmp_path_factory) -> Path:
    """The folder of a finished run with two checkpoints, as the command leaves it."""
    run = Run("trained", tmp_path_factory.mktemp("trained"))
    open_run(run, asdict(settings), "train.sft")
    metrics = sft.main.__wrapped__(settings, run)
    (run.folder / "metrics.json").write_text(json.dumps(metrics))
    return run.folder


@pytest.mark.slow
def test_adapters_of_another_rank_are_refused(settings, trained) -> None:
    other = replace(settings, student=replace(settings.student, lora=LoraConfig(rank=8)))
    with raises_user_error("other-settings", contains="student.lora.rank was 4 and is now 8"):
        open_run(Run("trained", trained), asdict(other), "train.sft")


@pytest.fixture(scope="module")
def wider(saved_base: str, student_cfg, processor, tmp_path_factory) -> str:
    """A base with a larger hidden size than that of the trained student."""
    folder = tmp_path_factory.mktemp("wider")
    shutil.copytree(saved_base, folder, dirs_exist_ok=True)
    sizes = replace(student_cfg.architecture, hidden=128)
    build_model(sizes, len(processor.tokenizer)).save_pretrained(folder)
    return str(folder)


@pytest.mark.slow
def test_adapters_of_another_base_are_refused(
    settings, trained, wider, saved_base, tmp_path
) -> None:
    over = replace(settings.student, model=wider)
    with raises_user_error("other-base", contains=str(trained)):
        resolved_settings.check_base(trained, over)
    # A base may be moved to another folder.
    shutil.copytree(saved_base, tmp_path / "moved")
    resolved_settings.check_base(trained, replace(over, model=str(tmp_path / "moved")))


@pytest.mark.slow
def test_an_incomplete_checkpoint_is_skipped(trained, tmp_path, caplog) -> None:
    for name in ("checkpoint-1", "checkpoint-2"):
        shutil.copytree(trained / name, tmp_path / name)
    last = tmp_path / "checkpoint-2"
    assert newest_checkpoint(tmp_path) == last
    names = {path.name for path in last.iterdir()} - {"README.md"}
    assert {"adapter_model.safetensors", "optimizer.pt", "scheduler.pt", "rng_state.pth"} < names
    for name in names:
        content = (last / name).read_bytes()
        for left in (0, len(content) // 2, len(content) - 2):
            (last / name).write_bytes(content[:left])
            caplog.clear()
            assert newest_checkpoint(tmp_path) == tmp_path / "checkpoint-1"
            assert f"({name} is incomplete): trying the one before" in caplog.text
        (last / name).write_bytes(content)
    for name in names - {"adapter_config.json", "training_args.bin"}:
        content = (last / name).read_bytes()
        (last / name).unlink()
        caplog.clear()
        assert newest_checkpoint(tmp_path) == tmp_path / "checkpoint-1"
        assert "is missing): trying" in caplog.text
        (last / name).write_bytes(content)
    assert newest_checkpoint(tmp_path) == last
    shutil.rmtree(tmp_path / "checkpoint-1")
    (last / "optimizer.pt").unlink()
    assert newest_checkpoint(tmp_path) is None
    assert "(its optimizer is missing): training starts again" in caplog.text


def with_model(student: StudentConfig, folder: Path) -> StudentConfig:
    return replace(student, model=str(folder))


def retriever_over(folder: Path) -> RetrieverConfig:
    return RetrieverConfig(name="small", model=str(folder), quantization="none", widths=[64])


def test_a_base_without_a_vision_tower_is_refused(nf4_cfg, processor, tmp_path) -> None:
    sizes = {"hidden_size": 64, "intermediate_size": 64, "num_hidden_layers": 1}
    heads = {"num_attention_heads": 2, "num_key_value_heads": 2, "head_dim": 32}
    config = Qwen3Config(vocab_size=len(processor.tokenizer), **sizes, **heads)
    Qwen3ForCausalLM(config).save_pretrained(tmp_path)
    processor.tokenizer.save_pretrained(tmp_path)
    with raises_user_error("unsupported-model", contains=f"student.model={tmp_path}"):
        loading.load_student(with_model(nf4_cfg, tmp_path), "fp32", list)
    with raises_user_error("unloadable-model", contains="retriever.model"):
        embedder.load_retriever(retriever_over(tmp_path), "fp32", [], tmp_path)


def other_processor(folder: Path) -> None:
    tokenizer = PreTrainedTokenizerFast.from_pretrained(folder)
    (folder / "processor_config.json").unlink()
    CLIPProcessor(CLIPImageProcessor(), tokenizer).save_pretrained(folder)


def no_processor(folder: Path) -> None:
    (folder / "processor_config.json").unlink()


def other_grid(folder: Path) -> None:
    processor = AutoProcessor.from_pretrained(folder)
    processor.image_processor.patch_size = processor.video_processor.patch_size = 14
    processor.save_pretrained(folder)


def other_tokenizer(folder: Path) -> None:
    processor = AutoProcessor.from_pretrained(folder)
    processor.tokenizer.add_tokens([f"word{k}" for k in range(50)])
    processor.save_pretrained(folder)


def no_template(folder: Path) -> None:
    (folder / "chat_template.jinja").unlink()


def lack_weights(folder: Path) -> None:
    """transformers would give the missing weights random values."""
    weights = load_file(folder / "model.safetensors")
    kept = {key: value for key, value in weights.items() if "layers.0.self_attn.q_proj" not in key}
    save_file(kept, folder / "model.safetensors", {"format": "pt"})


@pytest.mark.parametrize(
    ("change", "code", "named"),
    [
        (other_processor, "other-processor", "CLIPProcessor"),
        (no_processor, "unloadable-model", "student.model"),
        (other_grid, "other-processor", "patch_size"),
        (other_tokenizer, "other-processor", "tokenizer"),
        (no_template, "no-chat-template", "chat_template.jinja"),
        (lack_weights, "missing-weights", ".0.self_attn.q_proj"),
    ],
)
def test_an_incomplete_base_or_files_of_another_are_refused(
    nf4_cfg, saved_base, tmp_path, change, code, named
) -> None:
    base = tmp_path / "base"
    shutil.copytree(saved_base, base)
    change(base)
    with raises_user_error(code, contains=named):
        loading.load_student(with_model(nf4_cfg, base), "fp32", list)
    if change not in (no_template, lack_weights):
        with pytest.raises(UserError):
            embedder.load_retriever(retriever_over(base), "fp32", [], tmp_path)


def test_rationales_of_another_benchmark_are_refused(settings, micro_store, tmp_path) -> None:
    first, *_ = ensure_rationales(micro_store, settings.teacher)
    store = tmp_path / "micro"
    shutil.copytree(micro_store.folder, store, ignore=shutil.ignore_patterns("frames"))
    journal = store / JOURNAL
    stranger = micro_store.selection("test")[0].item_id
    with Journal(journal) as opened:
        opened.append([replace(first, item_id=stranger)])
    before = journal.read_bytes()
    cot = replace(settings, store=str(tmp_path), train=replace(settings.train, regime="cot"))
    with raises_user_error("other-data", contains=(str(journal), stranger)):
        sft.main.__wrapped__(cot, Run("run", tmp_path))
    assert journal.read_bytes() == before


@pytest.mark.slow
def test_an_untrained_mode_is_refused(trained, micro, tmp_path) -> None:
    cfg = SelectCommand(model=str(trained), benchmark=micro, modes=["reasoning"])
    with raises_user_error("untrained-mode", contains="modes=[answer]"):
        select.main.__wrapped__(cfg, Run("run", tmp_path))
    assert OmegaConf.load(trained / "config.yaml").train.regime == "answer_only"
