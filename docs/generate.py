#!/usr/bin/env python3
"""Writes the pages that follow from other files and from the program.

    docs/generate.py [PAGES]...                       (writes them)
    docs/generate.py --check [PAGES]...               (fails if one differs)
    docs/generate.py --wildcity target/debug/wildcity (also pages that ask the program)

PAGES are `benchmarks` (BENCHMARKS.md, from docs/benchmarks), `protocol` (docs/reference/protocol, from
protocol/schema, protocol/openapi.json and protocol/vectors), `summary` (the lists of those pages in docs/SUMMARY.md),
and, with `--wildcity`, `commands` (docs/reference/commands, from the help of the program) and `metrics`
(docs/reference/metrics.md, from a running server).
"""

from __future__ import annotations

import argparse
import difflib
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))

from generator import benchmarks, commands, metrics, protocol, summary  # noqa: E402

Pages = dict[str, str]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, and fail if a page differs")
    parser.add_argument("--wildcity", type=Path, help="the program")
    parser.add_argument("pages", nargs="*", help="what to write [default: all that can be written]")
    arguments = parser.parse_args()
    writers = {"benchmarks": benchmarks.pages, "protocol": protocol.pages}
    if arguments.wildcity:
        program = arguments.wildcity.resolve()
        writers["commands"] = lambda root: commands.pages(root, program)
        writers["metrics"] = lambda root: metrics.pages(root, program)
    writers["summary"] = summary.pages
    differ: list[str] = []
    for name in arguments.pages or writers:
        if name not in writers:
            parser.error(f"{name} is none of {', '.join(writers)}, or needs --wildcity")
        pages, folder = writers[name](ROOT)
        differ += apply(pages, folder, arguments.check)
    if differ:
        print(f"{', '.join(differ)}: not as generated; run docs/generate.py and commit the result", file=sys.stderr)
        sys.exit(1)


def apply(pages: Pages, folder: str | None, check: bool) -> list[str]:
    """Writes pages, and removes other pages of their folder. With `check`, the names of those that would change."""
    differ = []
    old = {str(path.relative_to(ROOT)) for path in (ROOT / folder).glob("*.md")} if folder else set()
    for name in sorted(old - pages.keys()):
        differ.append(name)
        if not check:
            (ROOT / name).unlink()
    for name, text in pages.items():
        path = ROOT / name
        before = path.read_text() if path.exists() else ""
        if before == text:
            continue
        differ.append(name)
        if check:
            lines = difflib.unified_diff(before.splitlines(), text.splitlines(), name, "generated", lineterm="", n=1)
            print("\n".join(list(lines)[:40]), file=sys.stderr)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    return differ if check else []


if __name__ == "__main__":
    main()
