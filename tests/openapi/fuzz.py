#!/usr/bin/env python3
"""Sends many requests that the OpenAPI document allows, and as many that it does not, to a server of its own.

    pip install schemathesis
    WILDCITY_BIN=target/release/wildcity tests/openapi/fuzz.py [EXAMPLES]

EXAMPLES is the most requests of one kind that each operation gets (default 100). A request that the document allows
must be answered with a status that the document lists for the operation; an answer must have the form that the document
says; no answer is a 500. It is not part of the gate.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path

# Beside what an operation lists: nothing of that name, no such right, and a server that is busy.
ALWAYS = {"401", "403", "404", "503"}
# What refuses a request that the document does not allow.
REFUSALS = {"400", "401", "403", "404", "405", "409", "413", "415", "422"}


def config(document: dict) -> str:
    """A file for schemathesis: the statuses that each operation may answer."""
    lines = []
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            listed = {status for status in operation["responses"] if status != "default"}
            lines += [
                "[[operations]]",
                f"include-name = {json.dumps(f'{method.upper()} {path}')}",
                "[operations.checks.positive_data_acceptance]",
                f"expected-statuses = {json.dumps(sorted(listed | ALWAYS))}",
                "[operations.checks.negative_data_rejection]",
                f"expected-statuses = {json.dumps(sorted(REFUSALS | {s for s in listed if s >= '400'}))}",
            ]
    return "\n".join(lines) + "\n"


def main() -> int:
    examples = sys.argv[1] if len(sys.argv) > 1 else "100"
    program = Path(os.environ.get("WILDCITY_BIN", "target/release/wildcity")).resolve()
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        environment = dict(os.environ)
        for name in ("DATA", "STATE", "CACHE"):
            environment[f"XDG_{name}_HOME"] = str(home / name.lower())
        demo = [program, "demo", "--steps", "1", "--out", home / "demo"]
        subprocess.run(demo, env=environment, check=True, stdout=subprocess.DEVNULL)
        serve = [program, "serve", "--listen", "127.0.0.1:0", "--backend", "cpu", "--log", "error"]
        server = subprocess.Popen(serve, env=environment, stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout
            address = server.stdout.readline().split("//")[1].split("/")[0]
            url = f"http://{address}/v1/openapi.json"
            with urllib.request.urlopen(url) as answer:
                document = json.load(answer)
            file = home / "schemathesis.toml"
            file.write_text(config(document))
            run = [Path(sys.executable).parent / "schemathesis", "--config-file", file, "run", url]
            run += ["--max-examples", examples, "--phases", "examples,coverage,fuzzing"]
            run += ["--checks", "all", "--exclude-checks", "ignored_auth", "--continue-on-failure"]
            run += ["--seed", os.environ.get("SEED", "1"), "--generation-database", "none"]
            return subprocess.run(run, cwd=home).returncode
        finally:
            server.terminate()
            server.wait()


if __name__ == "__main__":
    sys.exit(main())
