"""Shared by the tests: the golden vectors, and both clients with one blocking interface."""

from __future__ import annotations

import asyncio
import fcntl
import inspect
import json
import os
import shutil
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


def environment_in(home: Path) -> dict[str, str]:
    """The environment of a reader of the documentation: `wildcity` is on the path, and keeps its files in `home`."""
    binary = os.environ.get("WILDCITY_BIN")
    assert binary, "set WILDCITY_BIN to the built wildcity binary"
    environment = dict(os.environ)
    # A driver of Vulkan takes 15 s to compile the shaders. It finds those that it compiled before where it always does.
    caches = environment.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    environment.setdefault("MESA_SHADER_CACHE_DIR", caches)
    environment["PATH"] = f"{Path(binary).parent}:{Path(sys.executable).parent}:{environment['PATH']}"
    for name in ("DATA", "STATE", "CACHE"):
        environment[f"XDG_{name}_HOME"] = str(home / name.lower())
    return environment


def with_data_of(other: dict[str, str], home: Path) -> dict[str, str]:
    """An environment that begins with the twins of another one."""
    environment = environment_in(home)
    shutil.copytree(other["XDG_DATA_HOME"], environment["XDG_DATA_HOME"])
    return environment


def wildcity_in(environment: dict[str, str], *command: str) -> None:
    done = subprocess.run(["wildcity", *command], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def reader(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a reader of the documentation, with `wildcity` on the path and the demo twin built."""
    home = tmp_path_factory.mktemp("home")
    environment = environment_in(home)
    # Processes of pytest-xdist have their folders in one: the first of them builds the twin, and all copy it.
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    with (shared / "demo.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        built = shared / "demo"
        if not built.exists():
            made = shared / "demo.part"
            out = str(home / "demo")
            wildcity_in(environment, "demo", "--steps", "1", "--out", out, "--twins", str(made))
            made.rename(built)
    shutil.copytree(built, home / "data" / "wildcity" / "twins")
    return environment


@pytest.fixture(scope="session")
def quick_reader(reader: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The same, with cameras of 1/64 of the pixels and without a sky, which each process that draws prepares for 0.6 s.

    For tests of commands, programs, drivers and records; test_package.py drives with the twin as it is built.
    """
    home = tmp_path_factory.mktemp("quick")
    environment = with_data_of(reader, home)
    rig = json.loads((PROTOCOL.parent / "scenes" / "rigs" / "vehicle6.json").read_text())
    for camera in rig["cameras"]:
        camera.update({name: camera[name] // 8 for name in ("width", "height")})
        camera.update({name: camera[name] / 8 for name in ("fx", "fy", "cx", "cy")})
    (home / "rig.json").write_text(json.dumps(rig))
    wildcity_in(environment, "twin", "drive", "demo", "--rig", str(home / "rig.json"))
    wildcity_in(environment, "twin", "sky", "demo", "--remove")
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
