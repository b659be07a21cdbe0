import json

import numpy as np
import pytest
from PIL import Image

from evaluation import paper
from evaluation.figures import (
    item_figure,
    retrieval_figure,
    selection_figure,
)
from evaluation.metrics import accuracy_table, rank_metrics
from evaluation.tables import (
    RECALLS,
    UNTRAINED,
    RetrievalRow,
    SelectionRow,
    retrieval_table,
    selection_table,
)
from train.plots import curves_figure


@pytest.fixture(scope="module")
def selection_rows() -> list[SelectionRow]:
    families = ["event"] * 20 + ["time"] * 30 + ["window"] * 50
    quarter = [1, 0, 0, 0] * 25
    name = "a student with a name that is much too long for any table"
    return [
        SelectionRow.of("tiny", UNTRAINED, "answer", accuracy_table(families, quarter), 0.9),
        SelectionRow.of("tiny", name, "reasoning", accuracy_table(families, [1] * 100), 1.0),
        SelectionRow.of("tiny", "transfer", "similarity", accuracy_table(["event"], [1]), None),
    ]


@pytest.fixture(scope="module")
def retrieval_rows() -> list[RetrievalRow]:
    scores, gold = np.random.default_rng(0).random((20, 10_000)), np.arange(20)
    metrics = rank_metrics(scores, gold, RECALLS)
    return [
        RetrievalRow.of("tiny", name, width, metrics, 20, 10_000)
        for name in ("contrastive", UNTRAINED)
        for width in (64, 4096, 256)
    ]


def test_selection_table(selection_rows):
    table = selection_table(selection_rows)
    assert max(map(len, table.splitlines())) <= 100
    assert "26.7" in table  # 8 of the 30 time items
    assert "…" in table
    assert "(reasoning)" in table
    own, reference = table.split("paper (Qwen3-VL 8B, full benchmark)")
    assert paper.COT.name in reference
    assert "96.7" in reference
    assert UNTRAINED in own


def test_columns_are_aligned(selection_rows, retrieval_rows):
    selection = selection_table(selection_rows).splitlines()
    edge = selection[0].index("Macro") + len("Macro")
    assert selection[2][:edge].endswith(f"{100 * selection_rows[0].macro:.1f}")
    assert all(
        line[edge : edge + 2].strip() == "" for line in selection[2:-1] if line[0] not in "-p"
    )
    retrieval = retrieval_table(retrieval_rows).splitlines()
    edge = retrieval[0].index("MRR") + len("MRR")
    assert all(line[edge - 5 : edge - 3] == "0." for line in retrieval if line[0] not in "-pR")


def test_retrieval_table_sets_the_untrained_row_beside_each_width(retrieval_rows):
    lines = retrieval_table(retrieval_rows).splitlines()
    assert max(map(len, lines)) <= 100
    assert [line.split()[:2] for line in lines[2:8]] == [
        [name, str(width)] for width in (4096, 256, 64) for name in (UNTRAINED, "contrastive")
    ]


def test_rows_are_json(selection_rows, retrieval_rows):
    for row in (*selection_rows, *retrieval_rows):
        assert json.loads(json.dumps(row.to_dict())) == row.to_dict()
    assert selection_rows[0].to_dict()["families"]["time"]["n"] == 30


def test_figures_are_written(selection_rows, retrieval_rows, tmp_path):
    images = [Image.new("RGB", (48, 32), (i * 20, 90, 90)) for i in range(12)]
    question = "Which image best matches the next scene state?"
    selection_figure(selection_rows, tmp_path / "selection.png")
    retrieval_figure(retrieval_rows, tmp_path / "retrieval.png")
    for chosen in ("B", "C", None):
        path = tmp_path / f"item_{chosen}.png"
        item_figure(images, images[:4], "ABCD", "B", chosen, question, path)
    curves_figure(
        [{"step": 2, "loss": 1.0}, {"step": 1, "loss": 2.0}, {"step": 2, "eval_loss": 1.5,
         "eval_accuracy": 0.4, "eval_runtime": 3.0}, {"step": 2, "train_runtime": 9.0}],
        tmp_path / "losses.png",
    )  # fmt: skip
    curves_figure([], tmp_path / "no_losses.png")
    for path in tmp_path.iterdir():
        with Image.open(path) as image:
            assert image.width > 800
    assert len(list(tmp_path.iterdir())) == 7


def test_the_frame_says_what_was_right(tmp_path):
    images = [Image.new("RGB", (48, 32), "white")] * 4
    pixels = {}
    for chosen in ("B", "C", None):
        item_figure(images, images, "ABCD", "B", chosen, "Which?", tmp_path / "item.png")
        with Image.open(tmp_path / "item.png") as image:
            pixels[chosen] = np.asarray(image.convert("RGB")).reshape(-1, 3)
    green, red = [0x22, 0x88, 0x33], [0xCC, 0x33, 0x11]
    for chosen, wrong in (("B", False), ("C", True), (None, True)):
        assert (pixels[chosen] == green).all(1).any()
        assert (pixels[chosen] == red).all(1).any() == wrong
