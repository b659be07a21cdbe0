"""A small real server that speaks the chat protocol, and that of images, and says or draws what it
is given."""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Said = str | int | bytes | dict[str, Any]
"""A text; a status; an image's bytes; or an answer's `content`, `reasoning`, `finish_reason` or
`message`."""


class TalkingServer(ThreadingHTTPServer):
    """`says` gives an answer to each request; `asked` are the requests."""

    daemon_threads = True

    def __init__(self, says: Callable[[dict[str, Any]], Said], port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), Handler)
        self.says = says
        self.asked: list[dict[str, Any]] = []
        threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/v1"

    def handle_error(self, *_: object) -> None:
        """A client that hangs up is nothing to tell."""

    def stop(self) -> None:
        self.shutdown()
        self.server_close()


class Handler(BaseHTTPRequestHandler):
    server: TalkingServer

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        model = {"id": "served", "object": "model", "root": "weights", "parent": None}
        adapter = {"id": "adapter", "object": "model", "root": "lora", "parent": "served"}
        self.say(200, {"object": "list", "data": [model, adapter]})

    def do_POST(self) -> None:
        request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.asked.append(request)
        said = self.server.says(request)
        if isinstance(said, int):
            said = {"status": said}
        elif isinstance(said, str):
            said = {"content": said}
        elif isinstance(said, bytes):
            image = {"b64_json": base64.b64encode(said).decode()}
            self.say(200, {"created": 0, "data": [image]})
            return
        if status := said.get("status"):
            self.say(status, {"error": {"message": said.get("message", "fault")}})
            return
        message = {"role": "assistant", "content": said.get("content")}
        if "reasoning" in said:
            message["reasoning"] = said["reasoning"]
        finish = said.get("finish_reason", "stop")
        choice = {"index": 0, "finish_reason": finish, "message": message}
        body = {"id": "x", "object": "chat.completion", "created": 0, "model": "served"}
        self.say(200, {**body, "choices": [choice]})

    def say(self, status: int, body: dict[str, Any]) -> None:
        content = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)
