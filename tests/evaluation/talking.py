"""A small real server that speaks the chat protocol, and that of images, and says or draws what it
is given."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

from tests.local import JsonHandler, LocalServer

Said = str | int | bytes | dict[str, Any]
"""A text; a status; an image's bytes; or an answer's `content`, `reasoning`, `finish_reason` or
`message`."""


class TalkingServer(LocalServer):
    """`says` gives an answer to each request; `asked` are the requests. Where `key` is set, those
    without it are turned away."""

    def __init__(self, says: Callable[[dict[str, Any]], Said], port: int = 0) -> None:
        self.says = says
        self.key: str | None = None
        self.root = "weights"
        self.asked: list[dict[str, Any]] = []
        super().__init__(Handler, port)


class Handler(JsonHandler):
    server: TalkingServer

    def get(self) -> None:
        if self.locked():
            return
        model = {"id": "served", "object": "model", "root": self.server.root, "parent": None}
        adapter = {"id": "adapter", "object": "model", "root": "lora", "parent": "served"}
        self.respond(200, {"object": "list", "data": [model, adapter]})

    def post(self, request: dict[str, Any]) -> None:
        if self.locked():
            return
        self.server.asked.append(request)
        said = self.server.says(request)
        if isinstance(said, int):
            said = {"status": said}
        elif isinstance(said, str):
            said = {"content": said}
        elif isinstance(said, bytes):
            image = {"b64_json": base64.b64encode(said).decode()}
            self.respond(200, {"created": 0, "data": [image]})
            return
        if status := said.get("status"):
            self.respond(status, {"error": {"message": said.get("message", "fault")}})
            return
        message = {"role": "assistant", "content": said.get("content")}
        if "reasoning" in said:
            message["reasoning"] = said["reasoning"]
        finish = said.get("finish_reason", "stop")
        choice = {"index": 0, "finish_reason": finish, "message": message}
        body = {"id": "x", "object": "chat.completion", "created": 0, "model": "served"}
        self.respond(200, {**body, "choices": [choice]})

    def locked(self) -> bool:
        """Whether the key is another, which is told."""
        wanted = self.server.key
        if wrong := wanted is not None and self.headers["Authorization"] != f"Bearer {wanted}":
            self.respond(401, {"error": {"message": "no such key"}})
        return wrong
