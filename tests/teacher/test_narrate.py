"""Runs of the command on a store in memory: resuming, damage, and a server that misbehaves."""

import json
import threading
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from conf.errors import UserError
from conf.schema import TeacherConfig
from data.records import Scene, SelectionItem
from teacher.journal import Journal, read_rationales
from teacher.narrate import ensure_rationales, narrate_store
from teacher.predicates import predicates_of
from teacher.template import narrate
from tests.teacher import synthetic

TEMPLATE = TeacherConfig(name="template")


@dataclass
class MadeStore:
    folder: Path
    scenes: dict[str, Scene]
    items: list[SelectionItem]

    def scene(self, scene_id: str) -> Scene:
        return self.scenes[scene_id]

    def selection(self, split: str | None = None) -> list[SelectionItem]:
        return [i for i in self.items if split in (None, i.split)]


@pytest.fixture
def store(tmp_path):
    rng = np.random.default_rng(4)
    scenes, items = {}, []
    for k in range(14):
        scenes[f"s{k}"] = synthetic.scene(
            rng.uniform(-2, -1, (1, 2)).tolist() + rng.uniform(1, 2, (1, 2)).tolist(),
            [(0.3, 0.1), (0, 0)],
            scene_id=f"s{k}",
        )
        items.append(
            synthetic.item(
                (60, 80, 100, 120),
                answer=k % 4,
                start=30 if k == 5 else 10,
                stop=33 if k == 5 else 30,
                item_id=f"item-{k}",
                scene_id=f"s{k}",
                split="test" if k == 13 else "train",
            )
        )
    return MadeStore(tmp_path, scenes, items)


def lines(store):
    return (store.folder / "rationales.jsonl").read_bytes()


def test_template_narrates_every_training_item_but_short_ones(store):
    report = narrate_store(store, TEMPLATE)
    assert [r.item_id for r in report.rationales] == [f"item-{k}" for k in range(13) if k != 5]
    assert (report.too_short, report.set_aside, report.rejected.total()) == (1, 0, 0)
    before = lines(store)
    assert ensure_rationales(store, TEMPLATE) == report.rationales
    assert lines(store) == before


@pytest.mark.parametrize("kept", [0, 10, 0.3, 0.5, -1])
def test_a_killed_run_ends_with_the_same_bytes(store, kept):
    narrate_store(store, TEMPLATE)
    whole = lines(store)
    cut = int(kept * len(whole)) if isinstance(kept, float) else kept
    (store.folder / "rationales.jsonl").write_bytes(whole[:cut])
    narrate_store(store, TEMPLATE)
    assert lines(store) == whole


def test_a_damaged_line_is_named(store):
    narrate_store(store, TEMPLATE)
    damaged = lines(store).splitlines(keepends=True)
    damaged[2] = b'{"item_id": "item-2"}\n'
    (store.folder / "rationales.jsonl").write_bytes(b"".join(damaged))
    with pytest.raises(UserError, match=r"rationales\.jsonl, line 3"):
        narrate_store(store, TEMPLATE)


def test_an_edited_line_is_named(store):
    narrate_store(store, TEMPLATE)
    edited = lines(store).replace(b"Scene parse: ", b"Scene parse: There are 3 cubes. ", 1)
    (store.folder / "rationales.jsonl").write_bytes(edited)
    with pytest.raises(UserError, match=r"rationales\.jsonl, line 1: .* changed after it was"):
        narrate_store(store, TEMPLATE)


def test_answers_under_other_settings_are_not_taken(store):
    first = narrate_store(store, TEMPLATE)
    strict = TeacherConfig(name="template", min_words=240, max_words=250, attempts=1)
    assert narrate_store(store, strict).rationales == []
    before = lines(store)
    assert narrate_store(store, TEMPLATE).rationales == first.rationales
    assert lines(store) == before


def test_only_one_writer(store):
    with Journal(store.folder / "rationales.jsonl"), pytest.raises(UserError, match="another run"):
        narrate_store(store, TEMPLATE)


def test_rejected_answers_are_kept_and_set_aside(store):
    cfg = TeacherConfig(name="template", min_words=240, max_words=250, attempts=2)
    report = narrate_store(store, cfg)
    kept = read_rationales(store.folder / "rationales.jsonl")
    assert report.rationales == []
    assert (report.set_aside, report.rejected) == (12, {"too short": 24})
    assert [r.attempt for r in kept[:4]] == [0, 1, 0, 1]


