"""The error of every converter."""

from __future__ import annotations

from os import PathLike

__all__ = ["LogError"]


class LogError(Exception):
    """Why a source cannot be converted.

    place: the file, and the field, row or topic in it. problem: what is wrong there. fix: what the user can do.
    """

    def __init__(self, place: str | PathLike[str], problem: str, fix: str) -> None:
        self.place, self.problem, self.fix = str(place), problem, fix
        super().__init__(f"{self.place}: {problem}; {fix}")
