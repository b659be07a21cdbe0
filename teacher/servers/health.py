"""Health check of an OpenAI-compatible server."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.parse
import urllib.request

HEALTH_TIMEOUT = 10.0
"""Seconds to wait for the health page."""


def check_health(url: str) -> str | None:
    """Returns why the server at a URL that ends in /v1 is down, or None if it is up.

    A server without a health page counts as up.
    """
    page = f"{url.rstrip('/').removesuffix('/v1')}/health"
    # A configured proxy cannot reach this machine's loopback addresses.
    local = urllib.parse.urlsplit(url).hostname in ("localhost", "127.0.0.1", "::1")
    proxies = [urllib.request.ProxyHandler({})] if local else []
    try:
        with urllib.request.build_opener(*proxies).open(page, timeout=HEALTH_TIMEOUT):
            return None
    except urllib.error.HTTPError as error:
        return f"HTTP {error.code}" if error.code >= 500 else None
    except urllib.error.URLError as error:
        return str(error.reason)
    except (OSError, http.client.HTTPException) as error:
        return str(error) or type(error).__name__