class Faulty(ThreadingHTTPServer):
    """Answers chats from the template; `faults` are statuses or words that come before."""

    def __init__(self, store, faults):
        super().__init__(("127.0.0.1", 0), Handler)
        self.store, self.faults, self.asked = store, list(faults), []
        self.lock = threading.Lock()
        self.texts = {}
        for item in store.selection("train"):
            predicates = predicates_of(item, store.scene(item.scene_id), store.scene)
            if predicates:
                from teacher.prompts import messages

                text = narrate(predicates, item, 0)
                self.texts[messages(predicates, item, TEMPLATE)[1]["content"]] = text
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}/v1"


class Handler(BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def say(self, status, body):
        content = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def do_GET(self):
        if self.path == "/health":
            self.say(200, {})
        else:
            self.say(200, {"object": "list", "data": [{"id": "other", "object": "model"}]})

    def do_POST(self):
        request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        with self.server.lock:
            self.server.asked.append(request)
            fault = self.server.faults.pop(0) if self.server.faults else None
        if isinstance(fault, bytes):
            self.send_response(200)
            self.send_header(
                "Content-Type", "application/json" if fault[:1] in b"{[" else "text/html"
            )
            self.end_headers()
            self.wfile.write(fault)
            return
        if isinstance(fault, int):
            self.say(fault, {"error": {"message": "fault", "type": "t", "code": fault}})
            return
        text = self.server.texts[request["messages"][1]["content"]]
        reason = "stop"
        if fault == "cut":
            text, reason = text[:200], "length"
        if fault == "number":
            text = text.replace("The ", "The two ", 1)
        choice = {
            "index": 0,
            "finish_reason": reason,
            "message": {"role": "assistant", "content": text},
        }
        self.say(
            200,
            {
                "id": "x",
                "object": "chat.completion",
                "created": 0,
                "model": "tiny",
                "choices": [choice],
            },
        )


@pytest.fixture
def serve(store, monkeypatch):
    monkeypatch.setattr("teacher.server.PAUSE", 0.01)
    servers = []

    def start(*faults):
        servers.append(Faulty(store, faults))
        return servers[-1]

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def config(server, **changes):
    settings = {"concurrency": 2, "patience": 5.0, **changes}
    return TeacherConfig(name="served", url=server.url, model="tiny", **settings)


def test_served_answers_are_judged_and_faults_cost_no_attempt(store, serve):
    server = serve(503, "cut", 500, "number")
    report = narrate_store(store, config(server))
    assert [r.item_id for r in report.rationales] == [f"item-{k}" for k in range(13) if k != 5]
    assert report.rejected == {"cut off": 1, "number": 1}
    assert report.too_short == 1
    assert len(server.asked) == 12 + 4
    asked = server.asked[0]
    assert asked["chat_template_kwargs"] == {"enable_thinking": False}
    assert (asked["temperature"], asked["top_p"], asked["top_k"]) == (0.7, 0.8, 20)
    attempts = [json.loads(line)["attempt"] for line in lines(store).splitlines()]
    assert sorted(attempts)[-3:] == [0, 1, 1] or sorted(attempts)[-2:] == [1, 2]


def test_a_killed_served_run_asks_only_for_the_rest(store, serve):
    server = serve()
    narrate_store(store, config(server))
    whole = lines(store).splitlines(keepends=True)
    (store.folder / "rationales.jsonl").write_bytes(b"".join(whole[:7]) + whole[7][:40])
    server.asked.clear()
    report = narrate_store(store, config(server))
    assert len(server.asked) == len(whole) - 7
    assert len(report.rationales) == 12


def test_an_unknown_model_is_named_with_those_there(store, serve):
    server = serve(404)
    with pytest.raises(UserError, match=r"teacher\.model=tiny; it has other"):
        narrate_store(store, config(server, concurrency=1))


def test_a_refused_request_is_told(store, serve):
    with pytest.raises(UserError, match="refused a request"):
        narrate_store(store, config(serve(400), concurrency=1))


@pytest.mark.parametrize(
    "reply",
    [b"<html>hello</html>", b"{}", b'{"choices": []}', b"{", b"[]",
     b'{"choices": [{"message": null}]}'],
)  # fmt: skip
def test_a_server_of_another_kind_is_told(store, serve, reply):
    with pytest.raises(UserError, match="does not answer as an OpenAI-compatible server"):
        narrate_store(store, config(serve(reply), concurrency=1))


def test_another_models_answers_are_not_taken(store, serve):
    server = serve()
    narrate_store(store, config(server))
    asked = len(server.asked)
    other = TeacherConfig(name="served", url=server.url, model="other", concurrency=2)
    narrate_store(store, other)
    assert len(server.asked) == 2 * asked


def test_patience_ends_with_the_url(store, serve):
    server = serve()
    url = server.url
    cfg = config(server, patience=0.2)
    server.shutdown()
    server.server_close()
    with pytest.raises(UserError, match=url):
        narrate_store(store, cfg)
