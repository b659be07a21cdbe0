"""The table for VLMEvalKit has the prompts of `Item.messages`."""

from __future__ import annotations

import ast
import base64

import pandas as pd
import pytest

import dynapix
from dynapix.integrations.vlmevalkit import PLACEHOLDER, write_table
from tests.user_errors import raises_user_error

pytestmark = pytest.mark.slow


def test_the_table_has_the_prompts_and_answers(micro_store, tmp_path) -> None:
    bench = dynapix.load(micro_store.folder, image_size=96)
    path = write_table(bench, tmp_path / "table", "answer")
    table = pd.read_csv(path, sep="\t")
    assert [*table["index"]] == [item.item_id for item in bench.selection]
    for row, item in zip(table.to_dict("records"), bench.selection, strict=True):
        assert (row["answer"], row["category"]) == (item.answer, item.family)
        names, texts = ast.literal_eval(row["image_path"]), row["question"].split(PLACEHOLDER)
        [message] = item.messages("answer")
        shown = [""]
        for part in message["content"]:
            if part["type"] == "text":
                shown[-1] += part["text"]
            else:
                png = base64.b64decode(part["image_url"]["url"].partition(",")[2])
                assert (path.parent / names[len(shown) - 1]).read_bytes() == png
                shown.append("")
        assert shown == texts
    assert write_table(bench, tmp_path / "table", "answer") == path
    with raises_user_error("other-settings"):
        write_table(bench, tmp_path / "table")
    with raises_user_error("unknown-option"):
        write_table(bench, tmp_path / "other", "both")
