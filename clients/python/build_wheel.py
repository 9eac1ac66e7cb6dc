"""Builds a wheel of the Python client that carries the server program.

    cargo build --release --features full,otlp
    python clients/python/build_wheel.py --binary target/release/wildcity --out dist

`pip install` of the wheel puts the program `wildcity` beside `python`. The wheel has no compiled Python, so that one
per platform serves every Python version. Needs pip, and setuptools from its index.
"""

from __future__ import annotations

import argparse
import base64
import csv
import hashlib
import io
import platform
import re
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from pathlib import Path

CLIENT = Path(__file__).resolve().parent
EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of every entry, so that the same input makes the same wheel."""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", type=Path, required=True, help="the program, built as above")
    parser.add_argument("--out", type=Path, default=Path("dist"), help="directory for the wheel")
    chosen = parser.parse_args(arguments)
    try:
        wheel = build(chosen.binary, chosen.out)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(wheel)
    return 0


def build(binary: Path, out: Path) -> Path:
    """Writes the wheel, and returns its path. Raises `ValueError` if program and client have different versions."""
    program = binary.read_bytes()
    tag = f"py3-none-{platform_tag(program)}"
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, str(CLIENT)]
        subprocess.run(command, check=True)
        (pure,) = Path(folder).glob("wildcity-*.whl")
        _, version, *_ = pure.stem.split("-")
        check_version(binary, version)
        with zipfile.ZipFile(pure) as archive:
            entries = {name: archive.read(name) for name in archive.namelist()}
    info = f"wildcity-{version}.dist-info"
    script = f"wildcity-{version}.data/scripts/wildcity"
    entries[script] = program
    entries[f"{info}/WHEEL"] = retagged(entries[f"{info}/WHEEL"].decode(), tag).encode()
    record = f"{info}/RECORD"
    entries.pop(record)
    entries[record] = record_of(entries, record).encode()
    out.mkdir(parents=True, exist_ok=True)
    wheel = out / f"wildcity-{version}-{tag}.whl"
    part = wheel.with_suffix(".part")
    try:
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in entries.items():
                entry = zipfile.ZipInfo(name, EPOCH)
                entry.compress_type = zipfile.ZIP_DEFLATED
                mode = 0o755 if name == script else 0o644
                # A regular file, and its permissions.
                entry.external_attr = (0o100000 | mode) << 16
                archive.writestr(entry, content)
        part.replace(wheel)
    finally:
        part.unlink(missing_ok=True)
    return wheel


def check_version(binary: Path, version: str) -> None:
    """The client speaks the protocol of its own version's program."""
    said = subprocess.run([binary, "--version"], capture_output=True, text=True, check=True).stdout.split()
    if said != ["wildcity", version]:
        raise ValueError(f"{binary} is {' '.join(said)}, the client is {version}: build both from the same commit")


def platform_tag(program: bytes) -> str:
    """The platforms that the program runs on. On Linux the newest glibc symbol that it names decides (PEP 600)."""
    if sys.platform != "linux":
        return sysconfig.get_platform().replace("-", "_").replace(".", "_")
    named = [int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)\0", program)]
    if not named:
        raise ValueError("the program names no glibc; wheels need one that was built for *-linux-gnu")
    return f"manylinux_2_{max(named)}_{platform.machine()}"


def retagged(wheel: str, tag: str) -> str:
    lines = []
    for line in wheel.splitlines():
        key = line.partition(":")[0]
        if key not in ("Tag", "Root-Is-Purelib") and line:
            lines.append(line)
    return "\n".join([*lines, "Root-Is-Purelib: false", f"Tag: {tag}", ""])


def record_of(entries: dict[str, bytes], record: str) -> str:
    """The list of files with their digests."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    for name, content in entries.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        rows.writerow([name, f"sha256={digest}", len(content)])
    rows.writerow([record, "", ""])
    return text.getvalue()


if __name__ == "__main__":
    sys.exit(main())
