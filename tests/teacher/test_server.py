"""The client against real servers that are down, busy, slow, or several."""

import asyncio
import json
import threading
import time
from email.utils import formatdate

import pytest

from conf.errors import UserError
from conf.schema import TeacherConfig
from teacher.grammar import grammar
from teacher.narrate import narrate_store
from teacher.server_narrator import request_fields
from teacher.servers.pool import ServerPool, jitter
from tests.teacher.odd import OddServer, completion

CHAT = [{"role": "user", "content": "Are you there?"}]


def config(*servers, **changes):
    settings = {"concurrency": 4, "patience": 5.0, "timeout": 2.0, **changes}
    url = [server.url for server in servers]
    return TeacherConfig(name="served", url=url, model="tiny", **settings)


def ask(cfg, times=1, **own):
    async def main():
        async with ServerPool(cfg, request_fields(cfg)) as client:
            return await asyncio.gather(*(client.complete(CHAT, **own) for _ in range(times)))

    return asyncio.run(main())


def test_pauses_grow_to_the_longest_and_are_anything_below():
    for times, most in ((1, 1.0), (2, 2.0), (3, 4.0), (5, 10.0), (50, 10.0)):
        pauses = [jitter(times) for _ in range(1000)]
        assert 0 <= min(pauses) < 0.1 * most
        assert 0.9 * most < max(pauses) <= most


def test_no_more_requests_are_in_flight_than_asked_for(store, odd):
    server = odd()
    server.delay = 0.05
    narrate_store(store, config(server, concurrency=3))
    assert server.most == 3


def test_a_constraint_is_sent_as_vllm_takes_it(odd):
    server = odd()
    ask(config(server, grammar=True))
    assert server.asked[0]["structured_outputs"] == {"grammar": grammar(config(server))}


def test_a_request_may_have_fields_of_its_own(odd):
    server = odd()
    ask(config(server, temperature=0.3), seed=7, temperature=0.6)
    asked = server.asked[0]
    assert (asked["seed"], asked["temperature"], asked["top_p"]) == (7, 0.6, 0.8)


def test_fewer_answers_than_asked_for_are_taken(odd):
    server = odd(json.dumps(completion("Hello.", "stop", 2)).encode())

    async def main():
        async with ServerPool(config(server), {}) as client:
            return await client.complete(CHAT, 4)

    assert len(asyncio.run(main())) == 2
    assert server.asked[0]["n"] == 4


def test_a_rate_limit_is_waited_for_and_costs_no_attempt(odd):
    server = odd({"Retry-After": "0.5"})
    assert ask(config(server))[0][0].text == "Hello."
    assert len(server.asked) == 2
    assert server.times[1] - server.times[0] >= 0.5


@pytest.mark.slow
def test_a_rate_limit_may_be_a_date(odd):
    # A date has whole seconds.
    until = int(time.time()) + 2
    server = odd({"Retry-After": formatdate(until, usegmt=True)})
    ask(config(server))
    assert len(server.asked) == 2
    assert time.time() >= until


def test_a_rate_limit_without_a_time_is_tried_again(odd):
    server = odd({}, {}, {"Retry-After": "soon"})
    assert ask(config(server))[0][0].text == "Hello."
    assert len(server.asked) == 4


def test_another_server_answers_while_one_wants_to_be_left_alone(odd):
    limited, other = odd(), odd()
    limited.always["*"] = {"Retry-After": "60"}
    assert len(ask(config(limited, other, concurrency=8), times=8)) == 8
    assert len(other.asked) == 8


def test_a_limit_without_end_ends_with_patience(odd):
    server = odd()
    server.always["*"] = {"Retry-After": "60"}
    with pytest.raises(UserError, match=f"{server.url}: it wants to be left alone"):
        ask(config(server, patience=0.2))


def test_servers_share_the_work_by_how_busy_they_are(odd):
    slow, fast = odd(), odd()
    slow.delay, fast.delay = 0.1, 0.005

    async def main():
        async with ServerPool(config(slow, fast), {}) as client:

            async def lane():
                for _ in range(10):
                    await client.complete(CHAT)

            await asyncio.gather(*(lane() for _ in range(4)))

    asyncio.run(main())
    assert len(slow.asked) + len(fast.asked) == 40
    assert 1 <= len(slow.asked) < len(fast.asked)


def test_a_server_that_is_down_does_not_stop_the_others(store, odd):
    down, up = odd(), odd()
    down.stop()
    narration = narrate_store(store, config(down, up))
    assert len(narration.rationales) == 12
    assert narration.summary.rejected == {}


def test_a_server_that_goes_down_midway_does_not_stop_the_others(store, odd):
    up, broken = odd(), odd()
    broken.always["*"] = 500
    narration = narrate_store(store, config(up, broken))
    assert len(narration.rationales) == 12
    assert narration.summary.rejected == {}


def test_a_restarting_server_is_waited_for_without_attempts(store, odd):
    server = odd()
    port = server.server_port
    server.delay = 0.05
    back = []

    def restart():
        while len(server.asked) < 5:
            time.sleep(0.01)
        server.stop()
        time.sleep(0.5)
        back.append(OddServer(store, port=port))

    thread = threading.Thread(target=restart)
    thread.start()
    narration = narrate_store(store, config(server))
    thread.join()
    back[0].stop()
    assert len(narration.rationales) == 12
    assert narration.summary.rejected == {}
    assert back[0].asked


def test_each_url_is_asked_once_for_its_name(odd):
    server = odd()

    async def main():
        async with ServerPool(config(server, server), {}) as client:
            return len(client.places)

    assert asyncio.run(main()) == 1
