"""Whether a server is up."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.parse
import urllib.request

LOOK_TIMEOUT = 10.0
"""Seconds that a server's health page may take."""


def health_problem(url: str) -> str | None:
    """What is wrong with the server at a URL that ends in /v1, None if it is up. One without a
    health page is up."""
    page = f"{url.rstrip('/').removesuffix('/v1')}/health"
    # A proxy knows nothing of this machine's own addresses.
    own = urllib.parse.urlsplit(url).hostname in ("localhost", "127.0.0.1", "::1")
    proxies = [urllib.request.ProxyHandler({})] if own else []
    try:
        with urllib.request.build_opener(*proxies).open(page, timeout=LOOK_TIMEOUT):
            return None
    except urllib.error.HTTPError as error:
        return f"HTTP {error.code}" if error.code >= 500 else None
    except urllib.error.URLError as error:
        return str(error.reason)
    except (OSError, http.client.HTTPException) as error:
        return str(error) or type(error).__name__
