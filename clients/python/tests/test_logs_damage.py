"""Damaged sources: each converter ends with a log or with a named error, whatever a file has.

Each round damages one file of a miniature source: a value of its JSON, a word of its text, or its bytes. A run of an
hour: `DAMAGE_SECONDS=3600 DAMAGE_SEED=7 pytest tests/test_logs_damage.py`.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import test_logs_inria
import test_logs_kitti
import test_logs_ncore
import test_logs_nuplan
import test_logs_nurec
import test_logs_nuscenes
import test_logs_pandaset
import test_logs_zod
from wildcity.logs import LogError, Options, convert

NAN, INFINITE = float("nan"), float("inf")
VALUES: list[Any] = [None, True, -1, 0, 1e308, NAN, INFINITE, "", "text", [], {}, [1, 2], 10**30, -(10**15)]

MAKERS: dict[str, Callable[[Path, pytest.MonkeyPatch], Path]] = {
    "nuscenes": lambda root, _: test_logs_nuscenes.make(root).root,
    "pandaset": lambda root, _: test_logs_pandaset.make(root),
    "zod": lambda root, _: test_logs_zod.make(root),
    "inria": lambda root, _: test_logs_inria.make(root),
    "nurec": lambda root, _: nurec(root),
    "kitti": lambda root, _: test_logs_kitti.kitti(root, "sync").parent,
    "kitti360": lambda root, _: test_logs_kitti.kitti360(root),
    "nuplan": test_logs_nuplan.make,
    "ncore": lambda root, _: test_logs_ncore.make(root, test_logs_ncore.write_folder, ".zarr"),
}


def nurec(root: Path) -> Path:
    root.mkdir(parents=True)
    return test_logs_nurec.write(root / "scene.usdz", test_logs_nurec.documents())


def places(value: Any) -> list[tuple[Any, Any]]:
    """Each container of a value with each of its keys."""
    found: list[tuple[Any, Any]] = []
    if isinstance(value, dict | list):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            found += [(value, key), *places(value[key])]
    return found


def damage(path: Path, chance: random.Random) -> None:
    data = path.read_bytes()
    try:
        found = json.loads(data)
    except ValueError:
        found = None
    if places(found):
        inside, key = chance.choice(places(found))
        if chance.random() < 0.3:
            del inside[key]
        else:
            inside[key] = chance.choice(VALUES)
        path.write_text(json.dumps(found))
    elif path.suffix in (".txt", ".xml", ".yaml"):
        words = data.decode().split(" ")
        words[chance.randrange(len(words))] = chance.choice(["", "nan", "-1", "1e999", "word", "0", "9" * 20])
        path.write_text(" ".join(words))
    else:
        cut = bytearray(data[: chance.randrange(len(data) + 1)] if chance.random() < 0.3 else data)
        for _ in range(chance.randrange(1, 5)):
            if cut:
                cut[chance.randrange(len(cut))] = chance.randrange(256)
        path.write_bytes(bytes(cut))


@pytest.mark.parametrize("kind", MAKERS)
def test_damaged_sources_end_in_a_log_or_a_named_error(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seed = int(os.environ.get("DAMAGE_SEED", "1"))
    seconds = float(os.environ.get("DAMAGE_SECONDS", "20")) / len(MAKERS)
    whole = MAKERS[kind](tmp_path / "whole", monkeypatch)
    inside = whole.relative_to(tmp_path / "whole") if whole != tmp_path / "whole" else Path()
    files = sorted(path for path in (tmp_path / "whole").rglob("*") if path.is_file())
    # Images are copied as they are.
    files = [path for path in files if path.suffix not in (".jpg", ".png")]
    options = Options(rate=10.0, log="scene-0000" if kind == "nuscenes" else None)
    end, rounds, refused = time.monotonic() + seconds, 0, 0
    while time.monotonic() < end:
        chance = random.Random(f"{kind} {seed} {rounds}")
        root = tmp_path / "damaged"
        shutil.copytree(tmp_path / "whole", root)
        path = root / chance.choice(files).relative_to(tmp_path / "whole")
        damage(path, chance)
        out = tmp_path / "out"
        try:
            convert(root / inside, out, options, kind)
            assert out.is_dir()
        except LogError as error:
            refused += 1
            assert not out.exists() and error.place and error.problem and error.fix
        except Exception as error:
            raise AssertionError(f"{kind}, seed {seed}, round {rounds}: {path.relative_to(root)}: {error!r}") from error
        for folder in (root, out, out.with_name("out.partial")):
            shutil.rmtree(folder, ignore_errors=True)
        rounds += 1
    capsys.readouterr()
    assert rounds > 0 and (refused > 0 or rounds < 20)
