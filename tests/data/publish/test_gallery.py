"""A gallery shows items and queries of the benchmark with the frames that the store contains."""

from __future__ import annotations

import re
from itertools import islice

import numpy as np
import pytest

from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.publish.contact_sheets import SheetRows
from dynapix.data.publish.gallery import draw_sheets, render_page
from dynapix.data.records import LETTERS
from dynapix.data.store import Store

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sheets(micro_store: Store) -> list:
    return list(draw_sheets(micro_store, examples=1, seed=0))


def test_every_subtype_builder_and_control_has_a_sheet(micro_store, sheets) -> None:
    files = [s.file for s in sheets]
    assert len(files) == len(set(files))
    expected = {f"{i.family}-{i.subtype}.png" for i in micro_store.selection()}
    expected |= {f"retrieval-builder-{q.builder}.png" for q in micro_store.retrieval()}
    expected |= {"counterfactual.png", "controls-matched_anchor.png"}
    assert set(files) == expected


def test_the_seed_determines_the_sheets(micro_store, sheets) -> None:
    same = list(islice(draw_sheets(micro_store, examples=1, seed=0), 9))
    other = list(islice(draw_sheets(micro_store, examples=1, seed=1), 9))
    assert same == sheets[:9]
    assert [s.file for s in other] == [s.file for s in same]
    assert other != same


def test_an_item_row_shows_candidates_target_and_displacements(micro_store) -> None:
    rows, frames = SheetRows(micro_store), FrameReader(micro_store)
    for item in micro_store.selection("test")[::7]:
        row = rows.make(item)
        assert [c.is_answer for c in row.candidates] == [k == item.answer for k in range(4)]
        for letter, cell, candidate in zip(LETTERS, row.candidates, item.candidates, strict=True):
            assert np.array_equal(cell.image, frames.array(candidate.scene_id, candidate.frame))
            assert cell.caption[0] == f"{letter}: {candidate.source}"
        least = min(float(c.caption[1].split(" px")[0].split()[-1]) for c in row.candidates)
        assert least == round(item.min_displacement)
        assert row.prefix[0].caption == (f"frame {item.prefix_start}",)
        assert row.prefix[-1].caption == (f"frame {item.prefix_stop}",)
        assert ("framing" in row.heading) == (item.family == "event")
        assert "None" not in row.heading


def test_a_counterfactual_row_shows_the_same_frame_with_and_without_the_removed_object(
    micro_store,
) -> None:
    rows, frames = SheetRows(micro_store), FrameReader(micro_store)
    for query in micro_store.retrieval(pool="counterfactual"):
        factual, target, *wrong = rows.make(query).candidates
        assert all("px away" in cell.caption[1] for cell in wrong)
        frame = query.target.frame
        assert np.array_equal(factual.image, frames.array(query.scene_id, frame))
        assert np.array_equal(target.image, frames.array(query.target.scene_id, frame))
        assert (factual.is_answer, target.is_answer) == (False, True)


def test_the_page_links_its_sections_and_every_sheet_once(micro_store, sheets) -> None:
    page = render_page(micro_store, sheets)
    found = {name: re.findall(f' {name}="([^"]*)"', page) for name in ("href", "id", "src")}
    assert found["src"] == [s.file for s in sheets]
    inside = [f"#{name}" for name in found["id"]]
    assert sorted(found["href"]) == sorted(inside + found["src"])
    assert len(set(found["id"])) == len(sheets)
