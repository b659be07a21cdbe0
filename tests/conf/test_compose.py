"""A mistake in the settings ends in a sentence that names the key as typed, and the right one."""

import pytest

from conf.compose import compose, preflight
from conf.errors import SettingsError
from conf.schema import BuildCommand, ContrastiveCommand, Quota, SftCommand


def problem(*overrides: str, command: str = "train.sft", schema: type = SftCommand) -> str:
    with pytest.raises(SettingsError) as caught:
        compose(command, schema, list(overrides))
    text = str(caught.value)
    assert "Traceback" not in text
    assert "HYDRA_FULL_ERROR" not in text
    return text


@pytest.mark.parametrize(
    ("override", "meant"),
    [
        ("train.lrr=1", "train.lr"),
        ("+train.lrr=1", "train.lr"),
        ("++train.lrr=1", "train.lr"),
        ("lr=1", "train.lr"),
        ("student.lr=1", "train.lr"),
        ("student.lora.rnk=8", "student.lora.rank"),
        ("studnet=tiny", "student"),
        ("sed=3", "seed"),
        (
            "benchmark.selection.time.in_1s.trian=3",
            "benchmark.selection.time.in_1s.train",
        ),
        ("+expp=cot", "+exp"),
        ("+retrieval.hard_negative=2", "benchmark.retrieval.hard_negatives"),
    ],
)
def test_an_unknown_key_is_told_its_nearest(override, meant):
    typed = override.partition("=")[0]
    assert problem(override) == f"{typed}: train.sft has no such key, did you mean {meant}?"


def test_all_unknown_keys_are_told_at_once():
    assert len(problem("train.lrr=1", "++sed=2").splitlines()) == 2


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("train.lr=abc", "train.lr=abc: Value 'abc' of type 'str' could not be converted to Float"),
        ("seed=null", "seed=null: field 'seed' is not Optional"),
        ("train=1", "train=1: "),
        ("retriever.widths=[1", "retriever.widths=[1 cannot be read"),
        ("train.lr=1,2", "train.lr=1,2 is a sweep: run it with -m"),
        (
            "student=nope",
            "student=nope: no such student, the options are qwen3_5_27b, qwen3_6_27b, ",
        ),
        ("+exp=nope", "+exp=nope: no such exp, the options are answer_only, base, cot, "),
        ("exp=cot", "exp=cot: lay it over with a +, as +exp=cot"),
        ("+student=tiny", "+student=tiny: a student is chosen already, leave out the +"),
        ("retriever=tiny", "retriever: train.sft takes no retriever"),
        ("+retriever=tiny", "+retriever: train.sft takes no retriever"),
        ("student.name=???", "student.name is not set"),
        ("student.architecture.layers=2", "student.architecture.layers=2: cannot be set below"),
        ("train.lr=${nope}", "train.lr: Interpolation key 'nope' not found"),
        ("hydra/launcher=nope", "Available options in 'hydra/launcher': basic process"),
        ("student={lrr: 3}", "student.lrr: no such key"),
        ("+benchmark.selection.event.new={train: 3}", "+benchmark.selection.event={new: {...}}"),
        ("benchmark.selection.event.new.train=3", "+benchmark.selection.event={new: {...}}"),
        (
            "student=null",
            "student=null chooses nothing: the options are qwen3_5_27b, qwen3_6_27b, qwen3_vl_2b, ",
        ),
        ("+exp=null", "+exp=null chooses nothing: the options are answer_only, base, cot, "),
        ("workers=0", "workers=0 must be 1 or more"),
        ("benchmark.height=129", "benchmark.height=129: the aspect ratio"),
        ("train.keep=0", "train.keep=0 must be 1 or more"),
        ("train.max_steps=0", "train.max_steps=0 and train.epochs=2.5: give 1 or more"),
        ("+benchmark.selection.event={new: {trian: 3}}", "event.new.trian: no such key"),
    ],
)
def test_a_wrong_value_is_told(override, said):
    with pytest.raises(SettingsError) as caught:
        preflight("train.sft", SftCommand, [override], sweep=False)
    text = str(caught.value)
    assert said in text
    assert len(text.splitlines()) == 1


def test_an_overlay_of_another_command_is_told():
    text = problem("+exp=cot", command="train.contrastive", schema=ContrastiveCommand)
    assert "Key 'regime' not in 'ContrastiveTrainConfig'" in text


def test_every_failed_check_is_told_at_once():
    lines = problem("train.lr=-1", "train.schedule=x", "benchmark.scenes=1").splitlines()
    assert [line.partition("=")[0].split()[0] for line in lines] == [
        "benchmark.scenes",
        "train.lr",
        "train.schedule",
    ]


@pytest.mark.parametrize("url", ["localhost:8000/v1", "http://h:P/v1", "http://h h/v1"])
def test_an_address_that_is_none_is_told(url):
    said = problem(f"teacher.url='{url}'", "teacher=qwen3_32b")
    assert said.startswith(f"teacher.url={url} is not a URL")


def test_a_check_across_groups_is_told():
    text = problem("train.hard_negatives=9", command="train.contrastive", schema=ContrastiveCommand)
    assert text.startswith("train.hard_negatives=9 is more than benchmark.retrieval.hard_negatives")


def test_what_may_be_null_can_be_set_and_unset():
    sizes = ["student=tiny_scratch", "student.architecture.hidden=96"]
    assert compose("train.sft", SftCommand, sizes).student.architecture.hidden == 96
    unset = ["student=tiny_scratch", "student.architecture=null", "student.model=folder"]
    assert compose("train.sft", SftCommand, unset).student.architecture is None


def test_a_key_below_a_null_is_named_alone():
    said = problem("train.lr=1e-3", "student.architecture.hidden=96", "student.frames=4")
    assert said.startswith("student.architecture.hidden=96: cannot be set below a key that is null")


def test_a_dict_takes_new_names():
    new = ["+benchmark.selection.event={new: {train: 3}}"]
    assert compose("data.build", BuildCommand, new).benchmark.selection.event["new"] == Quota(3)


def test_keys_of_hydra_pass():
    compose("train.sft", SftCommand, ["hydra.verbose=true", "hydra/launcher=basic"])


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["train.lrr=1,2"], "did you mean train.lr?"),
        (["student=tiny,nope"], "student=nope: no such student"),
        (["train.lr=1e-3,abc"], "train.lr=abc: Value 'abc'"),
        (["train.lr=1e-3,-1"], "train.lr=-1.0 must be above 0"),
        (["train.warmup=interval(0,1)", "train.schedule=x"], "train.schedule=x: the options"),
    ],
)
def test_each_job_of_a_sweep_is_checked(overrides, said):
    with pytest.raises(SettingsError) as caught:
        preflight("train.sft", SftCommand, overrides, sweep=True)
    assert said in str(caught.value)


def test_a_sound_sweep_passes():
    sweep = ["student=tiny,qwen3_vl_8b", "+exp=cot,answer_only", "seed=range(0,2)"]
    preflight("train.sft", SftCommand, sweep, sweep=True)
