"""What the trainer chooses for itself fits, moves nothing that is learnt, and leaves no trace."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import torch
from torch import nn

from conf.entry import Run
from conf.schema import SftCommand
from conf.schema.training import SftTrainConfig
from models import memory
from models.loading import load_student
from models.student.collator import Collator
from train import sft
from train.common import journal, memory_probe
from train.common.memory_probe import Choice, choose, settle, sizes
from train.student.dataset import splits
from train.student.lazy_samples import Samples

AUTO = Choice("auto", "auto")


@dataclass
class Linear:
    """A step of 16 samples that holds bytes and takes seconds by its samples and micro-batches."""

    fixed: int = 100
    kept: int = 1000
    recomputed: int = 90
    overhead: float = 0.0
    """Seconds of a micro-batch, next to one of each sample."""
    tried: list[tuple[int, bool]] = field(default_factory=list)

    def bytes(self, micro_batch: int, recompute: bool) -> int | None:
        self.tried.append((micro_batch, recompute))
        return self.fixed + micro_batch * (self.recomputed if recompute else self.kept)

    def seconds(self, micro_batch: int, recompute: bool) -> float:
        return 16 * (1.3 if recompute else 1.0) + 16 / micro_batch * self.overhead


def test_sizes_divide_a_step() -> None:
    assert sizes(16) == [1, 2, 4, 8, 16]
    assert sizes(15) == [1, 3, 15]
    assert sizes(7) == [1, 7]
    assert sizes(1) == [1]


@pytest.mark.parametrize("overhead", [0.0, 0.5, 100.0])
def test_less_memory_never_takes_more(overhead) -> None:
    trial = Linear(overhead=overhead)
    limits = range(50, 20_000, 50)
    chosen = [choose(trial, AUTO, 16, limit)[0] for limit in limits]
    kept = [not c.gradient_checkpointing for c in chosen]
    # Activations are kept from the first limit on that one sample fits into.
    assert kept == [limit >= 1100 for limit in limits]
    for mode in (True, False):
        micro = [c.micro_batch for c, k in zip(chosen, kept, strict=True) if k == mode]
        assert micro == sorted(micro)
        assert micro[0] == 1
    # Where a pass has costs of its own, more pass at once, until that saves no more.
    assert chosen[-1].micro_batch == {0.0: 1, 0.5: 8, 100.0: 16}[overhead]


@pytest.mark.parametrize("limit", range(100, 20_000, 700))
def test_what_is_tried_and_what_is_chosen_fits(limit) -> None:
    trial = Linear(overhead=100.0)
    choice, needed = choose(trial, AUTO, 16, limit)
    # One sample has to be tried; nothing beyond it that does not fit.
    assert all(Linear().bytes(*tried) <= limit for tried in trial.tried if tried[0] > 1)
    exact = Linear().bytes(choice.micro_batch, choice.gradient_checkpointing)
    assert needed is None or exact <= needed <= limit
    assert (needed is None) == (limit < 190)


def test_running_out_while_trying_is_not_fitting() -> None:
    class Small(Linear):
        def bytes(self, micro_batch: int, recompute: bool) -> int | None:
            return 1 if recompute and micro_batch < 4 else None

    assert choose(Small(overhead=100.0), AUTO, 16, 1000)[0] == Choice(2, True)


@pytest.mark.parametrize("micro_batch", [1, 4])
def test_a_given_micro_batch_stays_and_is_counted_whole(micro_batch) -> None:
    given = replace(AUTO, micro_batch=micro_batch)
    for limit, recompute in ((1000 * micro_batch, False), (1000 * micro_batch - 1, True)):
        choice, _ = choose(Linear(fixed=0), given, 16, limit)
        assert choice == Choice(micro_batch, recompute)
    kept = replace(AUTO, gradient_checkpointing=False)
    assert not choose(Linear(), kept, 16, 1)[0].gradient_checkpointing


def test_the_ranks_agree_on_what_fits_all() -> None:
    assert memory_probe.least([Choice(8, False), Choice(4, True)]) == Choice(4, True)
    assert memory_probe.least([Choice(8, False)]) == Choice(8, False)


def test_bytes_are_those_of_the_step() -> None:
    """A step that holds 256 MiB takes those, whatever was held and freed before."""
    spent = torch.ones(64 << 20)
    del spent
    held = memory.reset_peak(torch.device("cpu"))
    torch.ones(64 << 20).sum()
    found = memory.peak_bytes(torch.device("cpu")) - held
    assert 0.95 * (256 << 20) < found < 1.2 * (256 << 20)


def test_a_containers_limit_holds(tmp_path, monkeypatch) -> None:
    device = torch.device("cpu")
    for name, text in (("max", "1000000"), ("current", "600000"), ("stat", "inactive_file 200000")):
        (tmp_path / f"memory.{name}").write_text(f"{text}\n")
    names = ("memory.max", "memory.current", "inactive_file")
    monkeypatch.setattr(memory, "CGROUPS", ((str(tmp_path), *names),))
    assert memory.available_bytes(device) == 600_000
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.available_bytes(device) > 1_000_000


@pytest.fixture
def settings(few_steps) -> SftCommand:
    auto = few_steps(
        regime="answer_only",
        max_steps=2,
        batch=4,
        micro_batch="auto",
        gradient_checkpointing="auto",
    )
    # Dropout draws: a probe that shifts the generator would show.
    lora = replace(auto.student.lora, dropout=0.1)
    return replace(auto, student=replace(auto.student, lora=lora))


@pytest.fixture
def student(settings, micro_store, frames):
    model, processor = load_student(settings.student, "fp32", list)
    training: Samples = splits(micro_store, [], settings, frames)[0]
    lengths = training.lengths(processor.tokenizer, 96)
    return model, Collator(processor, 1500), training, lengths


def test_a_probe_leaves_no_trace(settings, student, tmp_path) -> None:
    model = student[0]
    model.eval()
    before = {name: weight.clone() for name, weight in model.state_dict().items()}
    torch.manual_seed(3)
    drawn = torch.rand(3)
    torch.manual_seed(3)
    found = settle(settings.train, tmp_path, *student)
    assert torch.equal(torch.rand(3), drawn)
    assert all(torch.equal(weight, before[name]) for name, weight in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())
    assert not model.training
    assert not model.is_gradient_checkpointing
    assert settings.train.batch % found.micro_batch == 0
    assert found.gradient_checkpointing is False


def saved(model: nn.Module, batch: dict, recompute: bool) -> int:
    """Bytes that a forward pass keeps for the backward pass."""
    sizes: dict[int, int] = {}

    def note(tensor: torch.Tensor) -> torch.Tensor:
        sizes[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    batch.pop("labels")
    with memory_probe.probing(model), torch.autograd.graph.saved_tensors_hooks(note, lambda t: t):
        memory_probe.switch(model, recompute)
        model(**batch)
    weights = {p.untyped_storage().data_ptr() for p in model.parameters()}
    return sum(size for storage, size in sizes.items() if storage not in weights)


def test_where_memory_is_short_activations_are_recomputed(
    settings, student, tmp_path, monkeypatch
) -> None:
    model, collator, training, _ = student
    kept, recomputed = (saved(model, collator([training[0]]), mode) for mode in (False, True))
    assert recomputed < kept / 2
    monkeypatch.setattr(memory_probe, "available", lambda _: 1 << 20)
    found = settle(settings.train, tmp_path, *student)
    assert (found.micro_batch, found.gradient_checkpointing) == (1, True)


def test_features_that_are_kept_leave_a_step_the_other_half(
    settings, student, tmp_path, monkeypatch
) -> None:
    """On a CPU both are in the machine's memory."""
    free, limits = 1 << 40, {}
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(memory_probe, "available", lambda _: free)
    for reuse in (False, True):

        def note(trial, asked, share, limit, reuse=reuse):
            limits[reuse] = limit
            return Choice(1, False), limit

        monkeypatch.setattr(memory_probe, "choose", note)
        (folder := tmp_path / str(reuse)).mkdir()
        settle(replace(settings.train, reuse_features=reuse), folder, *student)
    assert limits[True] + free // 2 <= free
    assert limits[False] + free // 2 > free


