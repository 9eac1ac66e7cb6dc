"""docs/reference/commands from the help of the programs: one page for each command, and one for `wildcity-bench`."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
from pathlib import Path

FOLDER = "docs/reference/commands"
HEAD = "<!-- Written by docs/generate.py from the help of the program. -->\n\n"
GROUP = re.compile(r"^([A-Z][a-z ]+):\n((?:  .+\n)+)", re.MULTILINE)
LISTED = re.compile(r"^  ([a-z][a-z0-9-]*)  +(\S.*)$")


def pages(root: Path, program: Path) -> tuple[dict[str, str], str]:
    top = help_of(program, [])
    index = f"{HEAD}# Commands\n\nThe pages have what `--help-all` prints.\n"
    written = {}
    for heading, section in GROUP.findall(top.partition("\nOptions:\n")[0]):
        index += f"\n## {heading}\n\n| command | |\n|---|---|\n"
        for name, summary in listed(section):
            index += f"| [`{name}`]({name}.md) | {summary} |\n"
            written[f"{FOLDER}/{name}.md"] = HEAD + page(program, [name]).rstrip() + "\n"
    bench = program.with_name("wildcity-bench")
    written[f"{FOLDER}/wildcity-bench.md"] = HEAD + page(bench, []).rstrip() + "\n"
    index += "\n[`wildcity-bench`](wildcity-bench.md) is a program of its own, which releases do not have.\n"
    written[f"{FOLDER}/index.md"] = index
    return written, FOLDER


def page(program: Path, path: list[str]) -> str:
    text = help_of(program, path)
    level = "#" * min(max(len(path), 1), 4)
    name = " ".join([program.name, *path])
    written = f"{level} {name}\n\n```text\n{text}```\n\n"
    for name, _ in listed(text.partition("\nCommands:\n")[2].partition("\n\n")[0]):
        written += page(program, [*path, name])
    return written


def help_of(program: Path, path: list[str]) -> str:
    """What `--help-all` prints where there is no terminal: all options, in lines of 100 columns."""
    if not program.exists():
        raise SystemExit(f"{program} is missing: cargo build --workspace --features full")
    with tempfile.TemporaryDirectory() as home:
        environment = {"PATH": os.environ["PATH"], "HOME": home, "NO_COLOR": "1"}
        done = subprocess.run(
            [program.name, *path, "--help-all"],
            executable=program,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
        if done.returncode != 0 or home in done.stdout:
            raise SystemExit(
                f"{program} {' '.join(path)} --help-all ends with {done.returncode}:\n{done.stdout}{done.stderr}"
            )
    return "\n".join(line.rstrip() for line in done.stdout.strip().splitlines()) + "\n"


def listed(section: str) -> list[tuple[str, str]]:
    """Names and summaries of the commands in a section of the help, without `help`."""
    found: list[tuple[str, str]] = []
    for line in section.splitlines():
        if listed := LISTED.match(line):
            found.append((listed[1], listed[2]))
        elif found:
            found[-1] = (found[-1][0], f"{found[-1][1]} {line.strip()}")
    return [one for one in found if one[0] != "help"]
