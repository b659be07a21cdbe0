"""Every YAML file of conf/ composes with the command in its first comment; values of presets."""

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import fields, is_dataclass
from importlib.resources import files
from pathlib import Path

import pytest

from dynapix.benchmark import _preset_world
from dynapix.conf import schema
from dynapix.conf.compose import compose, config_name, list_presets
from dynapix.conf.errors import SettingsError
from dynapix.conf.help import COMMON, TRAINING, description
from dynapix.data.items.recipes import WINDOW_CELLS
from tests.conf.schemas import SCHEMAS, parse_line, walk_settings

CONF = Path(str(files("dynapix.conf")))


def compose_line(line: str):
    """Compose the settings of a command line. For a sweep, its preset is composed as one run."""
    command, overrides = parse_line(line)
    # Each job of a sweep is composed in test_sweep.py.
    overrides = [o for o in overrides if o != "--multirun"]
    return compose(command, SCHEMAS[command], overrides)


def undescribed(settings: object, group: str = "") -> Iterator[str]:
    """Yield the settings that `--help` does not describe."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            yield from undescribed(value, f"{group}{field.name}.")
        elif not description(type(settings), field.name):
            yield f"{group}{field.name}"


@pytest.mark.parametrize(
    "path", sorted(CONF.rglob("*.yaml")), ids=lambda p: str(p.relative_to(CONF))
)
def test_first_comment_is_a_command_that_composes_the_file(path):
    lines = path.read_text().splitlines()
    line = lines[1] if lines[0].startswith("# @package") else lines[0]
    assert line.startswith("# python -m ")
    cfg = compose_line(line.removeprefix("# "))
    group = path.parent.name
    if group in ("exp", "sweep"):
        assert f"+{group}={path.stem}" in line
        assert ("--multirun" in line) == (group == "sweep")
    elif path.parent == CONF and path.stem != "run_folder":
        assert line == f"# python -m {next(c for c in SCHEMAS if config_name(c) == path.stem)}"
        assert list(undescribed(cfg)) == []
    elif group == "benchmark":
        # The library opens a built preset without Hydra.
        assert _preset_world(path.stem) == cfg.benchmark.world.name


def test_help_lists_the_overlays_that_compose():
    listed = list_presets("train.contrastive", schema.ContrastiveCommand)["exp"]
    for overlay in (path.stem for path in (CONF / "exp").iterdir()):
        with nullcontext() if overlay in listed else pytest.raises(SettingsError):
            compose("train.contrastive", schema.ContrastiveCommand, [f"+exp={overlay}"])


def test_presets_set_the_papers_recipes():
    student = compose_line("python -m train.sft student=qwen3_vl_8b")
    train, model = student.train, student.student
    assert (train.lr, train.epochs, train.batch, train.precision) == (2e-5, 3, 16, "bf16")
    assert (model.lora.rank, model.lora.alpha) == (16, 32)
    assert (model.frames, model.image_size, model.max_length) == (12, 336, 3072)
    retriever = compose_line("python -m train.contrastive retriever=qwen3_vl_emb_8b").train
    assert (retriever.batch, retriever.mini_batch, retriever.lr) == (512, 8, 2e-5)


def test_teacher_takes_one_server_or_several():
    command = "python -m teacher.narrate teacher=qwen3_32b"
    one = compose_line(command).teacher
    several = compose_line(f"{command} teacher.url=[http://a:8000/v1,https://b/v1]").teacher
    assert one.urls == ["http://127.0.0.1:8000/v1"]
    assert several.urls == ["http://a:8000/v1", "https://b/v1"]


def test_a_window_group_quota_is_divided_among_its_cells():
    window = compose_line(
        "python -m data.build benchmark=tiny benchmark.selection.window.G2_B.train=20 "
        "+benchmark.selection.window={G1_A_h16_easy:{train:7}}"
    ).benchmark.selection.window
    trains = [q.train for name, q in window.items() if name.startswith("G2_B")]
    assert trains == [4, 4, 3, 3, 3, 3]
    assert window["G1_A_h16_easy"] == schema.Quota(7, 0)
    assert list(window) == list(WINDOW_CELLS)


def totals(quotas: dict[str, schema.Quota], prefix: str = "") -> tuple[int, int]:
    """The training and test quota of the cells whose names begin with a prefix."""
    cells = [quota for name, quota in quotas.items() if name.startswith(prefix)]
    return sum(quota.train for quota in cells), sum(quota.test for quota in cells)


def test_quotas_add_up_to_the_papers_totals():
    benchmark = compose_line("python -m data.build benchmark=dynapix").benchmark
    track, retrieval = benchmark.selection, benchmark.retrieval
    assert (len(track.event), *totals(track.event)) == (7, 1151, 249)
    assert (len(track.time), *totals(track.time)) == (2, 1619, 374)
    assert (len(track.window), *totals(track.window)) == (54, 6598, 1585)
    assert track.event["future_offset_gap10"] == schema.Quota(163, 35)
    # The paper gives training items by group, and test items by group and family.
    groups = {"G1": 1967, "G2": 2300, "G3": 1578, "G4": 753}
    families = {
        "G1_A": 178, "G1_C": 234, "G2_A": 269, "G2_B": 266, "G2_C": 145, "G3_A": 173, "G3_C": 151,
        "G4_A": 84, "G4_B": 85,
    }  # fmt: skip
    assert {name: totals(track.window, name)[0] for name in groups} == groups
    assert {name: totals(track.window, name)[1] for name in families} == families
    assert sorted(retrieval.builders) == ["1", "2", "3", "4", "5", "6"]
    assert sum(totals(retrieval.builders)) == 22_500
    pool = [q.train + q.test for _, q in sorted(retrieval.builders.items())]
    assert pool == [5_625] * 3 + [1_875] * 3
    tested = [q.test for _, q in sorted(retrieval.builders.items())]
    assert (benchmark.test_scenes, sum(tested)) == (387, 2_002)
    assert (retrieval.database, retrieval.source) == (10_000, 30_000)
    assert retrieval.database / benchmark.test_scenes == pytest.approx(26, abs=0.2)
    without = retrieval.counterfactual
    assert (without.train + without.test, retrieval.counterfactual_source) == (18_225, 26_995)


def test_every_common_setting_exists_in_a_command() -> None:
    keys = {key for command in SCHEMAS.values() for key, _, _ in walk_settings(command)}
    assert {*COMMON, *TRAINING} <= keys
