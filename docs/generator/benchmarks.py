"""BENCHMARKS.md from docs/benchmarks: index.json has the machines and the order, every other file one run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

HEAD = """# Benchmarks

Run times and errors, one table per question, written by `docs/generate.py` from `docs/benchmarks`. Several figures in a
cell are repeated runs. On a loaded machine only ratios count. PSNR is against the named reference; higher is closer.

"""


def pages(root: Path) -> tuple[dict[str, str], None]:
    folder = root / "docs" / "benchmarks"
    index = json.loads((folder / "index.json").read_text())
    listed = set(index["runs"]) | {"index"}
    if found := {path.stem for path in folder.glob("*.json")} ^ listed:
        raise SystemExit(f"docs/benchmarks/index.json and the files beside it differ: {sorted(found)}")
    machines: dict[str, str] = index["machines"]
    text = HEAD + table(["machine", ""], [[name, what] for name, what in machines.items()])
    for name in index["runs"]:
        text += section(name, json.loads((folder / f"{name}.json").read_text()), machines)
    return {"BENCHMARKS.md": text}, None


def section(name: str, run: dict[str, Any], machines: dict[str, str]) -> str:
    if wrong := {"title", "question", "machine", "load", "date", "command", "columns", "rows"} - run.keys():
        raise SystemExit(f"docs/benchmarks/{name}.json lacks {sorted(wrong)}")
    if run["machine"] != "any" and run["machine"] not in machines:
        raise SystemExit(f"docs/benchmarks/{name}.json: no machine {run['machine']} in index.json")
    if any(len(row) != len(run["columns"]) for row in run["rows"]):
        raise SystemExit(f"docs/benchmarks/{name}.json: a row has more or fewer cells than columns")
    on = "Any machine" if run["machine"] == "any" else f"Machine {run['machine']}"
    text = f"\n## {run['title']}\n\n{run['question']} {on} ({run['load']}), {run['date']}: `{run['command']}`\n\n"
    text += table(run["columns"], run["rows"])
    if notes := run.get("notes"):
        text += f"\n{notes}\n"
    return text


def table(columns: list[str], rows: list[list[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" if cells[0] != "---" else f"|{'|'.join(cells)}|\n" for cells in lines)
