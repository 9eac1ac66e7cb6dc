"""Starts the server program for the duration of a `with` block."""

from __future__ import annotations

import contextlib
import os
import queue
import shutil
import subprocess
import sysconfig
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from .errors import WildCityError

__all__ = ["LocalServer", "ServeFailed", "binary", "serve"]

LOG_LINES = 20
"""Number of the last lines of the server's log that an error contains."""


class ServeFailed(WildCityError):
    """The server program was not found, or ended before it was ready. The message has the end of its log."""


@dataclass(frozen=True)
class LocalServer:
    """A running server of this machine."""

    url: str
    """`ws://127.0.0.1:PORT/v1/session`, for `connect`."""
    process: subprocess.Popen[str]

    @property
    def http(self) -> str:
        """`http://127.0.0.1:PORT`, for `push` and `recorded_drive`."""
        return self.url.replace("ws://", "http://").removesuffix("/v1/session")


def binary() -> Path:
    """The server program: `$WILDCITY_BIN`, the one of this Python environment, or the first on the path.

    Raises `ServeFailed` if it is not found.
    """
    named = os.environ.get("WILDCITY_BIN")
    if named:
        return Path(named)
    # Where pip puts the program of a wheel.
    installed = Path(sysconfig.get_path("scripts")) / "wildcity"
    if installed.is_file():
        return installed
    found = shutil.which("wildcity")
    if found is None:
        raise ServeFailed(
            "there is no program wildcity: install a wheel that has it, or build it with "
            "`cargo install --path . --features full`, or set WILDCITY_BIN"
        )
    return Path(found)


@contextlib.contextmanager
def serve(
    twins: str | os.PathLike[str] | None = None,
    *,
    backend: str | None = None,
    memory_gib: float | None = None,
    episodes: str | os.PathLike[str] | None = None,
    arguments: Sequence[str] = (),
    timeout: float = 120.0,
) -> Iterator[LocalServer]:
    """Starts `wildcity serve` on a free port of this machine, and stops it at the end of the block.

    twins: directory or URL of the twins; the default is that of the command.
    backend, memory_gib: as `--backend` and `--memory-gib`.
    episodes: where episodes are recorded; if None, the records are deleted at the end of the block.
    arguments: more arguments of `wildcity serve`.
    timeout: how long the server may take until it listens, in seconds.

    Raises `ServeFailed` if the server does not start.
    """
    with tempfile.TemporaryDirectory(prefix="wildcity-") as folder:
        options = {
            "--listen": "127.0.0.1:0",
            "--twins": twins,
            "--episodes": episodes if episodes is not None else Path(folder) / "episodes",
            "--uploads": Path(folder) / "uploads",
            "--backend": backend,
            "--memory-gib": memory_gib,
        }
        command = [str(binary()), "serve"]
        for name, value in options.items():
            if value is not None:
                command += [name, str(value)]
        log_path = Path(folder) / "log"
        with log_path.open("w") as log:
            process = _start([*command, *arguments], log.fileno())
        try:
            yield LocalServer(_listening_url(process, log_path, timeout), process)
        finally:
            _stop(process)


def _start(command: list[str], log: int) -> subprocess.Popen[str]:
    try:
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
    except OSError as error:
        raise ServeFailed(f"cannot run {command[0]}: {error}") from error


def _listening_url(process: subprocess.Popen[str], log_path: Path, timeout: float) -> str:
    """Waits for the line `listening on ...`: agents can then connect."""
    lines: queue.Queue[str] = queue.Queue()
    stdout = process.stdout
    assert stdout is not None

    def read() -> None:
        # Read to the end, so that the server never blocks on a full pipe.
        for line in stdout:
            lines.put(line)

        stdout.close()

    threading.Thread(target=read, daemon=True).start()
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        with contextlib.suppress(queue.Empty):
            line = lines.get(timeout=0.1)
            if line.startswith("listening on "):
                return line.removeprefix("listening on ").strip()
        if process.poll() is not None:
            raise ServeFailed(f"the server ended with {process.returncode}:\n{_end_of(log_path)}")
    raise ServeFailed(f"the server did not listen within {timeout} s:\n{_end_of(log_path)}")


def _end_of(log_path: Path) -> str:
    return "\n".join(log_path.read_text(errors="replace").splitlines()[-LOG_LINES:])


def _stop(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        # The server lets running steps finish, for at most 10 s.
        process.wait(timeout=20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
