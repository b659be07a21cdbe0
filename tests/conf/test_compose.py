"""Invalid settings raise a SettingsError whose message names the key."""

import pytest
from hydra.core.global_hydra import GlobalHydra

from dynapix.conf.compose import compose, compose_config, open_hydra
from dynapix.conf.errors import SettingsError
from dynapix.conf.multirun.sweep import Sweep
from dynapix.conf.schema import BuildCommand, ContrastiveCommand, ExportCommand, Quota, SftCommand
from tests.user_errors import raises_user_error


@pytest.mark.parametrize(
    ("override", "suggested"),
    [
        ("train.lrr=1", "train.lr"),
        ("++train.lrr=1", "train.lr"),
        ("lr=1", "train.lr"),
        ("studnet=tiny", "student"),
        ("benchmark.selection.time.in_1s.trian=3", "benchmark.selection.time.in_1s.train"),
        ("+expp=cot", "+exp"),
        ("student={lrr: 3}", "train.lr"),
    ],
)
def test_unknown_key_suggests_the_nearest(override, suggested):
    with raises_user_error("unknown-key", contains=f"did you mean {suggested}?"):
        compose("train.sft", SftCommand, [override])


@pytest.mark.parametrize(
    ("override", "code", "contains"),
    [
        ("train.lr=abc", "invalid-setting", "train.lr=abc"),
        ("train=1", "invalid-setting", "train=1"),
        ("student=nope", "invalid-setting", ("student/nope", "qwen3_vl_8b")),
        ("+exp=nope", "invalid-setting", ("exp/nope", "answer_only")),
        ("exp=cot", "invalid-setting", "+exp=cot"),
        ("retriever=tiny", "unknown-key", "retriever"),
        ("+exp=late_interaction", "unknown-key", "exp/late_interaction"),
        ("student.name=???", "missing-setting", "student.name"),
        ("student.architecture.layers=2", "invalid-setting", "student.architecture.layers"),
        ("train.lr=${nope}", "invalid-setting", ("train.lr", "nope")),
        ("hydra.launcher.nope=1", "unknown-key", "hydra.launcher.nope"),
        ("hydra/launcher=nope", "invalid-setting", ("hydra/launcher/nope", "process")),
        ("+benchmark.selection.event={new: {trian: 3}}", "unknown-key", "event.new.trian"),
        ("benchmark.selection.event={}", "invalid-setting", "event={}: an empty dict"),
        ("student=null", "invalid-setting", "student=null"),
        ("workers=0", "invalid-setting", "workers=0"),
        ("benchmark.height=129", "invalid-setting", "benchmark.height=129"),
        ("train.lr=inf", "invalid-setting", "train.lr=inf"),
        ("benchmark.world.camera.position=[nan,0,2]", "invalid-setting", "camera.position"),
        ("train.report_to=wandb", "invalid-setting", ("train.report_to=wandb", "[VALUE]")),
        ("run=a=b", "invalid-setting", ("run=a=b", "quotes")),
        ("checkpoints=", "invalid-setting", "checkpoints= is empty"),
        ("run=~/a", "invalid-setting", "run="),
        ("hydra.job.chdir=true", "invalid-setting", "hydra.job.chdir"),
        ("run=../../elsewhere", "invalid-setting", "run=../../elsewhere"),
        ("run=checkpoints/sft/first", "invalid-setting", "run=first"),
        ("benchmark.name=../elsewhere", "invalid-setting", "benchmark.name=../elsewhere"),
        ("world.camera.fov=3", "unknown-key", "@package benchmark.world"),
    ],
)
def test_invalid_value_is_named(override, code, contains):
    with raises_user_error(code, contains):
        compose("train.sft", SftCommand, [override])


def test_all_failed_checks_are_reported_together():
    with pytest.raises(SettingsError) as caught:
        compose("train.sft", SftCommand, ["train.lr=-1", "train.schedule=x", "benchmark.scenes=1"])
    lines = str(caught.value).splitlines()
    assert [line.partition("=")[0] for line in lines] == [
        "benchmark.scenes",
        "train.lr",
        "train.schedule",
    ]


@pytest.mark.parametrize(
    ("command", "schema", "overrides", "contains"),
    [
        ("train.sft", SftCommand, ["train.regime=answer_only", "train.facts=true"], "regime=cot"),
        ("train.contrastive", ContrastiveCommand, ["train.hard_negatives=9"],
         "benchmark.retrieval.hard_negatives"),
        ("train.sft", SftCommand, ["teacher=qwen3_32b", "teacher.url='http://h:P/v1'"],
         "teacher.url=http://h:P/v1"),
        ("data.export", ExportCommand, ["also=[small,tiny]"], "also: tiny is named twice"),
    ],
)  # fmt: skip
def test_settings_are_checked_together(command, schema, overrides, contains):
    with raises_user_error("invalid-setting", contains):
        compose(command, schema, overrides)


def test_optional_group_can_be_set_and_unset():
    sizes = ["student=tiny_scratch", "student.architecture.hidden=96"]
    assert compose("train.sft", SftCommand, sizes).student.architecture.hidden == 96
    unset = ["student=tiny_scratch", "student.architecture=null", "student.model=folder"]
    assert compose("train.sft", SftCommand, unset).student.architecture is None


def test_dict_setting_takes_new_names():
    new = ["+benchmark.selection.event={new: {train: 3}}"]
    assert compose("data.build", BuildCommand, new).benchmark.selection.event["new"] == Quota(3)


@pytest.mark.parametrize(
    ("overrides", "code", "contains"),
    [
        (["run=a,b"], "swept-run", "run="),
        (["train.lr=range(1,1)"], "no-jobs", "no jobs"),
        (["train.lrr=1,2"], "unknown-key", "did you mean train.lr?"),
        (["train.lr=1e-3,abc"], "invalid-setting", "train.lr=abc"),
        (["train.batch=12,16", "train.micro_batch=2,8"], "invalid-setting", "train.batch=12"),
        (["train.warmup=interval(0,1)"], "needs-search", "hydra/sweeper=optuna"),
        (["hydra/sweeper=optuna", "train.warmup=interval(0,1)"], "invalid-setting", "warmup=1"),
    ],
)
def test_each_job_of_a_sweep_is_checked(overrides, code, contains):
    with raises_user_error(code, contains):
        Sweep("train.sft", SftCommand, overrides)


def test_valid_sweep_is_accepted():
    sweep = ["student=tiny,qwen3_vl_8b", "+exp=cot", "seed=range(0,2)", "hydra.verbose=true"]
    jobs = Sweep("train.sft", SftCommand, sweep).jobs
    assert len(jobs) == 4


def test_a_running_command_composes_further_settings() -> None:
    """As `data.export also=[...]` does, inside the Hydra of its own command."""
    with open_hydra("data.export", ExportCommand):
        running = GlobalHydra.instance().hydra
        found = compose("data.build", BuildCommand, ["benchmark=tiny_contact"])
        assert found.benchmark.name == "tiny_contact"
        with pytest.raises(SettingsError, match="benchmark/nothing"):
            compose("data.build", BuildCommand, ["benchmark=nothing"])
        assert GlobalHydra.instance().hydra is running
        assert compose_config("data.export", ["folder=out"]).folder == "out"
    assert not GlobalHydra.instance().is_initialized()
