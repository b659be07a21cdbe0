"""Exports are uploaded by the hub's client to a server that speaks the hub's HTTP."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from dynapix.data.publish.huggingface import ensure_export

pytestmark = pytest.mark.slow
REPOSITORY = "someone/moving-objects"
UPLOAD = """
import sys
from pathlib import Path
from dynapix.conf.failures import report_failures
from dynapix.data.publish.hub import push_folder
with report_failures():
    print(push_folder(Path(sys.argv[1]), sys.argv[2]))
"""


class Hub(ThreadingHTTPServer):
    """Stores the files of one dataset repository."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.objects: dict[str, bytes] = {}
        self.files: dict[str, bytes] = {}
        self.received: list[str] = []
        self.is_full = False
        self.may_write = True

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    server: Hub

    def log_message(self, *_: object) -> None:
        pass

    def reply(self, body: object, status: int = 200) -> None:
        content = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def body(self) -> bytes:
        if "chunked" not in self.headers.get("Transfer-Encoding", ""):
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        chunks = []
        while size := int(self.rfile.readline(), 16):
            chunks.append(self.rfile.read(size))
            self.rfile.readline()
        return b"".join(chunks)

    def do_GET(self) -> None:
        if self.path == "/api/whoami-v2":
            self.reply({"name": "someone", "type": "user", "orgs": []})
        else:
            self.reply({"id": REPOSITORY, "sha": "0" * 40, "siblings": []})

    def do_POST(self) -> None:
        content = self.body()
        if not self.server.may_write:
            self.reply({"error": "You don't have the rights to write to this repository"}, 403)
        elif self.path.startswith("/api/validate-yaml"):
            self.reply({"errors": [], "warnings": []})
        elif self.path == "/api/repos/create":
            self.reply({"url": f"{self.server.address}/datasets/{REPOSITORY}"})
        elif self.path.endswith("/preupload/main"):
            files = json.loads(content)["files"]
            modes = ["lfs" if f["path"].endswith(".parquet") else "regular" for f in files]
            self.reply({"files": [
                {"path": f["path"], "uploadMode": mode, "shouldIgnore": False}
                for f, mode in zip(files, modes, strict=True)
            ]})  # fmt: skip
        elif self.path.endswith("/info/lfs/objects/batch"):
            objects = json.loads(content)["objects"]
            for each in objects:
                if each["oid"] not in self.server.objects:
                    href = f"{self.server.address}/objects/{each['oid']}"
                    each["actions"] = {"upload": {"href": href}}
            self.reply({"transfer": "basic", "objects": objects})
        elif self.path.endswith("/commit/main"):
            for line in map(json.loads, content.splitlines()):
                value = line["value"]
                if line["key"] == "file":
                    self.server.files[value["path"]] = base64.b64decode(value["content"])
                elif line["key"] == "lfsFile":
                    self.server.files[value["path"]] = self.server.objects[value["oid"]]
            url = f"{self.server.address}/datasets/{REPOSITORY}/commit/{'1' * 40}"
            self.reply({"commitUrl": url, "commitOid": "1" * 40})
        else:
            self.reply({"error": f"unknown address {self.path}"}, 404)

    def do_PUT(self) -> None:
        content, name = self.body(), self.path.rpartition("/")[2]
        if self.server.is_full and self.server.objects:
            self.reply({"error": "out of space"}, 400)
            return
        assert hashlib.sha256(content).hexdigest() == name
        self.server.objects[name] = content
        self.server.received.append(name)
        self.reply({})


@pytest.fixture
def hub() -> Iterator[Hub]:
    server = Hub()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()


@pytest.fixture(scope="module")
def folder(micro_store, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("hub") / "micro"
    ensure_export({"micro": micro_store}, out, images=False)
    return out


def push(folder: Path, hub: Hub, token: str = "hf_something") -> subprocess.CompletedProcess:
    # Without Xet, the client uploads large files by the protocol of Git LFS.
    changes = {"HF_ENDPOINT": hub.address, "HF_TOKEN": token, "HF_HUB_DISABLE_XET": "1"}
    command = [sys.executable, "-c", UPLOAD, str(folder), REPOSITORY]
    environment = {**os.environ, **changes, "HF_HOME": str(folder.parent / "home")}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)


def read_files(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def test_an_interrupted_upload_resumes(folder, hub) -> None:
    hub.is_full = True
    stopped = push(folder, hub)
    assert stopped.returncode == 1
    # The client draws progress bars before.
    assert last_line(stopped).startswith("error: ")
    assert "Traceback" not in stopped.stderr
    assert not hub.files
    hub.is_full, first = False, len(hub.received)
    assert first > 0
    done = push(folder, hub)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith("1" * 40)
    assert hub.files == read_files(folder)
    # Each large file was received once.
    assert len(hub.received) == len(set(hub.received)) == len(hub.objects) > first


def last_line(process: subprocess.CompletedProcess) -> str:
    return process.stderr.splitlines()[-1]


@pytest.mark.parametrize(("token", "reason"), [("hf_other", "rights to write"), ("", "oken")])
def test_a_token_without_rights_or_none_gives_one_sentence(folder, hub, token, reason) -> None:
    hub.may_write = False
    refused = push(folder, hub, token)
    assert refused.returncode == 1
    assert all(part in last_line(refused) for part in ("error: ", "HF_TOKEN", REPOSITORY, reason))
    assert "Traceback" not in refused.stderr
    assert not hub.files
