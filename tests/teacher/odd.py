"""A small real server that answers chats by the built-in narrator, and oddly when it is told to."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Iterable
from socket import SO_LINGER, SOL_SOCKET
from typing import Any

from conf.schema import TeacherConfig
from teacher.narrator import write_rationale
from teacher.predicates import extract_predicates
from teacher.prompts import messages
from tests.local import JsonHandler, LocalServer
from tests.teacher.made import MadeStore

Fault = int | bytes | str | dict[str, str]
"""A status; the bytes of a body; headers of a refusal (429); or one of the words of `odd_text`,
`hang` and `reset`."""


def odd_text(word: str, text: str) -> tuple[str, str]:
    """A text and its finish_reason."""
    return {
        "cut": (text[:200], "length"),
        "number": (text.replace("The ", "The two ", 1), "stop"),
        "empty": ("", "stop"),
        "thinking": (f"<think>\nLet me see.\n</think>\n\n{text}", "stop"),
        "long": ("The ball rolls east. " * 500_000, "stop"),
        "surrogate": (text.replace("The ", "\ud800 ", 1), "stop"),
    }[word]


class OddServer(LocalServer):
    """`faults` come before proper answers, in order; `always` comes instead of them. `asked` are
    the requests; `most` is how many were in flight at once."""

    def __init__(self, store: MadeStore, faults: Iterable[Fault] = (), port: int = 0) -> None:
        self.faults, self.always = list(faults), {}
        self.asked: list[dict[str, Any]] = []
        self.times: list[float] = []
        self.lock = threading.Lock()
        self.in_flight = self.most = 0
        self.delay = 0.0
        self.texts = {}
        for item in store.selection("train"):
            predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
            if predicates:
                chat = messages(predicates, item, TeacherConfig(name="odd"))
                self.texts[chat[1]["content"]] = write_rationale(predicates, item, 0)
        super().__init__(Handler, port)


class Handler(JsonHandler):
    server: OddServer

    def get(self) -> None:
        if self.path == "/health":
            self.say(200, {})
        else:
            self.say(200, {"object": "list", "data": [{"id": "other", "object": "model"}]})

    def post(self, request: dict[str, Any]) -> None:
        server, said = self.server, request["messages"][-1]["content"]
        with server.lock:
            server.asked.append(request)
            server.times.append(time.monotonic())
            server.in_flight += 1
            server.most = max(server.most, server.in_flight)
            fault = server.always.get(said) or server.always.get("*")
            if fault is None and server.faults:
                fault = server.faults.pop(0)
        time.sleep(server.delay)
        try:
            self.answer(request, server.texts.get(said, "Hello."), fault)
        finally:
            with server.lock:
                server.in_flight -= 1

    def answer(self, request: dict[str, Any], text: str, fault: Fault | None) -> None:
        if isinstance(fault, int):
            self.say(fault, {"error": {"message": "fault", "type": "t", "code": fault}})
        elif isinstance(fault, dict):
            self.say(429, {"error": {"message": "slow down"}}, fault)
        elif isinstance(fault, bytes):
            self.raw(fault)
        elif fault == "hang":
            time.sleep(3)
        elif fault == "reset":
            # Half of an answer, then a reset in place of an end.
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", "1000")
            self.end_headers()
            self.wfile.write(b'{"choices": [')
            self.connection.setsockopt(SOL_SOCKET, SO_LINGER, struct.pack("ii", 1, 0))
            self.connection.close()
        else:
            told = odd_text(fault, text) if fault else (text, "stop")
            self.say(200, completion(*told, request.get("n") or 1))

    def raw(self, content: bytes) -> None:
        self.send_response(200)
        self.send_header(
            "Content-Type", "application/json" if content[:1] in b"{[" else "text/html"
        )
        self.end_headers()
        self.wfile.write(content)


def completion(text: str, finish_reason: str, n: int) -> dict[str, Any]:
    choices = [
        {
            "index": k,
            "finish_reason": finish_reason,
            "message": {"role": "assistant", "content": text},
        }
        for k in range(n)
    ]
    return {
        "id": "x",
        "object": "chat.completion",
        "created": 0,
        "model": "tiny",
        "choices": choices,
        "usage": {"prompt_tokens": 1000, "completion_tokens": 101 * n, "total_tokens": 1},
    }
