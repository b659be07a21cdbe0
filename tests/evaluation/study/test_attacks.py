"""What the server of a study refuses: forged answers, hostile requests, and used links."""

from __future__ import annotations

import stat

import pytest

from dynapix.data.records import LETTERS
from dynapix.evaluation.study import storage
from dynapix.evaluation.study.auth import HEADERS
from tests.evaluation.study.running import Visitor, key_of, rows

pytestmark = pytest.mark.slow


def test_a_link_signs_in_once_and_opening_it_does_not(small) -> None:
    link = small.links()["A1"]
    for _ in range(2):
        assert Visitor(small.port).request("GET", f"/link/{link}").status == 200
    first = Visitor(small.port).sign_in(link)
    assert first.home().status == 200
    assert Visitor(small.port).request("POST", "/link", {"link": link}).status == 410
    assert Visitor(small.port).request("GET", f"/link/{link}").status == 410
    assert small.links()["A1"] != link
    # A new link signs in another device and signs out the previous one.
    second = Visitor(small.port).sign_in(small.links()["A1"])
    assert (first.home().status, second.home().status) == (401, 200)
    assert second.home().text.count(small.links()["A1"]) == 0


def test_only_the_owner_can_read_links_and_answers(small) -> None:
    for name in ("links.txt", storage.DATABASE):
        assert stat.S_IMODE((small.folder / name).stat().st_mode) == 0o600
    assert not any(
        link in (small.folder / "run.log").read_text() for link in small.links().values()
    )


def test_the_cookie_is_hidden_from_scripts_and_other_sites(small) -> None:
    reply = Visitor(small.port).request("POST", "/link", {"link": small.links()["A1"]})
    assert {"httponly", "samesite=lax", "path=/"} <= set(
        reply.headers["set-cookie"].lower().split("; ")
    )


def test_every_response_has_the_security_headers(small, visitor) -> None:
    for path in ("/", "/nothing", "/static/study.css", "/static/nothing", "/link/x", "/media/x"):
        headers = visitor.request("GET", path).headers
        assert {name: headers[name] for name in HEADERS} == HEADERS
        assert "server" not in headers
    headers = visitor.request("POST", "/link", {"link": "x" * 5000}).headers
    assert {name: headers[name] for name in HEADERS} == HEADERS
    assert "unsafe" not in HEADERS["Content-Security-Policy"]


def test_repeated_early_and_forged_answers_change_nothing(small, visitor) -> None:
    page = visitor.to_question()
    assert visitor.answer(page, "A").status == 303
    [turn] = rows(small, "SELECT * FROM turn WHERE token = ?", page.hidden("key"))
    assert turn["answered"] is None, "answered before the page was loaded"
    visitor.load(page)
    visitor.answer(page, "B")
    [kept] = map(tuple, rows(small, "SELECT * FROM turn WHERE token = ?", page.hidden("key")))
    for letter in LETTERS:
        assert visitor.answer(page, letter).status == 303
    assert visitor.load(page).status == 409
    [after] = map(tuple, rows(small, "SELECT * FROM turn WHERE token = ?", page.hidden("key")))
    assert after == kept

    # An annotator cannot answer an item that is open for another annotator.
    other = Visitor(small.port).sign_in(small.links()["A2"])
    theirs = other.to_question()
    other.load(theirs)
    forged = key_of(theirs)
    assert visitor.request("POST", "/loaded", forged).status == 409
    visitor.request("POST", "/answer", forged | {"choice": "A", "seconds": "1"})
    [turn] = rows(small, "SELECT * FROM turn WHERE token = ?", theirs.hidden("key"))
    assert (turn["answered"], turn["loads"]) == (None, 1)
    assert {visitor.request("GET", path).status for path in theirs.media()} == {404}


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"choice": "E"}, 400),
        ({"choice": "<script>alert(1)</script>"}, 400),
        ({"choice": "AB"}, 400),
        ({"choice": ""}, 400),
        ({"seconds": "nan"}, 400),
        ({"seconds": "-1"}, 400),
        ({"seconds": "1e300"}, 400),
        ({"seconds": "'; DROP TABLE turn; --"}, 400),
        ({"key": "' OR 1=1 --"}, 303),
        ({"key": "\x00\ud7ff"}, 303),
        ({"key": "x" * 5000}, 413),
        ({f"f{k}": "" for k in range(50)}, 400),
    ],
)
def test_hostile_fields_change_nothing(small, visitor, changes, status) -> None:
    page = visitor.to_question()
    visitor.load(page)
    before = rows(small, "SELECT count(*), count(answered), max(rests) FROM turn, annotator")
    reply = visitor.request(
        "POST", "/answer", {**key_of(page), "choice": "A", "seconds": "1", **changes}
    )
    assert reply.status == status
    assert "<script>alert" not in reply.text
    after = rows(small, "SELECT count(*), count(answered), max(rests) FROM turn, annotator")
    assert list(map(tuple, before)) == list(map(tuple, after))


def test_forms_on_other_sites_are_refused(visitor) -> None:
    page = visitor.to_question()
    for headers in (
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://["},
        {"Origin": ""},
        {"Origin": f"https://127.0.0.1:{visitor.port + 1}"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ):
        for path in ("/continue", "/loaded", "/answer", "/link"):
            assert visitor.request("POST", path, key_of(page), **headers).status == 403
    for headers in (
        {"Origin": f"http://127.0.0.1:{visitor.port}"},
        {"Origin": "https://proxied.example", "Sec-Fetch-Site": "same-origin"},
    ):
        assert visitor.request("POST", "/loaded", key_of(page), **headers).status == 204


@pytest.mark.parametrize(
    "path",
    ["/static/../app.py", "/static/%2e%2e/app.py", "/static/..%2fapp.py", "/media/../study.sqlite",
     "/media/%00", "/study.sqlite", "/links.txt", "//etc/passwd", "/media/" + "a" * 4000,
     "/link/%ff%fe", "/export", "/votes.jsonl"],
)  # fmt: skip
def test_hostile_paths_are_not_found(small, visitor, path) -> None:
    reply = visitor.request("GET", path)
    assert reply.status in (404, 410)
    assert "Traceback" not in reply.text
    assert visitor.request("DELETE", path).status in (404, 405)


def test_without_a_session_every_request_is_refused(small, visitor) -> None:
    page = visitor.to_question()
    for cookie in ("", "study=", "study=x", "study=' OR 1=1 --", "study=" + "x" * 4000):
        stranger = Visitor(small.port)
        stranger.cookie = cookie
        assert stranger.home().status == 401
        assert {stranger.request("GET", path).status for path in page.media()} == {401}
        assert stranger.load(page).status == 401
