"""Mutation testing: applies one mutation to each of many copies of a package's source, and reports which test detects
it.

A copy is a module of the package's test binary, with the tests that use it, so that one build serves all of them. At
the end, the copies are removed and the binary's main.rs is restored.
"""

import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]


class Fault(NamedTuple):
    """`old` becomes `new` where it first stands in `file` of the package."""

    file: str
    old: str
    new: str


class Copy(NamedTuple):
    """The files of a copy, by their paths below `mutant/`, and the source of its tests."""

    files: dict[str, str]
    tests: str


def source(path: str) -> str:
    return (ROOT / path).read_text()


def planted(text: str, fault: Fault) -> str:
    assert fault.old in text, f"{fault.file} has no {fault.old!r}: the list of mutations is out of date"
    return text.replace(fault.old, fault.new, 1)


def run(package: str, faults: list[Fault], copies: list[Copy]) -> int:
    """Writes the copies, builds and runs their tests, and prints a line for each fault. Returns the exit code."""
    folder = ROOT / "tests" / package / "planted"
    main = ROOT / "tests" / package / "main.rs"
    whole = main.read_text()
    shutil.rmtree(folder, ignore_errors=True)
    try:
        for index, copy in enumerate(copies):
            for path, text in copy.files.items():
                file = folder / f"m{index:03}" / "mutant" / path
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text)
            (folder / f"m{index:03}" / "tests.rs").write_text(copy.tests)
            (folder / f"m{index:03}" / "mod.rs").write_text("pub mod mutant;\nmod tests;\n")
        modules = "".join(f"mod m{index:03};\n" for index in range(len(copies)))
        (folder / "mod.rs").write_text(f"#![allow(warnings)]\n{modules}")
        main.write_text(f"{whole}mod planted;\n")
        cargo = os.environ.get("CARGO", "cargo")
        command = [cargo, "test", "-p", f"wildcity-{package}", "--test", package]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    finally:
        main.write_text(whole)
        shutil.rmtree(folder, ignore_errors=True)
    return report(faults, done.stdout + done.stderr)


def chosen(faults: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """The mutations of the files that the command line names; all if it names none."""
    names = sys.argv[1:]
    unknown = [name for name in names if all(fault[0] != name for fault in faults)]
    if unknown:
        sys.exit(f"no faults are listed for {', '.join(unknown)}")
    return [fault for fault in faults if not names or fault[0] in names]


def report(faults: list[Fault], output: str) -> int:
    ran = set()
    failed = defaultdict(list)
    # Tests of a copy: those next to it, and those in its own files.
    pattern = r"^test planted::m(\d+)::(?:mutant::(?:\w+::)*?)?tests::(\S+) \.\.\. (\w+)"
    for index, test, result in re.findall(pattern, output, re.MULTILINE):
        ran.add(int(index))
        if result == "FAILED":
            failed[int(index)].append(test)
    if ran != set(range(len(faults))):
        print(output[-4000:], file=sys.stderr)
        print(f"only {len(ran)} of {len(faults)} copies were tested", file=sys.stderr)
        return 2
    without = re.findall(r"^test ((?!planted::)\S+) \.\.\. FAILED", output, re.MULTILINE)
    if without:
        print(f"these fail without a fault: {', '.join(without)}", file=sys.stderr)
        return 2
    said = dict(re.findall(r"---- planted::(m\d+::tests::\S+) stdout ----\n\n.*?\n(.*?)\n", output))
    for index, fault in enumerate(faults):
        tests = failed[index]
        change = f"{fault.file}: {' '.join(fault.old.split())} -> {' '.join(fault.new.split())}"
        first = said.get(f"m{index:03}::tests::{tests[0]}", "") if tests else ""
        print(f"{', '.join(tests) or 'NOT NOTICED'} | {change[:110]} | {first[:90]}")
    unnoticed = [index for index in range(len(faults)) if not failed[index]]
    print(f"{len(faults) - len(unnoticed)} of {len(faults)} faults are noticed")
    return 1 if unnoticed else 0
