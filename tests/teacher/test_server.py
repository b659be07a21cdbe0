"""The pool of servers, with local servers that are down, busy, slow or rate-limited."""

import asyncio
import json
import re
import threading
from types import SimpleNamespace

import pytest

from dynapix.teacher.journal import read_rationales
from dynapix.teacher.narrate import narrate_store
from dynapix.teacher.server_narrator import request_fields
from dynapix.teacher.servers.pool import ServerPool
from dynapix.teacher.servers.responses import parse_completion
from tests.teacher.faulty_server import FaultyServer, completion, teacher_at
from tests.user_errors import raises_user_error
from tests.waiting import wait_until

MESSAGES = [{"role": "user", "content": "Are you there?"}]


def complete(cfg, times=1, n=1, **fields):
    """Send a prompt `times` times at once, and return the responses of each request."""

    async def main():
        async with ServerPool(cfg, request_fields(cfg)) as pool:
            requests = (pool.complete(MESSAGES, n, **fields) for _ in range(times))
            return await asyncio.gather(*requests)

    return asyncio.run(main())


def test_concurrency_limits_requests_in_flight(store, start_server):
    server = start_server()
    server.delay = 0.05
    narrate_store(store, teacher_at(server, concurrency=3))
    assert server.max_in_flight == 3


def test_fields_of_a_request_override_those_of_the_pool(start_server):
    server = start_server()
    complete(teacher_at(server, temperature=0.3), seed=7, temperature=0.6)
    request = server.requests[0]
    assert (request["seed"], request["temperature"], request["top_p"]) == (7, 0.6, 0.8)


def test_fewer_responses_than_requested_are_accepted(start_server):
    server = start_server(json.dumps(completion("Hello.", "stop", 2)).encode())
    assert len(complete(teacher_at(server), n=4)[0]) == 2
    assert server.requests[0]["n"] == 4


def test_rate_limit_delays_the_next_request(start_server):
    server = start_server({"Retry-After": "0.5"}, {}, {"Retry-After": "soon"})
    assert complete(teacher_at(server))[0][0].text == "Hello."
    assert len(server.requests) == 4
    assert server.request_times[1] - server.request_times[0] >= 0.5


def test_other_server_answers_while_one_is_rate_limited(start_server):
    limited, other = start_server(), start_server()
    limited.always["*"] = {"Retry-After": "60"}
    assert len(complete(teacher_at(limited, other, concurrency=8), times=8)) == 8
    assert len(other.requests) == 8


def test_lasting_rate_limit_or_stopped_server_is_reported(start_server):
    server = start_server()
    cfg = teacher_at(server, unreachable_timeout=0.2)
    server.always["*"] = {"Retry-After": "60"}
    with raises_user_error("no-server", contains=(server.url, "429")):
        complete(cfg)
    server.stop()
    with raises_user_error("no-server", contains=cfg.url[0]):
        complete(cfg)


def test_least_busy_server_gets_the_next_request(start_server):
    slow, fast = start_server(), start_server()
    slow.delay, fast.delay = 0.1, 0.005

    async def main():
        async with ServerPool(teacher_at(slow, fast), {}) as pool:

            async def send_ten():
                for _ in range(10):
                    await pool.complete(MESSAGES)

            await asyncio.gather(*(send_ten() for _ in range(4)))

    asyncio.run(main())
    assert len(slow.requests) + len(fast.requests) == 40
    assert 1 <= len(slow.requests) < len(fast.requests)


@pytest.mark.parametrize("state", ["stopped", "failing"])
def test_broken_server_does_not_affect_the_others(store, start_server, state):
    broken, up = start_server(), start_server()
    broken.always["*"] = 500
    if state == "stopped":
        broken.stop()
    narration = narrate_store(store, teacher_at(broken, up))
    assert len(narration.rationales) == 12
    assert narration.figures["rejected"] == {}


def test_restart_of_a_server_rejects_no_response(store, start_server, caplog):
    caplog.set_level("INFO")
    server = start_server()
    port = server.server_port
    server.delay = 0.05
    restarted = []

    def restart():
        wait_until(lambda: len(server.requests) >= 5)
        server.stop()
        wait_until(lambda: "waiting for it" in caplog.text)
        restarted.append(FaultyServer(store, port=port))

    thread = threading.Thread(target=restart)
    thread.start()
    narration = narrate_store(store, teacher_at(server))
    thread.join()
    restarted[0].stop()
    assert len(narration.rationales) == 12
    assert narration.figures["rejected"] == {}
    assert restarted[0].requests


def test_repeated_url_counts_once(start_server):
    server = start_server()
    assert len(ServerPool(teacher_at(server, server), {}).servers) == 1


@pytest.mark.parametrize(
    ("is_constrained", "finish", "text", "reasoning"),
    [(True, "stop", "{}", ""), (True, "length", "", "{}"), (False, "stop", "", "{}")],
)
def test_a_constrained_response_has_no_thought(is_constrained, finish, text, reasoning):
    message = SimpleNamespace(content=None, reasoning="{}")
    choices = [SimpleNamespace(message=message, finish_reason=finish)]
    completion = SimpleNamespace(choices=choices, usage=None)
    [response] = parse_completion(completion, 1, is_constrained)
    assert (response.text, response.reasoning) == (text, reasoning)
    assert response.constrained == is_constrained


@pytest.mark.parametrize("status", [422, 500])
def test_refused_fields_are_left_out_and_named(store, start_server, caplog, status):
    caplog.set_level("INFO")
    server = start_server()
    server.refused = {"top_k": status}
    narration = narrate_store(store, teacher_at(server))
    assert len(narration.rationales) == 12
    assert not any("top_k" in request for request in server.requests)
    assert all("chat_template_kwargs" in request for request in server.requests)
    assert "takes chat_template_kwargs; refuses top_k, which requests leave out" in caplog.text


@pytest.mark.parametrize("refused", [{}, {"structured_outputs": 422}, {"response_format": 500}])
@pytest.mark.parametrize("form", ["free", "cited"])
def test_constraint_that_is_not_applied_is_named_and_not_recorded(
    store, start_server, caplog, form, refused
):
    server = start_server()
    server.constrains, server.refused = False, refused
    narrate_store(store, teacher_at(server, form=form, grammar=form == "free", attempts=1))
    assert f"{server.url} does not apply the constraint" in caplog.text
    rationales = read_rationales(store.folder / "rationales.jsonl")
    assert len(rationales) == 12
    assert {r.grammar for r in rationales} == {None}
    names = {"structured_outputs", "grammar", "guided_grammar", "response_format", "guided_json"}
    assert not any(names & set(request) for request in server.requests)


def test_slow_server_gets_fewer_requests_at_a_time(store, start_server, caplog, capsys):
    """It answers five requests a second, so the last of twelve would wait for more than two."""
    caplog.set_level("INFO")
    server = start_server()
    server.delay, server.slots = 0.4, threading.Semaphore(2)
    narration = narrate_store(store, teacher_at(server, concurrency=12))
    assert len(narration.rationales) == 12
    assert (narration.figures["rejected"], narration.figures["unanswered"]) == ({}, 0)
    assert "does not keep up with 12 requests at a time (no response within" in caplog.text
    assert re.search(r"[1-9]\d* timeouts, [1-6] at a time", capsys.readouterr().err)
