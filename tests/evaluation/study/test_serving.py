"""A complete study over HTTP: what the server shows, stores and refuses."""

from __future__ import annotations

import asyncio
import io
import json
import re
import stat
import time
from collections import Counter
from threading import Thread
from urllib.parse import urlencode

import numpy as np
import pytest
from PIL import Image

from dynapix.conf.entry import Run
from dynapix.conf.schema import ExportStudyCommand
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import LETTERS
from dynapix.evaluation.study import export, storage
from dynapix.evaluation.study.routes import HEADERS
from tests.evaluation.study.conftest import ITEMS, SMALL
from tests.evaluation.study.running import Annotator, Visitor, key_of, rows

pytestmark = pytest.mark.slow


def test_a_study_survives_kills_with_three_concurrent_annotators(serve, prepared, tmp_path) -> None:
    server = serve(prepared)
    annotators = [
        Annotator(
            Visitor(server.port).sign_in(server.links()[name]),
            lambda k, shift=shift: LETTERS[(k + shift) % 4],
        )
        for shift, name in enumerate(["A1", "A2", "A3"])
    ]
    threads = [Thread(target=a.take_part, daemon=True) for a in annotators]
    for thread in threads:
        thread.start()
    while sum(len(a.answers) for a in annotators) < ITEMS:
        assert all(thread.is_alive() for thread in threads)
        time.sleep(0.02)
    server.kill()
    server.start()
    for thread in threads:
        thread.join(timeout=300)
    assert [len(a.answers) for a in annotators] == [ITEMS] * 3
    stored = rows(server, "SELECT token, letter FROM turn")
    assert dict(map(tuple, stored)) == {k: v for a in annotators for k, v in a.answers.items()}

    cfg = ExportStudyCommand(run=server.folder.name, checkpoints=str(server.folder.parents[1]))
    export.main.__wrapped__(cfg, Run("x", tmp_path))
    text = (tmp_path / export.VOTES_FILE).read_text()
    votes = [json.loads(line) for line in text.splitlines()]
    assert Counter(v["annotator"] for v in votes) == {"A1": ITEMS, "A2": ITEMS, "A3": ITEMS}
    assert len({(v["annotator"], v["item_id"]) for v in votes}) == 3 * ITEMS
    assert all(v["right"] == (v["choice"] == v["answer"]) for v in votes)
    assert not any(link.rpartition("/")[2] in text for link in server.links().values())
    found = json.loads((tmp_path / "report.json").read_text())
    assert (found["depth"], found["kappa_items"]) == ({"3": ITEMS}, ITEMS)
    # Each of the three annotators saw the correct candidate of an item at another letter.
    places = Counter((v["item_id"], _place_of_answer(server, v)) for v in votes)
    assert set(places.values()) == {1}


def _place_of_answer(server, vote: dict) -> int:
    query = "SELECT shown FROM plan WHERE annotator = ? AND item_id = ?"
    [row] = rows(server, query, vote["annotator"], vote["item_id"])
    assert int(row["shown"][LETTERS.index(vote["letter"])]) == vote["choice"]
    return row["shown"].index(str(vote["answer"]))


def test_no_response_reveals_the_correct_answer(serve, prepared_small, micro_store) -> None:
    """The page of an item depends only on its question, its media and random tokens."""
    server = serve(prepared_small)
    items = {i.item_id: i for i in micro_store.selection()}
    frames = FrameReader(micro_store)
    visitor = Visitor(server.port).sign_in(server.links()["A3"])
    places, names, page = [], [], visitor.to_question()
    query = "SELECT * FROM turn JOIN plan USING (annotator, item_id) WHERE token = ?"
    for k in range(SMALL):
        [turn] = rows(server, query, page.hidden("key"))
        item, paths = items[turn["item_id"]], page.media()
        names += paths
        places.append(turn["shown"].index(str(item.answer)))
        replies = [visitor.request("GET", path) for path in paths]
        assert {r.status for r in replies} == {200}
        for text in (page.text, *(str(r.headers) for r in replies), *paths):
            assert not any(
                word in text
                for word in (item.item_id, item.scene_id, item.family, item.subtype, "target")
            )
        markup = page.text.split("<main")[1].replace(item.question, "")
        assert not re.search(r"same_|cross_|oracle|correct|right", markup)
        heads = [{k: v for k, v in r.headers.items() if k != "date"} for r in replies[1:]]
        assert all(head == heads[0] for head in heads)
        assert set(heads[0]) == {"content-length", "content-type"} | {h.lower() for h in HEADERS}
        visitor.load(page)
        visitor.answer(page, LETTERS[k])
        # A letter chooses the candidate that the page shows at it.
        [turn] = rows(server, query, page.hidden("key"))
        chosen = item.candidates[turn["choice"]]
        pixels = frames.array(chosen.scene_id, chosen.frame)
        assert np.array_equal(np.asarray(Image.open(io.BytesIO(replies[1 + k].body))), pixels)
        assert turn["opened"] <= turn["loaded"] <= turn["answered"]
        # Answered items are not served again.
        assert {visitor.request("GET", path).status for path in paths} == {404}
        page = visitor.home()
    assert "Thank you" in page.text
    assert len(set(names)) == len(names)
    assert sorted(places) == [0, 1, 2, 3]


