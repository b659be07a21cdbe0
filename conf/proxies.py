"""The proxies that the environment puts between this machine and servers.

The variables HTTP_PROXY, HTTPS_PROXY and ALL_PROXY also apply to servers of this machine, unless
NO_PROXY names the host.
"""

from __future__ import annotations

import os
from urllib.parse import urlsplit
from urllib.request import proxy_bypass_environment


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
