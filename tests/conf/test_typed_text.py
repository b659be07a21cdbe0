"""A setting that is a text keeps what was typed on the command line."""

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from dynapix.conf.compose import compose
from dynapix.conf.multirun.sweep import Sweep
from dynapix.conf.schema import SelectCommand, SftCommand
from dynapix.conf.typed_text import adapt_override, is_text
from tests.conf.schemas import SCHEMAS, walk_settings

NUMBERS = ("2026_11_29", "1e-4", "1.50", "1e3", "+1", "-0", "007", "true", "False", "inf", "nan")


def parse(override: str, schema: type = SelectCommand):
    return OverridesParser.create().parse_override(adapt_override(override, schema))


@pytest.mark.parametrize("schema", SCHEMAS.values())
def test_every_text_keeps_what_was_typed(schema):
    for key, _, hint in walk_settings(schema):
        if is_text(hint):
            typed, value = ("[1e-4]", ["1e-4"]) if "list" in str(hint) else ("1e-4", "1e-4")
            assert parse(f"{key}={typed}", schema).value() == value, key
            assert parse(f"{key}=null", schema).value() is None, key


@pytest.mark.parametrize("prefix", ["", "+", "++"])
def test_every_number_stays_a_text(prefix):
    for text in NUMBERS:
        assert parse(f"{prefix}student.name={text}").value() == text
        assert parse(f"{prefix}modes=[{text}, {text}]").value() == [text, text]
    swept = parse(f"{prefix}student.name={','.join(NUMBERS)}")
    assert [getattr(v, "text", v) for v in swept.sweep_iterator()] == list(NUMBERS)


@pytest.mark.parametrize(
    "value", ["a,b", "'1e-4'", '"a,1,b"', "range(0,2)", "choice(a,b)", "a/1e3"]
)
def test_other_values_stay(value):
    assert adapt_override(f"student.name={value}", SelectCommand) == f"student.name={value}"
    assert adapt_override(f"seed={value}", SelectCommand) == f"seed={value}"


def test_texts_in_sweeps_stay():
    jobs = Sweep("train.sft", SftCommand, ["student.name=1e-4,choice", "seed=0,1"]).jobs
    names = {compose("train.sft", SftCommand, job).student.name for job in jobs}
    assert names == {"1e-4", "choice"}
