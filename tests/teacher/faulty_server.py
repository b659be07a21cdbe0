"""A local chat server that answers with rationales of the built-in narrator, or with a fault."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Iterable
from socket import SO_LINGER, SOL_SOCKET
from typing import Any

from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.servers.capabilities import CANARY, UNLIKELY
from tests.local import JsonHandler, LocalServer
from tests.teacher.memory_store import MemoryStore, prompts_and_rationales

Fault = int | bytes | str | dict[str, str]
"""How a response is faulty: its status (int), its body (bytes), the headers of a rate limit with
status 429 (dict), or a word: "hang", "reset", or a fault of `spoil_text`."""


def teacher_at(*servers: FaultyServer, **changes: Any) -> TeacherConfig:
    """Return the settings of a teacher at these servers."""
    settings = {"concurrency": 2, "unreachable_timeout": 5.0, "timeout": 1.0, **changes}
    url = [server.url for server in servers]
    return TeacherConfig(name="served", url=url, model="tiny", **settings)


def spoil_text(fault: str, text: str) -> tuple[str, str]:
    """Return the text with a fault, and the finish_reason of the response."""
    return {
        "cut": (text[:200], "length"),
        "number": (text.replace("The ", "The two ", 1), "stop"),
        "empty": ("", "stop"),
        "thinking": (f"<think>\nLet me see.\n</think>\n\n{text}", "stop"),
        "long": ("The ball rolls east. " * 500_000, "stop"),
        "surrogate": (text.replace("The ", "\ud800 ", 1), "stop"),
    }[fault]


class FaultyServer(LocalServer):
    """A server whose first responses have one of `faults` each, in order. Responses to the canary,
    the prompt with which a pool tests and probes servers, do not count and have none of these
    faults. The server applies constraints to the canary under vLLM's names.

    Attributes:
        always: The fault of every response to a prompt; the prompt "*" stands for all prompts,
            including the canary.
        requests: The requests so far, without canaries.
        request_times: When each of these requests arrived.
        delay: Seconds before a response.
        slots: Limits how many requests are answered at the same time; others wait.
        refused: Fields of a request that are refused, and the status of the refusal.
        constrains: Whether constraints apply.
        max_in_flight: Maximum number of requests that were answered at the same time.
        rationales: The rationale for each prompt.
    """

    def __init__(self, store: MemoryStore, faults: Iterable[Fault] = (), port: int = 0) -> None:
        self.faults, self.always = list(faults), {}
        self.requests: list[dict[str, Any]] = []
        self.request_times: list[float] = []
        self.lock = threading.Lock()
        self.in_flight = self.max_in_flight = 0
        self.delay, self.slots = 0.0, threading.Semaphore(1000)
        self.refused: dict[str, int] = {}
        self.constrains = True
        self.rationales = {prompt: text for _, prompt, text in prompts_and_rationales(store)}
        super().__init__(Handler, port)

    def find_text(self, request: dict[str, Any]) -> str:
        """Return the text of a response without faults."""
        constraint = str({k: request.get(k) for k in ("structured_outputs", "response_format")})
        if UNLIKELY in constraint and self.constrains:
            return UNLIKELY
        return self.rationales.get(request["messages"][-1]["content"], "Hello.")


class Handler(JsonHandler):
    server: FaultyServer

    def get(self) -> None:
        self.respond(200, {"object": "list", "data": [{"id": "other", "object": "model"}]})

    def post(self, request: dict[str, Any]) -> None:
        server, prompt = self.server, request["messages"][-1]["content"]
        with server.lock:
            fault = server.always.get(prompt) or server.always.get("*")
            if request["messages"] != CANARY:
                server.requests.append(request)
                server.request_times.append(time.monotonic())
                if fault is None and server.faults:
                    fault = server.faults.pop(0)
            server.in_flight += 1
            server.max_in_flight = max(server.max_in_flight, server.in_flight)
        with server.slots:
            time.sleep(server.delay)
        try:
            self.respond_to_prompt(request, server.find_text(request), fault)
        finally:
            with server.lock:
                server.in_flight -= 1

    def respond_to_prompt(self, request: dict[str, Any], text: str, fault: Fault | None) -> None:
        if refused := next(filter(request.get, self.server.refused), None):
            self.respond(self.server.refused[refused], {"detail": f"unexpected: {refused}"})
        elif isinstance(fault, int):
            self.respond(fault, {"error": {"message": "fault", "type": "t", "code": fault}})
        elif isinstance(fault, dict):
            self.respond(429, {"error": {"message": "slow down"}}, fault)
        elif isinstance(fault, bytes):
            self.send_response(200)
            kind = "application/json" if fault[:1] in b"{[" else "text/html"
            self.send_header("Content-Type", kind)
            self.end_headers()
            self.wfile.write(fault)
        elif fault == "hang":
            time.sleep(3)
        elif fault == "reset":
            # Half of a response, then a reset of the connection.
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", "1000")
            self.end_headers()
            self.wfile.write(b'{"choices": [')
            self.connection.setsockopt(SOL_SOCKET, SO_LINGER, struct.pack("ii", 1, 0))
            self.connection.close()
        else:
            text, finish_reason = spoil_text(fault, text) if fault else (text, "stop")
            self.respond(200, completion(text, finish_reason, request.get("n") or 1))


def completion(text: str, finish_reason: str, n: int) -> dict[str, Any]:
    message = {"role": "assistant", "content": text}
    choices = [{"index": k, "finish_reason": finish_reason, "message": message} for k in range(n)]
    usage = {"prompt_tokens": 1000, "completion_tokens": 101 * n, "total_tokens": 1}
    head = {"id": "x", "object": "chat.completion", "created": 0, "model": "tiny"}
    return {**head, "choices": choices, "usage": usage}
