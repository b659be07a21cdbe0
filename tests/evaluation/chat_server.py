"""A small HTTP server with the protocol of chat completions, whose responses a test determines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dynapix.teacher.servers.capabilities import CANARY, UNLIKELY
from tests.local import JsonHandler, LocalServer

Reply = str | int | dict[str, Any]
"""The text of a response; an HTTP status; or a dictionary with some of the keys `status`, `message`
(of an error), `content`, `reasoning`, `finish_reason` and `prompt_ids`."""


class ChatServer(LocalServer):
    """Responds to each request with `reply(request)`, and records it in `requests`.

    If `key` is set, requests without this API key are refused. The canary that probes servers is
    answered without `reply`, and is not recorded; `constrains` says whether JSON schemas apply.
    """

    def __init__(self, reply: Callable[[dict[str, Any]], Reply], port: int = 0) -> None:
        self.reply = reply
        self.key: str | None = None
        self.root = "weights"
        self.constrains = True
        self.requests: list[dict[str, Any]] = []
        super().__init__(Handler, port)


class Handler(JsonHandler):
    server: ChatServer

    def get(self) -> None:
        if self.refused():
            return
        model = {"id": "served", "object": "model", "root": self.server.root, "parent": None}
        adapter = {"id": "adapter", "object": "model", "root": "lora", "parent": "served"}
        self.respond(200, {"object": "list", "data": [model, adapter]})

    def post(self, request: dict[str, Any]) -> None:
        if self.refused():
            return
        if request["messages"] == CANARY:
            is_constrained = UNLIKELY in str(request.get("response_format"))
            reply: Reply = UNLIKELY if is_constrained and self.server.constrains else "Hello."
        else:
            self.server.requests.append(request)
            reply = self.server.reply(request)
        if isinstance(reply, int):
            reply = {"status": reply}
        elif isinstance(reply, str):
            reply = {"content": reply}
        if status := reply.get("status"):
            self.respond(status, {"error": {"message": reply.get("message", "fault")}})
            return
        message = {"role": "assistant", "content": reply.get("content")}
        if "reasoning" in reply:
            message["reasoning"] = reply["reasoning"]
        finish = reply.get("finish_reason", "stop")
        choice = {"index": 0, "finish_reason": finish, "message": message}
        body = {"id": "x", "object": "chat.completion", "created": 0, "model": "served"}
        if "prompt_ids" in reply:
            body["prompt_token_ids"] = reply["prompt_ids"]
        self.respond(200, {**body, "choices": [choice]})

    def refused(self) -> bool:
        """Refuse the request if it lacks the server's key; return whether it was refused."""
        key = self.server.key
        if wrong := key is not None and self.headers["Authorization"] != f"Bearer {key}":
            self.respond(401, {"error": {"message": "no such key"}})
        return wrong
