#!/usr/bin/env python3
"""Checks a tag, and prints the text of its release.

    .ci/release_notes.py v0.2.0

The tag is `v` and the version of Cargo.toml, and CHANGELOG.md has a section of this version with a date and a text.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    tag = sys.argv[1]
    found = re.search(r'^\[workspace\.package\]\nversion = "([^"]+)"$', (ROOT / "Cargo.toml").read_text(), re.MULTILINE)
    if not found:
        sys.exit("Cargo.toml has no version")
    version = found[1]
    if tag != f"v{version}":
        sys.exit(f"the tag is {tag}, and the version of Cargo.toml is {version}")
    section = rf"^## {re.escape(version)} - \d{{4}}-\d\d-\d\d\n(.*?)(?=^## |\Z)"
    notes = re.search(section, (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE | re.DOTALL)
    if not notes or not notes[1].strip():
        sys.exit(f"CHANGELOG.md has no section ## {version} - YYYY-MM-DD with a text")
    print(notes[1].strip())


if __name__ == "__main__":
    main()
