"""What holds for every request: headers that let a page load nothing from elsewhere, and no form
that another site sends."""

from __future__ import annotations

from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY = "; ".join(
    [
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        # A page's media are fetched first and then shown from memory.
        "img-src 'self' blob:",
        "media-src blob:",
        "connect-src 'self'",
        "form-action 'self'",
        "frame-ancestors 'none'",
        "base-uri 'none'",
    ]
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    # Without any, browsers would not say which site a form comes from either.
    "Referrer-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "X-Robots-Tag": "noindex, nofollow",
    # An item that was answered is not to be looked at again.
    "Cache-Control": "no-store",
}


PORTS = {"http": 80, "https": 443}
"""Which browsers leave away."""


class Guard:
    """Wraps an application; `public` is its address behind a proxy, if it is behind one."""

    def __init__(self, app: ASGIApp, public: str | None) -> None:
        self._app = app
        self._public = _site(public) if public else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
            await send(message)

        if scope["type"] != "http":
            return
        if scope["method"] == "POST" and self._foreign(Headers(scope=scope)):
            refusal = PlainTextResponse("This form comes from another site.", 403)
            await refusal(scope, receive, guarded)
        else:
            await self._app(scope, receive, guarded)

    def _foreign(self, headers: Headers) -> bool:
        """Whether a browser says that another site sends this; what is no browser says nothing."""
        origin = headers.get("origin")
        if origin is None:
            return headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none")
        asked = f"{origin.partition(':')[0]}://{headers.get('host', '')}"
        return _site(origin) not in {_site(asked), self._public} - {None}


def _site(url: str) -> tuple[str, int | None] | None:
    """The host and the port of an address, however they are written; None where it has none."""
    try:
        parts = urlsplit(url)
        port = parts.port or PORTS.get(parts.scheme)
    except ValueError:
        return None
    return (parts.hostname, port) if parts.hostname else None
