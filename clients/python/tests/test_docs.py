"""The commands and programs of the documentation, run as a reader would run them."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import with_data_of
from test_push import write_ply

ROOT = Path(__file__).resolve().parents[3]
PAGES = [
    "README.md",
    "docs/actors.md",
    "docs/agents.md",
    "docs/alpamayo.md",
    "docs/alpasim.md",
    "docs/augmentation.md",
    "docs/evaluation.md",
    "docs/gym.md",
    "docs/logs.md",
    "docs/logs_from.md",
    "docs/operators.md",
    "docs/pipelines.md",
    "docs/repair.md",
    "docs/scenarios.md",
    "docs/scenes.md",
    "docs/suites.md",
    "docs/training.md",
    "docs/tutorial.md",
]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES)
def test_a_page_does_what_it_says(page: str, quick_reader: dict[str, str], tmp_path: Path) -> None:
    write_ply(tmp_path / "capture.ply", 0.0, 1, count=300)
    write_ply(tmp_path / "block7.ply", 0.0, 2, count=300)
    port = free_port()
    # Of its own: `wildcity demo` builds its twin again after another page has changed it.
    reader = with_data_of(quick_reader, tmp_path / "home")
    # In this order: the port may itself begin with 6000.
    text = (ROOT / page).read_text().replace("127.0.0.1:6000", "127.0.0.1:0").replace("8080", str(port))
    # Without a rig of its own, this page's twin has six cameras of 1440 x 928 pixels.
    rig = Path(quick_reader["XDG_DATA_HOME"]).with_name("rig.json")
    text = text.replace(
        "\nwildcity train augment lane ", f"\nwildcity twin drive lane --rig {rig}\nwildcity train augment lane "
    )
    blocks = [block for block in BLOCK.findall(text) if block[0] in ("sh", "python")]
    assert blocks, f"{page} has nothing to run"
    servers: list[subprocess.Popen[str]] = []
    try:
        if page == "README.md":
            servers.append(serve("wildcity serve", port, tmp_path, reader))
        for language, block in blocks:
            for part in parts(block) if language == "sh" else [block]:
                if language == "sh" and part.rstrip().endswith("&"):
                    servers.append(serve(part.rstrip(" &\n"), port, tmp_path, reader))
                elif language == "sh":
                    run(["bash", "-euo", "pipefail", "-c", part], tmp_path, reader)
                else:
                    run([sys.executable, "-c", part], tmp_path, reader)
    finally:
        for server in servers:
            server.terminate()
            server.communicate(timeout=30)


def parts(block: str) -> Iterator[str]:
    """A block as scripts; a line that starts a server is a script of its own."""
    script = ""
    for line in block.splitlines(keepends=True):
        if line.rstrip().endswith(" &"):
            if script.strip():
                yield script
            yield line
            script = ""
        else:
            script += line
    if script.strip():
        yield script


def serve(command: str, port: int, folder: Path, environment: dict[str, str]) -> subprocess.Popen[str]:
    """Starts a server on a port that nothing else has, and waits until it listens."""
    words = [*shlex.split(command), "--listen", f"127.0.0.1:{port}"]
    server = subprocess.Popen(words, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    line = server.stdout.readline()
    assert "listening" in line, f"{command} said {line!r}"
    return server


def run(command: list[str], folder: Path, environment: dict[str, str]) -> None:
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{command[-1]}\n{done.stdout}\n{done.stderr}"


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
        return port


def test_the_demo_suite_tells_drivers_apart(quick_reader: dict[str, str], tmp_path: Path) -> None:
    street = ROOT / "scenes" / "suites" / "street"
    suite = street / "suite.json"
    # These drivers do not look at images.
    small = tmp_path / "street" / "suite.json"
    shutil.copytree(street, small.parent)
    small.write_text(json.dumps({**json.loads(suite.read_text()), "size": [32, 20]}))
    run(["wildcity", "actor", "generate"], tmp_path, quick_reader)

    def drive(agent: str, code: int, *options: str, suite: Path = small) -> dict[str, list[str]]:
        """The faults of each episode of the suite."""
        out = tmp_path / "-".join([agent, *options])
        command = ["wildcity", "episode", "run", str(suite), "--agent", agent, "--out", str(out)]
        done = subprocess.run([*command, *options], env=quick_reader, capture_output=True, text=True)
        assert done.returncode == code, f"{done.stdout}\n{done.stderr}"
        episodes = json.loads((out / "result.json").read_text())["episodes"]
        return {one["name"]: [fault["fault"] for fault in one["faults"]] for one in episodes}

    bare = drive("log", 0, "--bare", "--jobs", "2", suite=suite)
    assert not any(bare.values()), "each scenario can be passed"
    for jobs in ("1", "2", "8"):
        assert drive("idm", 0, "--jobs", jobs) == bare
    assert all("progress" in faults for faults in drive("stand", 1).values())
    blind = drive("log", 1)
    walkers = {name for name in blind if name.startswith("pedestrian")}
    assert walkers == {name for name, faults in blind.items() if faults}
    assert all(blind[name][0] == "contact.pedestrian" for name in walkers)
    report = (tmp_path / "log" / "report.html").read_text()
    assert report.count("data:image/jpeg;base64,") == len(walkers)
    results = [tmp_path / f"idm---jobs-{jobs}" / "result.json" for jobs in (1, 2, 8)]
    assert len({result.read_bytes() for result in results}) == 1


def test_a_page_that_says_something_else_fails(quick_reader: dict[str, str], tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="no-such-twin"):
        run(["bash", "-euc", "wildcity twin show no-such-twin"], tmp_path, quick_reader)
