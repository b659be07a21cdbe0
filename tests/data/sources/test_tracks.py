"""Tracked videos are read as scenes without contacts, and become a benchmark; bad input is refused
with the place of the fault."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from dynapix.conf.schema import (
    BenchmarkConfig,
    Quota,
    RetrievalTrackConfig,
    SelectionConfig,
    TeacherConfig,
)
from dynapix.data.build import ensure_benchmark
from dynapix.data.checks.baselines import constant_velocity_error
from dynapix.data.items.queries import BUILDERS
from dynapix.data.items.recipes import (
    CELLS_WITHOUT_CONTACTS,
    TIME_CELLS,
    TIME_QUESTION,
    spell_seconds,
)
from dynapix.data.parallel import Workers
from dynapix.data.sources import tracks
from dynapix.data.sources.scenes import make_scenes
from dynapix.data.store import Store
from dynapix.teacher.narrate import narrate_store
from dynapix.teacher.predicates.extraction import extract_facts
from dynapix.teacher.predicates.margins import find_relations
from dynapix.teacher.predicates.places import close_pairs
from dynapix.teacher.predicates.relations import Places
from tests.data.sources.pictures import write_video
from tests.data.sources.tracks_files import SIZE, box_lines, write_tracked_video
from tests.user_errors import raises_user_error


def read(folder: Path, clip: int = 0):
    return tracks.read_scene(tracks.list_scenes(folder)[clip], folder, "test")


def test_a_scene_has_the_boxes_of_its_file(tmp_path: Path) -> None:
    write_tracked_video(tmp_path)
    scene = read(tmp_path)
    assert (scene.scene_id, scene.fps, scene.image_size) == ("street-000000", 25, SIZE)
    assert [o.noun_phrase for o in scene.objects] == ["red ball", "metal van"]
    assert (scene.frames, scene.collisions, scene.records_contacts) == (128, (), False)
    np.testing.assert_allclose(scene.image_positions[10], [[13, 23], [66, 12]], rtol=1e-6)
    np.testing.assert_allclose(scene.positions[10, 0], [13 / 64, 41 / 64, 0], rtol=1e-6)
    # 0.5 and 0.3 px per frame at 25 frames per second, in heights of 64 px; y points up.
    np.testing.assert_allclose(scene.velocities[10], [[12.5 / 64, 0, 0], [0, -7.5 / 64, 0]])
    np.testing.assert_allclose(scene.visible_fraction[3], [1, 0.75])
    assert scene.in_view.all()
    # The layout of results has no visibility and may lack confidences; in the other one, a
    # visibility may be unknown.
    results = [",".join([*line.split(",")[:6], "-1", "-1", "-1", "-1"]) for line in box_lines(40)]
    unknown = [line.rpartition(",")[0] + ",-1" for line in box_lines(40)]
    for lines in (results, unknown):
        write_tracked_video(tmp_path, "street", 40, 25, *lines)
        scene = read(tmp_path)
        assert scene.in_view.all()
        assert np.isnan(scene.visible_fraction).all()


def test_a_gap_of_a_track_is_interpolated_and_out_of_view(tmp_path: Path) -> None:
    gone = (*(f"{f}," for f in range(11, 16)),)
    lines = [line for line in box_lines(60) if not line.startswith(gone)]
    ignored = [line.replace(",1,1,1", ",0,1,1") for line in box_lines(60)[20:22]]
    write_tracked_video(tmp_path, "street", 60, 25, *lines, *ignored)
    scene = read(tmp_path)
    assert np.flatnonzero(~scene.in_view[:, 0]).tolist() == [10, 11, 12, 13, 14]
    np.testing.assert_allclose(scene.image_positions[12, 0], [14, 23], rtol=1e-6)
    assert not scene.visible_fraction[12].any()


def test_a_video_is_cut_into_clips_with_their_own_objects_and_frames(tmp_path: Path) -> None:
    lines = [
        line for line in box_lines(280) if line.split(",")[1] == "1" or int(line.split(",")[0]) < 9
    ]
    write_tracked_video(tmp_path, "street", 280, 25, *lines)
    names = [f"{p.parent.name}/{p.name}" for p in tracks.list_scenes(tmp_path)]
    assert names == ["street.mp4/000000", "street.mp4/000128", "street.mp4/000256"]
    second, last = read(tmp_path, 1), read(tmp_path, 2)
    assert (second.frames, last.frames, len(second.objects)) == (128, 24, 1)
    assert second.scene_id == "street-000128"
    images = tracks.load_images(second, tmp_path, [0, 100, 127])
    for frame, image in images.items():
        brightness = (128 + frame) % 150 + 60
        assert np.asarray(image).mean() == pytest.approx(brightness, abs=2)


def test_the_rate_and_nouns_of_classes_may_be_given(tmp_path: Path) -> None:
    write_tracked_video(tmp_path, frames=40)
    names = {"classes": {1: "cyclist", 3: "dog"}, "videos": {"street": {"fps": 12.5}}}
    (tmp_path / "tracks.yaml").write_text(yaml.safe_dump(names))
    scene = read(tmp_path)
    assert scene.fps == 12.5
    assert [o.noun_phrase for o in scene.objects] == ["cyclist", "dog"]
    names["videos"]["street"]["fps"] = 4.9
    (tmp_path / "tracks.yaml").write_text(yaml.safe_dump(names))
    with raises_user_error("invalid-record", contains=("4.9 frames", "at least 5", "street.fps")):
        read(tmp_path)


LINE_DEFECTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "too few columns": ("5,1,0,0,8,6,1", ("line 5", "frame 5", "7 columns", "9")),
    "columns of the other layout": ("5,1,0,0,8,6,1,-1,-1,-1", ("line 5", "10 columns")),
    "a word": ("5,1,0,wide,8,6,1,1,1", ("line 5", "frame 5", "bb_top is 'wide'")),
    "a detection without a track": ("5,-1,0,0,8,6,1,1,1", ("line 5", "id is '-1'")),
    "half a frame": ("4.5,1,0,0,8,6,1,1,1", ("line 5", "frame is '4.5'")),
    "a character that is no UTF-8": ("5,1,0,0,8,6,1,1,\udcff", ("line 5", "visibility")),
    "a repeated box": ("2,1,0,0,8,6,1,1,1", ("line 5", "frame 2", "id 1", "line 3")),
    "a frame beyond the video": ("41,1,20,20,8,6,1,1,1", ("line 5", "frame 41", "40 frames")),
    "a switch of identities": ("3,1,80,50,8,6,1,1,1", ("line 5", "id 1", "frame 3", "diagonal")),
    "an object without a noun": ("3,7,80,50,8,6,1,9,1", ("line 5", "id 7", "noun", "street")),
}


@pytest.mark.parametrize("defect", LINE_DEFECTS)
def test_a_wrong_line_is_refused(tmp_path: Path, defect: str) -> None:
    line, named = LINE_DEFECTS[defect]
    text = write_tracked_video(tmp_path, "street", 40, 25, *box_lines(2), line)
    with raises_user_error("invalid-record", contains=(str(text), *named)):
        read(tmp_path)


NAME_DEFECTS: dict[str, tuple[Callable[[dict], object], str]] = {
    "an id that does not exist": (
        lambda videos: videos["street"]["objects"].update({9: {"noun": "dog"}}),
        "videos.street.objects.9",
    ),
    "a video that does not exist": (lambda videos: videos.update(road={}), "videos.road"),
    "a key of another name": (
        lambda videos: videos["street"]["objects"][1].update(colour="red"),
        "videos.street.objects.1.colour",
    ),
    "a noun with a digit": (
        lambda videos: videos["street"]["objects"][1].update(noun="car 2"),
        "videos.street.objects.1.noun",
    ),
}


@pytest.mark.parametrize("defect", NAME_DEFECTS)
def test_wrong_names_are_refused(tmp_path: Path, defect: str) -> None:
    change, named = NAME_DEFECTS[defect]
    write_tracked_video(tmp_path, frames=30)
    path = tmp_path / "tracks.yaml"
    content = yaml.safe_load(path.read_text())
    change(content["videos"])
    path.write_text(yaml.safe_dump(content))
    with raises_user_error("invalid-record", contains=(str(path), named)):
        read(tmp_path)


def test_missing_and_damaged_files_are_refused(tmp_path: Path) -> None:
    with raises_user_error("missing-folder", contains="nowhere"):
        tracks.list_scenes(tmp_path / "nowhere")
    text = write_tracked_video(tmp_path, frames=30)
    text.write_text("\n")
    with raises_user_error("invalid-record", contains=(str(text), "no box")):
        read(tmp_path)
    text.unlink()
    with raises_user_error("missing-file", contains=str(text)):
        read(tmp_path)
    write_video(tmp_path / "street.mp4", 20)
    with raises_user_error("invalid-record", contains=("street.mp4", "20 frames")):
        read(tmp_path)
    (tmp_path / "street.mp4").write_bytes(b"no video")
    with raises_user_error("damaged-file", contains="street.mp4"):
        read(tmp_path)
    (tmp_path / "tracks.yaml").write_text("videos: {street: [")
    with raises_user_error("damaged-file", contains=("tracks.yaml", "line 1")):
        read(tmp_path)


def few(cells: tuple[str, ...]) -> dict[str, Quota]:
    return {cell: Quota(8, 2) for cell in cells}


def config(folder: Path, **changes: object) -> BenchmarkConfig:
    cells = CELLS_WITHOUT_CONTACTS
    settings = {
        "name": "videos",
        "simulator": "tracks",
        "folder": str(folder),
        "selection": SelectionConfig(
            time=few(cells["time"]), window=few(cells["window"]), min_displacement=8.0
        ),
        "retrieval": RetrievalTrackConfig(
            builders=few(("1", "2")), database=20, source=40, hard_negatives=1
        ),
    }
    return BenchmarkConfig(**settings | changes)


@pytest.fixture(scope="module")
def videos(tmp_path_factory) -> Path:
    """Five videos of 150 frames, three of them at 10 frames per second and two at 30; in one, an
    object is out of view for a time."""
    folder = tmp_path_factory.mktemp("videos")
    for k, fps in enumerate((10, 30, 10, 30, 10)):
        gone = [f"{f},2," for f in range(40, 60)]
        lines = [line for line in box_lines(152, 11 * k) if k != 2 or not line.startswith((*gone,))]
        write_tracked_video(folder, f"road{k}", 152, fps, *lines)
    return folder


@pytest.fixture(scope="module")
def store(videos: Path, tmp_path_factory) -> Store:
    return ensure_benchmark(config(videos), tmp_path_factory.mktemp("store"), workers=2)


@pytest.mark.slow
def test_all_clips_of_a_video_are_in_one_split(store: Store) -> None:
    split_of = {}
    for split in ("train", "test"):
        for name in store.scene_ids(split):
            assert split_of.setdefault(name.partition("-")[0], split) == split
    assert sorted(split_of.values()) == ["test", *["train"] * 4]
    assert len(store.scene_ids("train")) == 8


@pytest.mark.slow
def test_files_that_changed_since_an_interrupted_build_are_read_again(
    videos: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(videos, tmp_path / "videos")
    for changed in ("road1.txt", "tracks.yaml"):
        make_scenes(config(folder), tmp_path / "resumed", Workers(1), True)
        path = folder / changed
        path.write_text(path.read_text().replace(",20,8,6,", ",30,8,6,").replace("red", "blue"))
        for name in ("resumed", changed):
            make_scenes(config(folder), tmp_path / name, Workers(1), True)
        resumed, fresh = (
            {path.name: path.read_bytes() for path in (tmp_path / name / "scenes").iterdir()}
            for name in ("resumed", changed)
        )
        assert resumed == fresh


@pytest.mark.slow
def test_items_and_queries_count_the_seconds_of_their_video(store: Store) -> None:
    rates = {name: store.scene(name).fps for name in store.scene_ids("train")}
    rates |= {name: store.scene(name).fps for name in store.scene_ids("test")}
    items = [i for i in store.selection() if i.family == "time"]
    assert {(rates[i.scene_id], i.subtype) for i in items} == {
        (fps, subtype) for fps in (10, 30) for subtype in TIME_CELLS
    }
    for item in items:
        second, ahead = int(rates[item.scene_id]), TIME_CELLS[item.subtype]
        assert (item.prefix_start, item.prefix_stop) == (0, second - 1)
        assert item.target_frame == second + int(second * ahead)
        assert item.question == TIME_QUESTION.format(spell_seconds(ahead))
        assert item.suite == "tracks"
        assert all(c.frame > item.prefix_stop for c in item.candidates)
    queries = store.retrieval()
    assert {(q.builder, q.split) for q in queries} == {
        (builder, split) for builder in (1, 2) for split in ("train", "test")
    }
    assert {rates[q.scene_id] for q in queries} == {10, 30}
    for query in queries:
        ahead = next(n for n in (1, 2, 3) if f"{n} second" in query.question)
        assert query.target.frame - query.prefix_stop == ahead * rates[query.scene_id]
        assert query.prefix_stop >= 2 * rates[query.scene_id]
        if query.builder == 1:
            assert query.target.frame == store.scene(query.scene_id).frames - 1
    assert len(store.database()) == 20


@pytest.mark.slow
def test_window_items_are_about_views_instead_of_contacts(store: Store) -> None:
    items = [i for i in store.selection() if i.family == "window"]
    assert {i.group for i in items} == {"G1", "G3", "G4"}
    assert {i.window_family for i in items} == {"A", "C"}
    for item in items:
        assert item.prefix_stop - item.prefix_start == 15
        assert item.target_frame - item.prefix_stop == item.horizon
        changes = np.diff(store.scene(item.scene_id).in_view, axis=0)
        seen = changes[item.prefix_start : item.target_frame].any()
        assert seen == (item.group != "G1")
    # The baseline of constant velocity needs no camera in the image plane.
    near = [i for i in store.selection() if i.horizon == 8]
    errors = [constant_velocity_error(i, i.candidates[i.answer], store) for i in near]
    assert np.median(errors) < 1


def test_builder_1_keeps_the_times_of_clevrers_scenes(tmp_path: Path) -> None:
    write_tracked_video(tmp_path)
    scene = read(tmp_path)
    found = [(start, stop, target) for _, start, stop, target in BUILDERS[1](scene)]
    assert found == [(0, 50, 127), (0, 75, 127), (0, 100, 127)]
    # A clip of 4.27 s: the 8 frames above 4 s are observed.
    found = [(stop, target) for _, _, stop, target in BUILDERS[1](replace(scene, fps=29.97))]
    assert found == [(67, 127), (97, 127)]


def test_nothing_is_said_of_contacts(tmp_path: Path) -> None:
    """Also where objects approach each other, overlap, and stay close."""
    lines = []
    for f in range(60):
        lines += [f"{f + 1},1,{f:.1f},20,10,10,1,1,1", f"{f + 1},2,40,20,10,10,1,3,1"]
    write_tracked_video(tmp_path, "street", 60, 25, *lines)
    scene = read(tmp_path)
    facts = extract_facts(scene, 0, 25, 39)
    assert not facts.records_contacts
    assert facts.courses == facts.contacts == facts.close == ()
    ball, van = facts.objects
    # 25 px/s in an image of 64 px: 0.39 heights per second.
    assert (ball.speed, ball.heading, ball.region) == ("steadily", "east", "near the left")
    assert (van.speed, van.extent) == ("stationary", "stays")
    touching = replace(scene, records_contacts=True)
    assert extract_facts(touching, 0, 25, 39).courses
    assert close_pairs(touching, 39)
    kinds = {r.kind for r in find_relations(Places.from_frame(scene, 20))}
    assert "side" in kinds
    assert "gap" not in kinds


@pytest.mark.slow
def test_the_narrator_writes_what_is_known(store: Store) -> None:
    narration = narrate_store(store, TeacherConfig(name="template"))
    assert narration.figures["accepted"] == len(store.selection("train"))
    for rationale in narration.rationales:
        assert "contact" not in rationale.text
        assert "course" not in rationale.text


def test_what_needs_contacts_is_refused(tmp_path: Path) -> None:
    assert list(config(tmp_path).find_problems("benchmark.")) == []
    selection = SelectionConfig(
        event={"contact_match": Quota(1, 0)}, window={"G2_A": Quota(6, 6)}, matched=Quota(0, 1)
    )
    builders = {"1": Quota(1, 1), "3": Quota(1, 1)}
    retrieval = RetrievalTrackConfig(builders=builders, counterfactual=Quota(1, 1))
    problems = [*config(tmp_path, selection=selection, retrieval=retrieval).find_problems("b.")]
    for name in (
        "event.contact_match", "window.G2_A", "selection.matched", "builders.3", "counterfactual"
    ):  # fmt: skip
        assert any(name in problem for problem in problems)
    assert not any("builders.1" in problem for problem in problems)
