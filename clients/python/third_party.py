"""The licences of the crates that the program `wildcity` is made of, as one text for a wheel."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
LICENCE_FILE = re.compile(r"(?i)(licen[cs]e|copying|copyright|notice|unlicense)")


def licences(features: str) -> str:
    """All crates with their licences, and each text once. Raises `ValueError` for a crate without a licence."""
    command = ["cargo", "metadata", "--locked", "--format-version", "1", "--features", features]
    command += ["--filter-platform", host()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        raise ValueError(f"cargo metadata: {done.stderr.strip()}")
    return text_of(list(linked(json.loads(done.stdout))))


def host() -> str:
    said = subprocess.run(["rustc", "-vV"], capture_output=True, text=True, check=True).stdout
    found = re.search(r"^host: (.+)$", said, re.MULTILINE)
    if not found:
        raise ValueError(f"rustc -vV names no host: {said!r}")
    return found[1]


def linked(metadata: Any) -> Iterator[Any]:
    """The crates of others that are linked into the program: not those of its tests, and of build scripts alone."""
    packages = {package["id"]: package for package in metadata["packages"]}
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    waiting = [metadata["resolve"]["root"]]
    found = set(waiting)
    while waiting:
        for dependency in nodes[waiting.pop()]["deps"]:
            is_linked = any(kind["kind"] is None for kind in dependency["dep_kinds"])
            if is_linked and dependency["pkg"] not in found:
                found.add(dependency["pkg"])
                waiting.append(dependency["pkg"])
    ours = (packages[one] for one in found if packages[one]["source"] is not None)
    yield from sorted(ours, key=lambda package: (package["name"], package["version"]))


def text_of(crates: list[Any]) -> str:
    texts: dict[str, list[str]] = {}
    table = ["The program `wildcity` contains these packages. Their texts follow.", ""]
    for crate in crates:
        name = f"{crate['name']} {crate['version']}"
        expression = crate["license"] or "see its text"
        table.append(f"{name}: {expression}")
        for text in files_of(crate):
            texts.setdefault(text.strip(), []).append(name)
    parts = ["\n".join(table)]
    parts += [f"{', '.join(names)}:\n\n{text}" for text, names in texts.items()]
    return f"\n\n{'-' * 80}\n\n".join(parts) + "\n"


def files_of(crate: Any) -> list[str]:
    """The texts of a crate's licences: its files, or the text of the licence that it names."""
    folder = Path(crate["manifest_path"]).parent
    named = [path for path in sorted(folder.iterdir()) if LICENCE_FILE.match(path.name)]
    files = [path for path in named if path.is_file()]
    files += [path for one in named if one.is_dir() for path in sorted(one.rglob("*")) if path.is_file()]
    if files:
        return [path.read_text(errors="replace") for path in files]
    expression = crate["license"] or ""
    if "Apache-2.0" in expression:
        return [(ROOT / "LICENSE-APACHE").read_text()]
    if "MIT" in expression:
        # Ours from its second paragraph on: the first is our copyright.
        ours = (ROOT / "LICENSE-MIT").read_text()
        terms = ours[ours.index("Permission is hereby granted") :]
        return [f"Copyright (c) the authors of {crate['name']}\n\n{terms}"]
    raise ValueError(f"the crate {crate['name']} has no file of its licence {expression!r}: add its text here")
