"""The token with which requests are sent."""

from __future__ import annotations

import os


def authorization_headers(token: str | None) -> dict[str, str]:
    """The header with `token`, or else with `$WILDCITY_TOKEN`; empty without either.

    White space around the token, such as the newline at the end of a file, is removed. Raises `ValueError` if it has
    other characters than a token. The message does not contain the token: messages end up in logs.
    """
    token = (token or os.environ.get("WILDCITY_TOKEN") or "").strip()
    if not token:
        return {}
    if not token.isascii() or not token.isprintable() or " " in token:
        raise ValueError("token: has a space, a control character or a character that is not ASCII")
    return {"Authorization": f"Bearer {token}"}
