"""Clients of servers, and the proxies that the environment puts before them.

The variables HTTP_PROXY, HTTPS_PROXY and ALL_PROXY also apply to servers of this machine, unless
NO_PROXY names the host.
"""

from __future__ import annotations

import os
from typing import TypeVar
from urllib.parse import urlsplit
from urllib.request import proxy_bypass_environment

import openai

from conf.errors import UserError

Client = TypeVar("Client", openai.OpenAI, openai.AsyncOpenAI)


def open_client(kind: type[Client], url: str, api_key: str, timeout: float) -> Client:
    """Return a client of a server that repeats no request.

    Raises:
        UserError: The environment names a proxy for the server that cannot be used.
    """
    options = {"base_url": url, "api_key": api_key, "max_retries": 0, "timeout": timeout}
    try:
        return kind(**options)
    except Exception as error:  # That of a missing package, or of an address that is none.
        if hint := proxy_hint(url):
            raise UserError(f"{url} cannot be reached ({error}){hint}", code="proxy") from error
        # The proxy is that of other hosts.
        is_async = kind is openai.AsyncOpenAI
        transport = openai.DefaultAsyncHttpxClient if is_async else openai.DefaultHttpxClient
        return kind(**options, http_client=transport(trust_env=False))


def proxy_hint(url: str) -> str:
    """Return a clause that names the environment variable of the proxy through which requests to
    `url` go; empty without a proxy."""
    parts = urlsplit(url)
    host = parts.hostname or ""
    names = (f"{parts.scheme}_proxy", f"{parts.scheme}_proxy".upper(), "all_proxy", "ALL_PROXY")
    # The value may contain a password.
    used = [name for name in names if os.environ.get(name)]
    if not used or proxy_bypass_environment(host):
        return ""
    return (
        f"; requests go through the proxy of the environment variable {used[0]}: to reach the "
        f"server without it, add {host} to the variable NO_PROXY"
    )
