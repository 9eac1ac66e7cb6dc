"""Addresses of a server. Every function takes the same forms."""

from __future__ import annotations

import urllib.parse

FORMS = "HOST:PORT, http://HOST:PORT, https://HOST, ws://HOST:PORT/v1/session or wss://HOST/v1/session"
SESSION = "/v1/session"


def session_url(address: str) -> str:
    """The address of sessions, `ws://HOST:PORT/v1/session`. Raises `ValueError` for any other text."""
    scheme, host, prefix = _parts(address)
    return f"{'wss' if scheme in ('https', 'wss') else 'ws'}://{host}{prefix}{SESSION}"


def server_url(address: str) -> str:
    """The address of HTTP requests, `http://HOST:PORT`. Raises `ValueError` for any other text."""
    scheme, host, prefix = _parts(address)
    if prefix:
        raise ValueError(f"{address!r} has a path, which only addresses of sessions may have: give http://HOST:PORT")
    return f"{'https' if scheme in ('https', 'wss') else 'http'}://{host}"


def _parts(address: str) -> tuple[str, str, str]:
    """Scheme, host with its port, and what a proxy has before `/v1/session`."""
    parts = urllib.parse.urlsplit(address if "://" in address else f"http://{address}")
    try:
        port = parts.port
    except ValueError:
        port = -1
    is_known = parts.scheme in ("http", "https", "ws", "wss") and parts.hostname and port != -1
    # A password in an address would be sent to no one, and what follows the path would be lost.
    is_whole = (parts.path in ("", "/") or parts.path.endswith(SESSION)) and not (
        parts.query or parts.fragment or parts.username
    )
    if not is_known or not is_whole:
        raise ValueError(f"{address!r} is not the address of a server: give {FORMS}")
    return parts.scheme, parts.netloc, parts.path.rstrip("/").removesuffix(SESSION)
