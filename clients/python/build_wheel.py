"""Builds a wheel of the Python client that carries the server program.

    pip install cargo-zigbuild ziglang
    cargo zigbuild --release --locked --features full,otlp --target x86_64-unknown-linux-gnu.2.28
    python clients/python/build_wheel.py --binary target/x86_64-unknown-linux-gnu/release/wildcity --out dist --glibc 28

`pip install` of the wheel puts the program `wildcity` beside `python`. The wheel has no compiled Python, so that one
per platform serves every Python version. Zig links against the glibc that the target names, so that the wheel is
`manylinux_2_28`; a program of `cargo build` needs the glibc of its own machine. Needs pip, setuptools from its index,
and cargo, which lists the crates whose licences are in the wheel.
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

import third_party

CLIENT = Path(__file__).resolve().parent
ROOT = CLIENT.parents[1]
LICENCES = ("LICENSE-APACHE", "LICENSE-MIT", "NOTICE")
EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of every entry, so that the same input makes the same wheel."""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", type=Path, required=True, help="the program, built as above")
    parser.add_argument("--out", type=Path, default=Path("dist"), help="directory for the wheel")
    parser.add_argument("--features", default="full,otlp", help="features that the program was built with")
    parser.add_argument(
        "--glibc", type=int, metavar="MINOR", help="refuse a program that needs a newer glibc than 2.MINOR"
    )
    parser.add_argument(
        "--repository", metavar="URL", help="where links of the description lead, as URL/blob/vX.Y.Z/FILE"
    )
    chosen = parser.parse_args(arguments)
    try:
        wheel = build(chosen.binary, chosen.out, chosen.features, chosen.glibc, chosen.repository)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(wheel)
    return 0


def build(
    binary: Path, out: Path, features: str = "full,otlp", glibc: int | None = None, repository: str | None = None
) -> Path:
    """Writes the wheel, and returns its path.

    Raises `ValueError` if program and client have different versions, the program needs a newer glibc than 2.`glibc`,
    or a crate has no licence.
    """
    program = binary.read_bytes()
    tag = f"py3-none-{platform_tag(program, glibc)}"
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
    texts = {name: (ROOT / name).read_text() for name in LICENCES} | {"THIRD-PARTY": third_party.licences(features)}
    entries |= {f"{info}/licenses/{name}": text.encode() for name, text in texts.items()}
    metadata = f"{info}/METADATA"
    described = with_licences(entries[metadata].decode(), list(texts))
    entries[metadata] = with_absolute_links(described, repository, version).encode()
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


def with_licences(metadata: str, names: list[str]) -> str:
    """Metadata that name the files of the licences (PEP 639)."""
    head, separator, body = metadata.partition("\n\n")
    kept = [line for line in head.splitlines() if not line.startswith("License-File:")]
    return "\n".join([*kept, *(f"License-File: {name}" for name in names)]) + separator + body


def with_absolute_links(metadata: str, repository: str | None, version: str) -> str:
    """Metadata whose description has no links to files beside it, which an index does not have.

    They lead to the files of this version in the repository; without one, only their text stays.
    """

    def absolute(link: re.Match[str]) -> str:
        text, target = link.groups()
        if re.match(r"[a-z]+:|#", target):
            return link[0]
        path, hash_, place = target.partition("#")
        file = (CLIENT / path).resolve().relative_to(ROOT)
        if not (ROOT / file).exists():
            raise ValueError(f"README.md has a link to {target}, which does not exist")
        return f"[{text}]({repository.rstrip('/')}/blob/v{version}/{file}{hash_}{place})" if repository else text

    head, separator, body = metadata.partition("\n\n")
    return head + separator + re.sub(r"\[([^\]]*)\]\(([^)\s]+)\)", absolute, body)


def platform_tag(program: bytes, most: int | None = None) -> str:
    """The platforms that the program runs on. On Linux the newest glibc symbol that it names decides (PEP 600)."""
    if sys.platform != "linux":
        return sysconfig.get_platform().replace("-", "_").replace(".", "_")
    named = [int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)\0", program)]
    if not named:
        raise ValueError("the program names no glibc; wheels need one that was built for *-linux-gnu")
    if most is not None and max(named) > most:
        raise ValueError(
            f"the program needs glibc 2.{max(named)}, and the wheel is for 2.{most}: build it with `cargo zigbuild "
            f"--target {platform.machine()}-unknown-linux-gnu.2.{most}`"
        )
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
