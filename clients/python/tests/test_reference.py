"""The pages of docs/reference that the program generates, and the types that follow from the schemas."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
GENERATE = ROOT / "docs" / "generate.py"


def test_the_pages_are_as_the_program_generates_them() -> None:
    command = [
        sys.executable,
        "-B",
        str(GENERATE),
        "--check",
        "--wildcity",
        os.environ["WILDCITY_BIN"],
        "commands",
        "metrics",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_the_types_and_the_blocking_client_are_as_generated() -> None:
    command = [sys.executable, "-B", str(ROOT / "clients" / "generate.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
