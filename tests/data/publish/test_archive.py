"""An archive of a benchmark gives the same benchmark on another machine."""

from __future__ import annotations

import json
import shutil
import threading
import zipfile
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

import dynapix
from dynapix.data.publish.archive import write_archive
from dynapix.data.store import Store, with_checksum
from tests.user_errors import raises_user_error


@pytest.fixture(scope="module")
def archive(micro_store: Store, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("archives") / "micro.zip"
    write_archive(micro_store, path)
    return path


class Handler(SimpleHTTPRequestHandler):
    """Serves files, but ends a transfer early if its address asks for that."""

    def copyfile(self, source, outputfile) -> None:
        cut = source.read()[:-1000] if "cut" in self.path else source.read()
        outputfile.write(cut)


@pytest.fixture
def address(archive: Path) -> Iterator[str]:
    """The address of the folder of the archive on a web server."""
    handler = partial(Handler, directory=archive.parent)
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()


@pytest.mark.parametrize("by_address", [False, True])
def test_an_archive_opens_as_the_same_benchmark(
    micro_store, archive, address, tmp_path, by_address
) -> None:
    source = f"{address}/micro.zip" if by_address else archive
    bench = dynapix.load(source, store=tmp_path)
    assert bench.store.identity == micro_store.identity
    assert bench.name == micro_store.name
    own = dynapix.load(micro_store.folder)
    assert [i.record for i in bench.selection] == [i.record for i in own.selection]
    assert np.array_equal(bench.selection[0].prefix, own.selection[0].prefix)
    frames = {p.name for p in (micro_store.folder / "frames").glob("[!.]*")}
    assert {p.name for p in (bench.store.folder / "frames").glob("[!.]*")} == frames
    # It is unpacked once.
    before = (bench.store.folder / "manifest.json").stat().st_mtime_ns
    dynapix.load(source, store=tmp_path)
    assert (bench.store.folder / "manifest.json").stat().st_mtime_ns == before
    assert {p.name for p in tmp_path.iterdir() if not p.name.endswith(".lock")} == {bench.name}


def test_the_same_benchmark_gives_the_same_bytes(micro_store, archive, tmp_path) -> None:
    write_archive(micro_store, tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == archive.read_bytes()
    write_archive(micro_store, archive)
    changed = Store(micro_store.folder, with_checksum(micro_store.manifest | {"seed": 7}))
    with raises_user_error("other-settings", contains=archive.name):
        write_archive(changed, archive)
    narrated = shutil.copytree(micro_store.folder, tmp_path / "narrated")
    with open(narrated / "rationales.jsonl", "a") as file:
        file.write("{}\n")
    with raises_user_error("other-settings", contains="other rationales"):
        write_archive(Store(narrated, micro_store.manifest), archive)


def test_damaged_archives_are_refused_and_leave_nothing(archive, address, tmp_path) -> None:
    for name, content in (
        ("text.zip", b"hello"),
        ("cut.zip", archive.read_bytes()[:-50_000]),
        ("other.zip", None),
    ):
        path = tmp_path / name
        if content is None:
            with zipfile.ZipFile(path, "w") as file:
                file.writestr("notes.txt", "hello")
        else:
            path.write_bytes(content)
        with raises_user_error("not-an-archive", contains=name):
            dynapix.load(path, store=tmp_path / "store")
    changed = tmp_path / "changed.zip"
    with zipfile.ZipFile(archive) as source, zipfile.ZipFile(changed, "w") as target:
        for member in source.infolist():
            damaged = member.filename.endswith("selection.parquet")
            target.writestr(member, b"other" if damaged else source.read(member))
    with raises_user_error("damaged-file", contains="selection.parquet"):
        dynapix.load(changed, store=tmp_path / "store")
    with raises_user_error("no-download", contains="404"):
        dynapix.load(f"{address}/missing.zip", store=tmp_path / "store")
    with raises_user_error("no-download", contains="the transfer ended after"):
        dynapix.load(f"{address}/{archive.name}?cut", store=tmp_path / "store")
    assert all(p.suffix == ".lock" for p in (tmp_path / "store").iterdir())


def test_another_build_in_the_store_is_kept(micro_store, archive, tmp_path) -> None:
    bench = dynapix.load(archive, store=tmp_path)
    other = tmp_path / "other.zip"
    manifest = with_checksum(micro_store.manifest | {"seed": 7})
    (micro_copy := tmp_path / "copy").mkdir()

    shutil.copytree(micro_store.folder, micro_copy / bench.name)
    (micro_copy / bench.name / "manifest.json").write_text(json.dumps(manifest))
    write_archive(Store(micro_copy / bench.name, manifest), other)
    with raises_user_error("different-builds", contains=str(bench.store.folder)):
        dynapix.load(other, store=tmp_path)
