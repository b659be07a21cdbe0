"""A setting that is a text keeps what was typed, on the command line and in files of settings."""

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from dynapix.conf.compose import adapt_override, compose
from dynapix.conf.multirun.sweep import Sweep
from dynapix.conf.runs import run_name
from dynapix.conf.schema import SelectCommand, SftCommand
from dynapix.conf.typed_text import PresetSource
from tests.conf.schemas import COMMANDS, leaf_settings

NUMBERS = ("2026_11_29", "1e-4", "1.50", "1e3", "+1", "-0", "007", "true", "False", "inf", "nan")
TEXTS = [
    pytest.param(schema, key, is_list, id=f"{schema.__name__}-{key}")
    for schema in COMMANDS
    for key, is_list in leaf_settings(schema, str)
]


def parse(override: str, schema: type):
    return OverridesParser.create().parse_override(adapt_override(override, schema))


@pytest.mark.parametrize(("schema", "key", "is_list"), TEXTS)
def test_every_text_keeps_what_was_typed(schema, key, is_list):
    for prefix in ("", "+", "++"):
        for text in NUMBERS:
            values = [text, text] if is_list else text
            typed = f"[{text}, {text}]" if is_list else text
            assert parse(f"{prefix}{key}={typed}", schema).value() == values
        if not is_list:
            swept = parse(f"{prefix}{key}={','.join(NUMBERS)}", schema)
            assert [getattr(v, "text", v) for v in swept.sweep_iterator()] == list(NUMBERS)
        assert parse(f"{prefix}{key}=null", schema).value() is None


@pytest.mark.parametrize(
    "value", ["a,b", "'1e-4'", '"a,1,b"', "range(0,2)", "choice(a,b)", "a/1e3"]
)
def test_other_values_stay(value):
    assert adapt_override(f"student.name={value}", SelectCommand) == f"student.name={value}"
    assert adapt_override(f"seed={value}", SelectCommand) == f"seed={value}"


def test_texts_in_dicts_and_sweeps_stay():
    cfg = compose("train.sft", SftCommand, ["student={name: 1e3, lora: {rank: 8}}", "run=1.50"])
    assert (cfg.student.name, cfg.student.lora.rank, cfg.run) == ("1e3", 8, "1.50")
    jobs = Sweep("train.sft", SftCommand, ["student.name=1e-4,choice", "seed=0,1"]).jobs
    names = {compose("train.sft", SftCommand, job).student.name for job in jobs}
    assert names == {"1e-4", "choice"}


def test_a_name_that_looks_like_a_number_names_the_run():
    override = adapt_override("benchmark.name=2026_11", SelectCommand)
    assert run_name(None, [override]) == "benchmark.name-2026_11"


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_files_of_settings_keep_texts(tmp_path, monkeypatch, mark, end):
    (tmp_path / "presets_of_a_test").mkdir()
    (tmp_path / "presets_of_a_test" / "__init__.py").touch()
    lines = ["# @package student", "name: 2026_11_29", "model: 1e-4", "revision: null", "frames: 4"]
    file = tmp_path / "presets_of_a_test" / "mine.yaml"
    file.write_bytes(f"{mark}{end.join(lines)}{end}".encode())
    monkeypatch.syspath_prepend(tmp_path)
    loaded = PresetSource("test", "pkg://presets_of_a_test").load_config("mine")
    assert loaded.header["package"] == "student"
    merged = OmegaConf.merge(OmegaConf.structured(SftCommand), {"student": loaded.config}).student
    found = merged.name, merged.model, merged.revision, merged.frames
    assert found == ("2026_11_29", "1e-4", None, 4)
