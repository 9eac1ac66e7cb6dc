"""A progress bar on standard error."""

from __future__ import annotations

import sys
import time
from types import TracebackType

__all__ = ["Progress"]


class Progress:
    """Counts steps. A terminal shows a bar; a file gets a line for each tenth, so that its length is bounded."""

    def __init__(self, label: str, total: int) -> None:
        """total: number of steps; 0 if it is not known, and then only the count is shown."""
        self.label, self.total, self.done = label, total, 0
        self._is_terminal = sys.stderr.isatty()
        self._began = self._shown = time.monotonic()
        self._tenth = 0

    def step(self, count: int = 1) -> None:
        """Counts, and draws at most ten times a second."""
        self.done += count
        if self._is_terminal:
            now = time.monotonic()
            if now - self._shown >= 0.1:
                self._shown = now
                print(f"\r{self._text(now)}\x1b[K", end="", file=sys.stderr, flush=True)
        elif self.total and 10 * self.done // self.total > self._tenth:
            self._tenth = 10 * self.done // self.total
            print(f"{self.label}: {self.done} of {self.total}", file=sys.stderr, flush=True)

    def _text(self, now: float) -> str:
        if not self.total:
            return f"{self.label}: {self.done}"
        part = min(1.0, self.done / self.total)
        rest_s = (now - self._began) * (1 - part) / part if part else 0.0
        bar = "#" * round(30 * part)
        return f"{self.label}: [{bar:<30}] {self.done} of {self.total}, {rest_s:.0f} s left"

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._is_terminal:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
