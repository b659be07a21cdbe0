"""A complete study over HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import re
import sqlite3
import time
from collections import Counter
from threading import Thread
from urllib.parse import urlencode

import numpy as np
import pytest
from PIL import Image

from dynapix.conf.entry import Run
from dynapix.conf.schema import ExportStudyCommand, StudyCommand
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import LETTERS
from dynapix.evaluation.study import auth, export, storage
from dynapix.evaluation.study.auth import HEADERS
from dynapix.evaluation.study.routes import build_app
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
    for killed_after in (40, 100):
        while sum(len(a.answers) for a in annotators) < killed_after:
            assert all(thread.is_alive() for thread in threads)
            time.sleep(0.02)
        server.kill()
        server.start()
    for thread in threads:
        thread.join(timeout=300)
    assert [len(a.answers) for a in annotators] == [ITEMS] * 3
    assert [a.rests for a in annotators] == [2] * 3
    stored = rows(
        server, "SELECT token, letter FROM turn JOIN item USING (item_id) WHERE NOT practice"
    )
    assert dict(map(tuple, stored)) == {k: v for a in annotators for k, v in a.answers.items()}

    run = Run("x", tmp_path)
    cfg = ExportStudyCommand(run=server.folder.name, checkpoints=str(server.folder.parents[1]))
    export.main.__wrapped__(cfg, run)
    text = (tmp_path / export.VOTES_FILE).read_text()
    votes = [json.loads(line) for line in text.splitlines()]
    assert Counter(v["annotator"] for v in votes) == {"A1": ITEMS, "A2": ITEMS, "A3": ITEMS}
    assert len({(v["annotator"], v["item_id"]) for v in votes}) == 3 * ITEMS
    assert all(v["right"] == (v["choice"] == v["answer"]) for v in votes)
    secrets = [r["link"] for r in rows(server, "SELECT link FROM annotator")]
    assert not any(secret in text for secret in secrets)
    found = json.loads((tmp_path / "report.json").read_text())
    assert found["depth"] == {"3": ITEMS}
    assert found["fleiss_kappa"]["items"] == ITEMS
    # Each of the three annotators saw the correct candidate of an item at another letter.
    places = Counter((v["item_id"], _place_of_answer(server, v)) for v in votes)
    assert set(places.values()) == {1}


def _place_of_answer(server, vote: dict) -> int:
    query = "SELECT shown FROM plan WHERE annotator = ? AND item_id = ?"
    [row] = rows(server, query, vote["annotator"], vote["item_id"])
    assert int(row["shown"][LETTERS.index(vote["letter"])]) == vote["choice"]
    return row["shown"].index(str(vote["answer"]))


def test_a_letter_chooses_the_candidate_that_the_page_shows_at_it(small, micro_store) -> None:
    visitor = Visitor(small.port).sign_in(small.links()["A2"])
    page = visitor.to_question()
    images = [visitor.request("GET", path).body for path in page.media()[1:]]
    visitor.load(page)
    visitor.answer(page, "C", seconds=3.25)
    [turn] = rows(small, "SELECT * FROM turn WHERE token = ?", page.hidden("key"))
    item = next(i for i in micro_store.selection("test") if i.item_id == turn["item_id"])
    chosen = item.candidates[turn["choice"]]
    pixels = FrameReader(micro_store).array(chosen.scene_id, chosen.frame)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(images[2]))), pixels)
    assert turn["client_seconds"] == 3.25
    assert turn["opened"] <= turn["loaded"] <= turn["answered"]


def test_no_response_reveals_the_correct_answer(small, micro_store) -> None:
    """The page of an item depends only on its question, its media and random tokens."""
    items = {i.item_id: i for i in micro_store.selection()}
    visitor = Visitor(small.port).sign_in(small.links()["A3"])
    answers, places, names = [], [], []
    for k in range(SMALL + 3):
        while (page := visitor.home()).action != "/answer":
            visitor.leave(page)
        [turn] = rows(
            small,
            "SELECT * FROM turn JOIN plan USING (annotator, item_id) WHERE token = ?",
            page.hidden("key"),
        )
        item = items[turn["item_id"]]
        paths = page.media()
        names += paths
        replies = [visitor.request("GET", path) for path in paths]
        assert {r.status for r in replies} == {200}
        for text in (page.text, *(str(r.headers) for r in replies), *paths):
            assert not any(
                word in text
                for word in (item.item_id, item.scene_id, item.family, item.subtype, "target")
            )
        markup = page.text.split("<main")[1]
        assert not re.search(r'same_|cross_|oracle|class="correct|· correct|right', markup)
        candidates = replies[1:]
        heads = [{k: v for k, v in r.headers.items() if k != "date"} for r in candidates]
        assert all(head == heads[0] for head in heads)
        assert set(heads[0]) == {"content-length", "content-type"} | {h.lower() for h in HEADERS}
        # Conditional and range requests get the whole content.
        again = visitor.request("GET", paths[1], **{"If-None-Match": "*", "Range": "bytes=0-9"})
        assert (again.status, again.body) == (200, candidates[0].body)
        places.append(turn["shown"].index(str(item.answer)))
        answers.append(item.answer)
        visitor.load(page)
        visitor.answer(page, LETTERS[k % 4])
        if k >= 3:
            # Answered items are not served again.
            assert {visitor.request("GET", path).status for path in paths} == {404}
    assert len(set(names)) == len(names)
    assert sorted(places[3:]) == [0, 1, 2, 3]


def test_an_annotator_can_sign_in_although_the_disk_is_full(small) -> None:
    def full() -> None:
        raise OSError("No space left on device")

    db = storage.open_study(small.folder / storage.DATABASE)
    response = post_link(build_app(db, StudyCommand(), full), small.links()["A1"])
    auth.write_links(db, small.folder / auth.LINKS_FILE, "http://here")
    assert response["status"] == 303
    assert any(name == b"set-cookie" for name, _ in response["headers"])
    # In a database without tables, every query fails.
    broken = build_app(sqlite3.connect(":memory:"), StudyCommand(), full)
    assert post_link(broken, "x" * 10)["status"] == 500


def post_link(app, link: str) -> dict:
    """Send the form of a link to an application, and return the start of the response."""
    messages = []

    async def receive() -> dict:
        return {"type": "http.request", "body": f"link={link}".encode(), "more_body": False}

    async def send(message: dict) -> None:
        messages.append(message)

    scope = {
        "type": "http", "method": "POST", "path": "/link", "raw_path": b"/link",
        "query_string": b"", "headers": [(b"host", b"here")], "http_version": "1.1",
    }  # fmt: skip
    # After an error, the application responds, and raises the error again so that it is logged.
    with contextlib.suppress(sqlite3.Error):
        asyncio.run(app(scope, receive, send))
    return messages[0]


def test_only_one_of_many_concurrent_answers_counts(small, visitor) -> None:
    page = visitor.to_question()
    visitor.load(page)
    votes = len(rows(small, "SELECT 1 FROM turn WHERE answered IS NOT NULL"))

    async def request(k: int) -> int:
        body = urlencode({**key_of(page), "choice": LETTERS[k % 4], "seconds": 1})
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
        return Counter(await asyncio.gather(*(request(k) for k in range(1000))))

    assert asyncio.run(all_at_once()) == {200: 500, 303: 500}
    assert len(rows(small, "SELECT 1 FROM turn WHERE answered IS NOT NULL")) == votes + 1
    assert visitor.home().status == 200


def test_loading_a_page_opens_no_item(serve, prepared_small) -> None:
    server = serve(prepared_small)
    visitor = Visitor(server.port).sign_in(server.links()["A1"])
    for _ in range(3):
        assert visitor.home().action == "/continue"
    assert rows(server, "SELECT * FROM turn") == []
    visitor.to_question()
    opened = len(rows(server, "SELECT * FROM turn"))
    # An item that is not open, as after a restart, opens by a button only.
    db = storage.open_study(server.folder / storage.DATABASE)
    with storage.transaction(db):
        db.execute("DELETE FROM turn WHERE answered IS NULL")
    db.close()
    page = visitor.home()
    assert "The next question opens" in page.text
    assert len(rows(server, "SELECT * FROM turn")) == opened - 1
    visitor.leave(page)
    assert visitor.home().action == "/answer"
    assert len(rows(server, "SELECT * FROM turn")) == opened


def test_a_session_expires(serve, prepared_small) -> None:
    server = serve(prepared_small, "session_days=2")
    visitor = Visitor(server.port).sign_in(server.links()["A1"])
    assert visitor.home().status == 200
    for hours, status in ((47, 200), (49, 401)):
        db = storage.open_study(server.folder / storage.DATABASE)
        with storage.transaction(db):
            db.execute("UPDATE annotator SET signed_in = ?", (time.time() - 3600 * hours,))
        db.close()
        assert visitor.home().status == status
    assert visitor.sign_in(server.links()["A1"]).home().status == 200


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
    # The page asks first, and a form on another site is refused.
    assert visitors[0].request("GET", "/withdraw").action == "/withdraw"
    foreign = {"Sec-Fetch-Site": "cross-site"}
    assert visitors[0].request("POST", "/withdraw", {}, **foreign).status == 403
    assert rows(server, "SELECT * FROM turn WHERE annotator = 'A1'") == mine
    assert "deleted" in visitors[0].request("POST", "/withdraw", {}).text
    for table, column in (("turn", "annotator"), ("plan", "annotator"), ("annotator", "name")):
        assert rows(server, f"SELECT * FROM {table} WHERE {column} = 'A1'") == []
    assert rows(server, "SELECT token FROM turn WHERE annotator = 'A2'") == theirs
    assert visitors[0].home().status == 401
    assert visitors[1].home().status == 200
    assert "A1" not in server.links()
