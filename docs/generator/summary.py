"""The pages of commands in docs/SUMMARY.md: the lines below the one that links to their index."""

from __future__ import annotations

import re
from pathlib import Path

INDEX = "](reference/commands/index.md)\n"
PAGE = re.compile(r"^ +- \[`[^`]*`\]\(reference/commands/[^)]*\)\n", re.MULTILINE)


def pages(root: Path) -> tuple[dict[str, str], None]:
    text = PAGE.sub("", (root / "docs" / "SUMMARY.md").read_text())
    before, index, after = text.partition(INDEX)
    if not index:
        raise SystemExit("docs/SUMMARY.md does not link to reference/commands/index.md")
    indent = " " * (len(before.rpartition("\n")[2]) - len(before.rpartition("\n")[2].lstrip()) + 2)
    names = sorted(path.stem for path in (root / "docs" / "reference" / "commands").glob("*.md"))
    lines = "".join(f"{indent}- [`{name}`](reference/commands/{name}.md)\n" for name in names if name != "index")
    return {"docs/SUMMARY.md": before + index + lines + after}, None
