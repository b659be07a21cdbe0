"""Serves an application at an address until it is told to stop."""

from __future__ import annotations

import errno
import socket

import uvicorn
from starlette.types import ASGIApp

from conf.errors import UserError

WAITING = 2048
"""Connections that may wait to be taken."""


def listener(host: str, port: int) -> socket.socket:
    """A socket that listens. Raises UserError where the address is not this machine's, or taken."""
    try:
        family, kind, protocol, _, bound = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[
            0
        ]
        opened = socket.socket(family, kind, protocol)
        try:
            # A port is free although connections of the last server linger.
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            opened.bind(bound)
            opened.listen(WAITING)
        except OSError:
            opened.close()
            raise
        return opened
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            why = f"port={port} is taken: stop the server there, or choose another port="
        elif error.errno == errno.EACCES:
            why = f"port={port} needs more rights: choose one above 1023"
        else:
            why = f"host={host} is no address of this machine"
        raise UserError(f"cannot serve the study: {why}") from error


def serve(app: ASGIApp, at: socket.socket) -> None:
    """Answer requests until Ctrl-C or SIGTERM."""
    # Its own log would tell who asked for what.
    settings = uvicorn.Config(
        app, log_config=None, log_level="warning", access_log=False, server_header=False,
        proxy_headers=False, lifespan="off", ws="none", backlog=WAITING,
        timeout_graceful_shutdown=5,
    )  # fmt: skip
    uvicorn.Server(settings).run(sockets=[at])
