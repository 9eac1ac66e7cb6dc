#!/usr/bin/env python3
"""A preprocessor of mdbook: a page of docs/project, which is only a link to a document of the repository, becomes that
document. Links to such documents lead to their pages, and links to other files outside of docs/ become text."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")


def main() -> None:
    if sys.argv[1:2] == ["supports"]:
        return
    _, book = json.load(sys.stdin)
    chapters = list(walk(book.get("items") or book.get("sections")))
    pages = {}
    for chapter in chapters:
        if (chapter["path"] or "").startswith("project/"):
            link = LINK.search(chapter["content"])
            if link is None:
                sys.exit(f"docs/{chapter['path']} has no link to its document")
            pages[(DOCS / "project" / link[3]).resolve()] = chapter["path"]
    for chapter in chapters:
        if not chapter["path"]:
            continue
        source = next((source for source, path in pages.items() if path == chapter["path"]), DOCS / chapter["path"])
        text = chapter["content"] if source.is_relative_to(DOCS) else source.read_text()
        chapter["content"] = moved(text, source, chapter["path"], pages)
    json.dump(book, sys.stdout)


def walk(items: list[Any]) -> Any:
    for item in items:
        if isinstance(item, dict) and "Chapter" in item:
            yield item["Chapter"]
            yield from walk(item["Chapter"]["sub_items"])


def moved(text: str, source: Path, page: str, pages: dict[Path, str]) -> str:
    """The text of the document `source`, with its links as they are on `page`."""

    def link(found: re.Match[str]) -> str:
        mark, label, target = found.groups()
        file, hash_sign, anchor = target.partition("#")
        if "://" in target or not file:
            return found[0]
        at = (source.parent / file).resolve()
        if at in pages:
            to = DOCS / pages[at]
        elif at.is_relative_to(DOCS) and at.is_file():
            to = at
        else:
            return label
        return f"{mark}[{label}]({os.path.relpath(to, (DOCS / page).parent)}{hash_sign}{anchor})"

    return LINK.sub(link, text)


if __name__ == "__main__":
    main()
