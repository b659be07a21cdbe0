"""One reading of a path: `~` and links mean the same in every setting and for every library."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from dynapix.conf.compose import compose
from dynapix.conf.schema import SelectCommand
from dynapix.conf.typed_text import adapt_override
from tests.conf.schemas import SCHEMAS, walk_settings
from tests.user_errors import raises_user_error

PATHS = {
    key: schema
    for schema in SCHEMAS.values()
    for key, field, _ in walk_settings(schema)
    if field.metadata.get("is_path")
}
"""The settings that name a file or a folder, each with a command that has it."""


@pytest.fixture
def home(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "home"


def settings_with(schema: type, key: str, value: str):
    """Return settings in which every required setting but `key` has some value."""
    merged = OmegaConf.structured(schema)
    for missing in OmegaConf.missing_keys(merged):
        is_group = missing.rpartition(".")[2] in ("benchmark", "teacher", "student", "retriever")
        OmegaConf.update(merged, missing, {"name": "x"} if is_group else "x")
    OmegaConf.update(merged, key, value)
    return OmegaConf.to_object(merged)


@pytest.mark.parametrize(("key", "schema"), PATHS.items())
def test_every_path_expands_the_home_folder_and_names_a_broken_link(schema, key, home):
    group, _, name = key.rpartition(".")
    for typed, expected in (("~/a", str(home / "a")), ("./~/a", "./~/a"), ("a~", "a~")):
        settings = settings_with(schema, key, typed)
        for part in filter(None, group.split(".")):
            settings = getattr(settings, part)
        assert getattr(settings, name) == expected
    assert adapt_override(f"{key}=~/a", schema) == f"{key}='~/a'"
    Path("link").symlink_to("nowhere")
    for path in ("link", "link/below"):
        problems = settings_with(schema, key, path).check()
        assert any(p.startswith(f"{key}={path}: link is a link to nowhere") for p in problems)


def test_run_folder_is_below_the_expanded_folder_of_runs(home):
    (home / "ck/select").mkdir(parents=True)
    (home / "ck/select/mine").symlink_to("nowhere")
    overrides = ["checkpoints=~/ck", "run=mine"]
    with raises_user_error("broken-link", contains=str(home / "ck/select/mine")):
        compose("evaluation.select", SelectCommand, overrides)
    (home / "ck/select/new").mkdir()
    (home / "ck/select/new/run.log").symlink_to("nowhere/log")
    with raises_user_error("broken-link", contains="new/run.log"):
        compose("evaluation.select", SelectCommand, ["checkpoints=~/ck", "run=new"])
