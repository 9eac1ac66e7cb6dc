"""Converts data sets and bags to logs of the format `wildcity.log/1`.

    from wildcity.logs import Options, convert
    convert(Path("nuscenes"), Path("scene-0061"), Options(log="scene-0061"))

docs/logs_from.md lists the kinds of sources.
"""

from __future__ import annotations

from pathlib import Path

from .errors import LogError
from .kinds import KINDS, Kind, Options, detect, named
from .writer import Report

__all__ = ["KINDS", "Kind", "LogError", "Options", "Report", "convert", "detect"]


def convert(source: Path, out: Path, options: Options | None = None, kind: str | None = None) -> Report:
    """Writes the log of a source to the folder `out`, which must not exist. kind: found by the content if None.

    A run that was killed leaves `out.partial`; the next run with the same arguments goes on there. Raises `LogError`.
    """
    found = named(kind) if kind else detect(source)
    converter = found.converter()
    try:
        return converter.convert(source, out, options or Options())
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        # Of a value that no converter foresees: a user gets a sentence, and its cause with it.
        problem = f"a file that the kind {found.name} does not have so: {type(error).__name__}: {error}"
        raise LogError(source, problem, "use files of the documented schema, and report this if they are") from error
