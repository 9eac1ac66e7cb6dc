"""The token with which requests are sent."""

from __future__ import annotations

import os


def authorization_headers(token: str | None) -> dict[str, str]:
    """The header with `token`, or with `$WILDCITY_TOKEN` if it is None; no header without either, or if `token` is
    empty.

    White space around the token, such as the newline at the end of a file, is removed. Raises `ValueError` if it has
    other characters than a token. The message does not contain the token: messages end up in logs.
    """
    token = (os.environ.get("WILDCITY_TOKEN", "") if token is None else token).strip()
    if not token:
        return {}
    if not token.isascii() or not token.isprintable() or " " in token:
        raise ValueError("token: has a space, a control character or a character that is not ASCII")
    return {"Authorization": f"Bearer {token}"}
