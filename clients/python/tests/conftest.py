"""Shared by the tests: the golden vectors, and both clients with one blocking interface."""

from __future__ import annotations

import asyncio
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import wildcity
import wildcity.aio

PROTOCOL = Path(__file__).resolve().parents[3] / "protocol"


def vector(name: str) -> Any:
    """A golden JSON file."""
    return json.loads((PROTOCOL / "vectors" / name).read_text())


def frame(name: str) -> bytes:
    """A golden binary file."""
    return (PROTOCOL / "vectors" / name).read_bytes()


@pytest.fixture(scope="session")
def reader(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a reader of the documentation, with `wildcity` on the path and the demo twin built."""
    binary = os.environ.get("WILDCITY_BIN")
    assert binary, "set WILDCITY_BIN to the built wildcity binary"
    home = tmp_path_factory.mktemp("home")
    environment = dict(os.environ)
    environment["PATH"] = f"{Path(binary).parent}:{Path(sys.executable).parent}:{environment['PATH']}"
    for name in ("DATA", "STATE", "CACHE"):
        environment[f"XDG_{name}_HOME"] = str(home / name.lower())
    demo = ["wildcity", "demo", "--steps", "1", "--out", str(home / "demo")]
    done = subprocess.run(demo, cwd=home, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return environment


@pytest.fixture(params=["sync", "aio"])
def connect(request: pytest.FixtureRequest) -> Iterator[Callable[..., Any]]:
    """`connect` of both clients in turn. Clients that are still open are closed at the end."""
    clients = []
    loop = asyncio.new_event_loop()

    def connect(url: str, **options: Any) -> Any:
        if request.param == "sync":
            client: Any = wildcity.connect(url, **options)
        else:
            connecting = wildcity.aio.connect(url, **options)
            client = Blocking(loop.run_until_complete(connecting), loop)
        clients.append(client)
        return client

    yield connect
    for client in clients:
        client.close()
    loop.close()


class Blocking:
    """An asyncio object with blocking methods."""

    def __init__(self, inner: Any, loop: asyncio.AbstractEventLoop) -> None:
        self._inner, self._loop = inner, loop

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._inner, name)
        if not inspect.iscoroutinefunction(attribute):
            return attribute

        def call(*arguments: Any, **options: Any) -> Any:
            result = self._loop.run_until_complete(attribute(*arguments, **options))
            is_ours = isinstance(result, (wildcity.aio.Client, wildcity.aio.Session))
            return Blocking(result, self._loop) if is_ours else result

        return call

    def __enter__(self) -> Blocking:
        self._loop.run_until_complete(self._inner.__aenter__())
        return self

    def __exit__(self, *error: Any) -> None:
        self._loop.run_until_complete(self._inner.__aexit__(*error))
