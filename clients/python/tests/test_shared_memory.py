"""Observations in memory that the server shares, against the real server and against a script."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from glob import glob
from typing import Any

import numpy as np
import pytest
import wildcity
from conftest import vector
from fake_server import FakeServer
from test_end_to_end import PAIR, Server, server
from wildcity import Action, ConnectFailed, Observation, Outputs, Pose, SlotInUse

Connect = Callable[..., Any]


def names_of_memory(process: int | str = "self") -> set[str]:
    """Memory that a process has open."""
    links = set()
    for path in glob(f"/proc/{process}/fd/*"):
        try:
            links.add(os.readlink(path))
        except OSError:
            pass
    return {link for link in links if link.startswith("/memfd:wildcity-")}


def is_given_back(names: set[str]) -> None:
    """Waits until no process has the memory open."""
    assert names
    deadline = time.monotonic() + 20
    while names & names_of_memory("*"):
        assert time.monotonic() < deadline, names & names_of_memory("*")
        time.sleep(0.02)


@pytest.mark.parametrize("copy", [True, False])
@pytest.mark.parametrize("encoding", ["raw", "png"])
def test_memory_and_socket_have_the_same_bytes(
    connect: Connect,
    server: Server,
    encoding: Any,
    copy: bool,
) -> None:
    outputs = Outputs(encoding=encoding, depth=True, opacity=True, normals=True, instances=True, semantics=True)
    client = connect(server.url, shared_memory=True, copy=copy)
    session = client.open("corridor", rig=PAIR, outputs=outputs)
    for k in range(4):
        seen: Observation = session.step(Pose((float(k), 0.0, 0.0)))
        written = bytes(seen.frame)
        assert isinstance(seen.frame, bytes) is copy
        assert not seen.images["front"].flags.writeable
        # The same answer, byte for byte, through the socket: sent again to a client that resumes the session.
        plain = connect(server.url)
        other = plain.resume(session.name, seen.metadata.seq - 1)
        sent = other.step(Pose((float(k), 0.0, 0.0)))
        assert sent.frame == written
        assert sent.metadata.frame_hash == seen.metadata.frame_hash
        for name in ("images", "depth", "normals", "instances", "semantics"):
            for camera in ("front", "rear"):
                assert np.array_equal(getattr(sent, name)[camera], getattr(seen, name)[camera])
        del seen
        plain.close()
        session.resume()
    session.close()
    client.close()


def test_no_array_changes_while_it_exists(connect: Connect, server: Server) -> None:
    client = connect(server.url, shared_memory=True, copy=False)
    session = client.open("corridor", rig=PAIR, outputs=Outputs(encoding="raw", depth=True))
    kept = session.reset(seed=1).images["front"]
    first = kept.copy()
    for k in (1.0, 2.0):
        assert session.step(Pose((k, 0.0, 0.0))).metadata.step == k
    for call in (lambda: session.step(Pose((3.0, 0.0, 0.0))), lambda: session.observe([Pose()])):
        with pytest.raises(SlotInUse):
            call()
    session.prefetch([Pose()])  # Its answer takes no slot.
    assert np.array_equal(kept, first)
    # A part of an array keeps its memory too.
    kept = kept[3:5, ::2]
    with pytest.raises(SlotInUse):
        session.step(Pose((3.0, 0.0, 0.0)))
    del kept
    third = session.step(Pose((3.0, 0.0, 0.0)))
    assert third.metadata.step == 3
    assert not np.array_equal(third.images["front"], first)
    # Objects that refer to each other are found.
    loop: list[Any] = [third.depth["rear"]]
    loop.append(loop)
    del third, loop
    for k in (4.0, 5.0, 6.0):
        session.step(Pose((k, 0.0, 0.0)))
    session.close()
    client.close()


def test_what_is_let_go_is_free_without_the_collector(connect: Connect, server: Server) -> None:
    client = connect(server.url, shared_memory=True, copy=False)
    session = client.open("corridor", rig=PAIR, outputs=Outputs(encoding="png", depth=True), dynamics="kinematic")
    gc.collect()
    gc.disable()
    found = []
    collect = gc.collect
    try:
        gc.collect = lambda *_: found.append("collected") or 0  # type: ignore[assignment, func-returns-value]
        seen = session.reset(seed=1)
        for _ in range(6):
            assert seen.images["front"].mean() > 0 and seen.depth["rear"].shape == (43, 65)
            assert seen.views[0].images["rear"].shape == (43, 65, 3)
            seen = session.step(Action(1.0, 0.0))
    finally:
        gc.collect = collect
        gc.enable()
    assert not found
    del seen
    session.close()


def test_several_sessions_share_the_memory_of_their_connection(connect: Connect, server: Server) -> None:
    client = connect(server.url, shared_memory=True, copy=False)
    plain = connect(server.url)
    small = Outputs(cameras=("rear",), encoding="raw")
    sessions = [
        one.open("corridor", session=f"{name}-{transport}", rig=PAIR, outputs=small)
        for one, transport in ((client, "shared"), (plain, "plain"))
        for name in ("left", "right")
    ]
    for k in range(5):
        steps = {"left": Pose((k, 0.0, 0.0)), "right": Pose((k, 1.0, 0.0))}
        seen = client.step_many({f"{name}-shared": pose for name, pose in steps.items()})
        sent = plain.step_many({f"{name}-plain": pose for name, pose in steps.items()})
        for name in steps:
            here, there = seen[f"{name}-shared"], sent[f"{name}-plain"]
            assert np.array_equal(here.images["rear"], there.images["rear"])
            assert here.metadata.frame_hash == there.metadata.frame_hash
    del here, there, seen, sent
    # The server keeps the sessions of a closed connection, and the next test opens the same names.
    for session in sessions:
        session.close()
    client.close()


def test_memory_is_given_back(connect: Connect, server: Server) -> None:
    files = set(os.listdir("/dev/shm"))
    before = names_of_memory()
    client = connect(server.url, shared_memory=True, copy=False)
    session = client.open("corridor", rig=PAIR)
    seen = session.step(Pose((1.0, 0.0, 0.0)))
    names = names_of_memory() - before
    assert len(names) == 1
    client.close()
    assert seen.images["front"].shape == (64, 96, 3), "arrays outlive their connection"
    del seen
    session.resume()
    is_given_back(names)
    names = names_of_memory() - before
    session.close()
    client.close()
    is_given_back(names)

    # A client that is killed.
    program = (
        "import sys, time, wildcity\n"
        "client = wildcity.connect(sys.argv[1], shared_memory=True, copy=False)\n"
        "seen = client.open('corridor').reset(seed=1)\n"
        "print('ready', flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program, server.url], stdout=subprocess.PIPE, text=True) as killed:
        assert killed.stdout is not None and killed.stdout.readline() == "ready\n"
        names = names_of_memory(killed.pid)
        killed.kill()
    is_given_back(names)
    assert set(os.listdir("/dev/shm")) == files


def test_memory_of_another_machine_is_not_opened(connect: Connect) -> None:
    # The golden path is one of a process that has no such file; that of this program is another file.
    other = json.dumps({**vector("answers/shared_memory.json"), "path": "/proc/self/exe"})
    for answer in ("shared_memory", other):
        with FakeServer(["welcome", answer]) as elsewhere:
            with pytest.raises(ConnectFailed, match="same container"):
                connect(elsewhere.url, shared_memory=True)
        assert [request["type"] for request in elsewhere.requests[0]] == ["hello", "share_memory"]


def test_memory_that_was_not_asked_for_is_an_error(connect: Connect) -> None:
    with FakeServer(["welcome", "opened", "in_memory"]) as wrong:
        client = connect(wrong.url)
        session = client.open("street")
        with pytest.raises(wildcity.ProtocolError, match="not asked for"):
            session.step(Pose())
        client.close()