def test_only_one_of_many_concurrent_answers_counts(small, visitor) -> None:
    page = visitor.to_question()
    visitor.load(page)
    votes = len(rows(small, "SELECT 1 FROM turn WHERE answered IS NOT NULL"))

    async def request(k: int) -> int:
        body = urlencode({**key_of(page), "choice": LETTERS[k % 4]})
        head = "GET /" if k % 2 else "POST /answer"
        sent = "" if k % 2 else body
        reader, writer = await asyncio.open_connection("127.0.0.1", small.port)
        writer.write(
            f"{head} HTTP/1.1\r\nHost: x\r\nConnection: close\r\nCookie: {visitor.cookie}\r\n"
            f"Content-Length: {len(sent)}\r\n\r\n{sent}".encode()
        )
        status = await reader.readline()
        await reader.read()
        writer.close()
        return int(status.split()[1])

    async def all_at_once() -> Counter:
        return Counter(await asyncio.gather(*(request(k) for k in range(200))))

    assert asyncio.run(all_at_once()) == {200: 100, 303: 100}
    assert len(rows(small, "SELECT 1 FROM turn WHERE answered IS NOT NULL")) == votes + 1
    open_items = "SELECT count(*) FROM turn WHERE answered IS NULL GROUP BY annotator"
    assert {count for (count,) in rows(small, open_items)} == {1}


def test_withdrawal_deletes_an_annotator_and_no_one_else(serve, prepared_small) -> None:
    server = serve(prepared_small)
    visitors = [Visitor(server.port).sign_in(server.links()[name]) for name in ("A1", "A2")]
    for visitor in visitors:
        page = visitor.to_question()
        visitor.load(page)
        visitor.answer(page, "B")
    mine = rows(server, "SELECT * FROM turn WHERE annotator = 'A1'")
    theirs = rows(server, "SELECT token FROM turn WHERE annotator = 'A2'")
    assert mine
    # The page asks first.
    assert visitors[0].request("GET", "/withdraw").action == "/withdraw"
    assert rows(server, "SELECT * FROM turn WHERE annotator = 'A1'") == mine
    assert "deleted" in visitors[0].request("POST", "/withdraw", {}).text
    for table, column in (("turn", "annotator"), ("plan", "annotator"), ("annotator", "name")):
        assert rows(server, f"SELECT * FROM {table} WHERE {column} = 'A1'") == []
    assert rows(server, "SELECT token FROM turn WHERE annotator = 'A2'") == theirs
    assert [visitor.home().status for visitor in visitors] == [401, 200]


def test_links_cookies_and_answers_are_private(small, visitor) -> None:
    for name in (storage.LINKS_FILE, storage.DATABASE):
        assert stat.S_IMODE((small.folder / name).stat().st_mode) == 0o600
    log = (small.folder / "run.log").read_text()
    assert not any(link.rpartition("/")[2] in log for link in small.links().values())
    reply = visitor.request("GET", small.links()["A1"])
    cookie = set(reply.headers["set-cookie"].lower().split("; "))
    assert {"httponly", "samesite=lax", "path=/"} <= cookie
    for path in ("/", "/nothing", "/static/study.css", "/static/nothing", "/link/x", "/media/x"):
        headers = visitor.request("GET", path).headers
        assert {name: headers[name] for name in HEADERS} == HEADERS
        assert "server" not in headers
    assert "unsafe" not in HEADERS["Content-Security-Policy"]
    page = visitor.to_question()
    for cookie in ("", "study=", "study=x", "study=' OR 1=1 --", "study=" + "x" * 4000):
        stranger = Visitor(small.port)
        stranger.cookie = cookie
        assert stranger.home().status == stranger.load(page).status == 401
        assert {stranger.request("GET", path).status for path in page.media()} == {401}


def test_repeated_early_and_forged_answers_change_nothing(small, visitor) -> None:
    page = visitor.to_question()
    turn = "SELECT * FROM turn WHERE token = ?"
    visitor.answer(page, "A")
    [early] = rows(small, turn, page.hidden("key"))
    assert early["answered"] is None, "answered before the page was loaded"
    visitor.load(page)
    visitor.answer(page, "B")
    [kept] = map(tuple, rows(small, turn, page.hidden("key")))
    for letter in LETTERS:
        assert visitor.answer(page, letter).status == 303
    assert visitor.load(page).status == 409
    assert [kept] == [*map(tuple, rows(small, turn, page.hidden("key")))]

    # An annotator cannot answer an item that is open for another annotator.
    other = Visitor(small.port).sign_in(small.links()["A2"])
    theirs = other.to_question()
    other.load(theirs)
    assert visitor.load(theirs).status == 409
    visitor.answer(theirs, "A")
    [forged] = rows(small, turn, theirs.hidden("key"))
    assert (forged["answered"], forged["loads"]) == (None, 1)
    assert {visitor.request("GET", path).status for path in theirs.media()} == {404}


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"choice": "E"}, 400),
        ({"choice": "<script>alert(1)</script>"}, 400),
        ({"choice": ""}, 400),
        ({"key": "' OR 1=1 --"}, 303),
        ({"key": "\x00\ud7ff"}, 303),
        ({"key": "x" * 5000}, 413),
        ({f"f{k}": "" for k in range(50)}, 400),
    ],
)
def test_hostile_fields_change_nothing(small, visitor, changes, status) -> None:
    page = visitor.to_question()
    visitor.load(page)
    before = [*map(tuple, rows(small, "SELECT count(*), count(answered) FROM turn"))]
    reply = visitor.request("POST", "/answer", {**key_of(page), "choice": "A", **changes})
    assert reply.status == status
    assert "<script>alert" not in reply.text
    assert before == [*map(tuple, rows(small, "SELECT count(*), count(answered) FROM turn"))]


@pytest.mark.parametrize(
    "path",
    ["/static/../app.py", "/static/%2e%2e/app.py", "/media/../study.sqlite", "/study.sqlite",
     "/links.txt", "//etc/passwd", "/link/%ff%fe", "/votes.jsonl"],
)  # fmt: skip
def test_hostile_paths_are_not_found(visitor, path) -> None:
    reply = visitor.request("GET", path)
    assert reply.status in (401, 404)
    assert "Traceback" not in reply.text