def test_a_run_that_goes_on_takes_what_was_noted(settings, student, tmp_path, monkeypatch) -> None:
    memory_probe.write_json(
        tmp_path / memory_probe.NOTE, {"micro_batch": 2, "gradient_checkpointing": True}
    )
    monkeypatch.setattr(memory_probe, "Passes", None)
    found = settle(settings.train, tmp_path, *student)
    assert (found.micro_batch, found.gradient_checkpointing) == (2, True)
    given = replace(settings.train, micro_batch=4, gradient_checkpointing=False)
    assert settle(given, tmp_path, *student) == given


@pytest.mark.parametrize("note", ["{", "{}", '{"micro_batch": 3, "gradient_checkpointing": true}'])
def test_a_note_that_does_not_hold_is_chosen_anew(settings, student, tmp_path, note) -> None:
    (tmp_path / memory_probe.NOTE).write_text(note)
    found = settle(settings.train, tmp_path, *student)
    told = json.loads((tmp_path / memory_probe.NOTE).read_text())
    assert told == {"micro_batch": found.micro_batch, "gradient_checkpointing": False}


@pytest.mark.slow
@pytest.mark.parametrize("short", [False, True])
def test_what_is_chosen_learns_what_a_given_one_learns(
    settings, tmp_path, monkeypatch, short
) -> None:
    """The losses and gradients of a run that chose are those of one that was told."""
    if short:
        monkeypatch.setattr(memory_probe, "available", lambda _: 1 << 20)
    journals = []
    plain = replace(settings.student, lora=replace(settings.student.lora, dropout=0.0))
    fixed = replace(settings.train, micro_batch=4, gradient_checkpointing=False)
    for name, train in (("auto", settings.train), ("given", fixed)):
        folder: Path = tmp_path / name
        folder.mkdir()
        sft.main.__wrapped__(replace(settings, student=plain, train=train), Run(name, folder))
        journals.append(journal.read_journal(folder))
    chosen = json.loads((tmp_path / "auto" / memory_probe.NOTE).read_text())
    assert chosen["gradient_checkpointing"] == short
    assert not (tmp_path / "given" / memory_probe.NOTE).exists()
    for one, two in zip(*journals, strict=True):
        # The library tells the share of the epoch in micro-batches, of which the last are fewer.
        assert one | {"epoch": 0} == pytest.approx(two | {"epoch": 0}, rel=1e-3)


def test_what_is_advised_is_what_is_left_to_do() -> None:
    train = SftTrainConfig(micro_batch=4, gradient_checkpointing=False, reuse_features=True)
    told = memory_probe.lower(train)
    assert "lower train.micro_batch, which is 4" in told
    assert "train.gradient_checkpointing=true, or set train.reuse_features=false" in told
    spare = replace(train, micro_batch=1, gradient_checkpointing=True, reuse_features=False)
    assert memory_probe.lower(spare) == (
        "lower student.image_size or student.frames, in a run of its own (run=NAME)"
    )
