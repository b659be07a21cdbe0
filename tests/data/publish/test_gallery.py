"""What a gallery shows is what the benchmark asks."""

from __future__ import annotations

import io
from html.parser import HTMLParser
from itertools import islice

import numpy as np
import pytest
from PIL import Image

from data.gallery import Looker, page, sheets
from data.publish.contact_sheets import BREAK, CELL, GAP, MARGIN, RADIUS, _seen_floor, paths, sheet
from data.records import LETTERS
from data.render.frame_cache import FrameReader
from data.store import Store
from data.world.camera import Camera
from data.world.displacement import cross_scene_displacement

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def drawn(micro_store: Store) -> list:
    return list(sheets(micro_store, examples=1, seed=0))


def test_every_cell_and_builder_has_a_sheet(micro_store, drawn) -> None:
    files = [s.file for s in drawn]
    assert len(files) == len(set(files))
    asked = {f"{i.family}-{i.subtype}.png" for i in micro_store.selection()}
    asked |= {f"retrieval-builder-{q.builder}.png" for q in micro_store.retrieval()}
    others = {"counterfactual.png", "paths.png", "controls-matched_anchor.png"}
    assert set(files) == asked | others


def test_a_seed_gives_the_same_sheets_and_another_seed_others(micro_store, drawn) -> None:
    again = list(islice(sheets(micro_store, examples=1, seed=0), 9))
    other = list(islice(sheets(micro_store, examples=1, seed=1), 9))
    assert again == drawn[:9]
    assert [s.file for s in other] == [s.file for s in again]
    assert other != again


def test_an_item_is_shown_with_its_answer_and_its_displacements(micro_store) -> None:
    look, frames = Looker(micro_store), FrameReader(micro_store)
    for item in micro_store.selection("test")[::7]:
        row = look.item(item)
        assert "".join(c.letter for c in row.others) == LETTERS
        assert [c.right for c in row.others].index(True) == item.answer
        assert sum(c.right for c in row.others) == 1
        for cell, candidate in zip(row.others, item.candidates, strict=True):
            assert np.array_equal(cell.image, frames.array(candidate.scene_id, candidate.frame))
            assert cell.caption[0] == candidate.source
        least = min(float(c.caption[1].split(" px")[0].split()[-1]) for c in row.others)
        assert least == round(item.min_displacement)
        assert row.observed[0].caption == (f"frame {item.prefix_start}",)
        assert row.observed[-1].caption == (f"frame {item.prefix_stop}",)


def test_axes_that_do_not_apply_are_not_told(micro_store) -> None:
    look = Looker(micro_store)
    about = {i.family: look.item(i).about for i in micro_store.selection("test")}
    assert "framing" in about["event"]
    assert "group" in about["window"]
    assert not any("None" in text for text in about.values())
    assert "framing" not in about["window"]


def test_a_counterfactual_pair_shows_one_moment_with_and_without(micro_store) -> None:
    look, frames = Looker(micro_store), FrameReader(micro_store)
    for query in micro_store.retrieval(pool="counterfactual"):
        row = look.absence(query)
        factual, target = row.others[:2]
        frame = query.target.frame
        assert np.array_equal(factual.image, frames.array(query.scene_id, frame))
        assert np.array_equal(target.image, frames.array(query.target.scene_id, frame))
        assert (factual.right, target.right) == (False, True)
        assert query.removed_object in row.about
        # The ring is where the object's own colour is missing from the other scene.
        scene = micro_store.scene(query.scene_id)
        removed = [o.phrase for o in scene.objects].index(query.removed_object)
        x, y = scene.image_positions[frame, removed]
        assert factual.ring == pytest.approx((x / 480, y / 320))
        assert target.ring is None


def test_an_answer_is_framed_in_green(micro_store) -> None:
    item = micro_store.selection("test")[0]
    picture = np.asarray(Image.open(io.BytesIO(sheet([Looker(micro_store).item(item)]))))
    green = (picture == (26, 127, 55)).all(-1)
    across = np.flatnonzero(green.any(0))
    left = MARGIN + (4 + item.answer) * (CELL + GAP) + BREAK
    assert across.min() == left - 4
    assert left + CELL <= across.max() <= left + CELL + 4


def test_the_floor_that_is_drawn_is_what_the_camera_sees() -> None:
    corners = _seen_floor()
    points = np.column_stack([corners[:, 1], corners[:, 0], np.full(4, RADIUS)])
    seen, _ = Camera().project(points)
    assert seen == pytest.approx(np.array([[0, 0], [480, 0], [480, 320], [0, 320]]), abs=1e-6)


def test_paths_of_any_number_of_scenes_are_drawn(micro_store) -> None:
    scenes = [micro_store.scene(name) for name in micro_store.scene_ids("train")]
    sizes = [Image.open(io.BytesIO(paths(scenes[:n]))).size for n in (1, 3, 4)]
    assert sizes[0] == sizes[1]
    assert sizes[2][1] == 2 * sizes[1][1]


class Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: dict[str, list[str]] = {"href": [], "id": [], "src": []}

    def handle_starttag(self, tag: str, attrs: list) -> None:
        for name, value in attrs:
            if name in self.found:
                self.found[name].append(value)


def test_the_page_links_every_sheet_once_and_nothing_outside(micro_store, drawn) -> None:
    links = Links()
    links.feed(page(micro_store, [(s.section, s.title, s.file) for s in drawn]))
    assert links.found["src"] == [s.file for s in drawn]
    inside = [f"#{name}" for name in links.found["id"]]
    assert sorted(links.found["href"]) == sorted(inside + links.found["src"])
    assert len(set(links.found["id"])) == len(drawn)


def test_displacements_on_a_sheet_are_the_geometrys(micro_store) -> None:
    query = micro_store.retrieval("test")[0]
    scene = micro_store.scene(query.scene_id)
    for cell, frame in zip(Looker(micro_store).query(query).others[1:], query.hard_negatives,
                           strict=True):  # fmt: skip
        away = cross_scene_displacement(scene, query.target.frame, scene, frame.frame)
        assert f"{away:.0f} px off" in cell.caption[1]
