"""Begins the log of a source."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from .kinds import Options
from .writer import LogWriter

__all__ = ["opened"]


def opened(
    kind: str, source: Path, out: Path, options: Options, *, log: str, licence: str, decides: dict[str, Any]
) -> LogWriter:
    """The writer of a log.

    log: its name in the source. licence: of the data set; the user's note replaces it. decides: what else of the source
    decides the result, such as sizes of files: a run goes on only if it is the same.
    """
    head = {
        "kind": kind,
        "id": log,
        "licence": options.licence or licence,
        "converter": f"wildcity.logs.{kind}",
        "path": os.path.abspath(source),
        "options": {name: value for name, value in options.values.items() if value},
        "decides": decides,
    }
    return LogWriter(out, head, reference=options.reference)
