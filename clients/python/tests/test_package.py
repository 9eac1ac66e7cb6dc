"""The package as it is published: its version, its metadata, and a wheel that carries the program."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import venv
import zipfile
import zlib
from pathlib import Path
from typing import Any

import pytest

CLIENT = Path(__file__).resolve().parents[1]
ROOT = CLIENT.parents[1]
sys.path.insert(0, str(CLIENT))

import build_wheel  # noqa: E402
import third_party  # noqa: E402


def field(file: Path, name: str) -> str:
    """The first `name = "..."` of a TOML file; Python 3.10 has no TOML reader."""
    found = re.search(rf'^{name} = "(.*)"$', file.read_text(), re.MULTILINE)
    assert found, f"{file} has no {name}"
    return found[1]


def test_the_version_is_that_of_the_crate() -> None:
    assert field(CLIENT / "pyproject.toml", "version") == field(ROOT / "Cargo.toml", "version")


@pytest.mark.parametrize("version", ["3.10", "3.14"])
def test_the_types_are_right_for_the_first_and_the_last_supported_python(version: str, tmp_path: Path) -> None:
    assert f'"Programming Language :: Python :: {version}"' in (CLIENT / "pyproject.toml").read_text()
    command = [sys.executable, "-m", "mypy", "--python-version", version, "--cache-dir", str(tmp_path)]
    # Without the packages around it: numpy's own types may need a newer Python than the client does.
    command += ["--no-site-packages", "--ignore-missing-imports", "--allow-subclassing-any", "--no-warn-return-any"]
    done = subprocess.run([*command, "src"], cwd=CLIENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_a_wheel_carries_the_program(reader: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Built here, installed in an empty environment, which has the program and the client then."""
    # The fastest one: the program is large, and the size of its wheel is not what is tested.
    monkeypatch.setattr(zlib, "Z_DEFAULT_COMPRESSION", zlib.Z_BEST_SPEED)
    binary = os.environ.get("WILDCITY_BIN")
    assert binary, "set WILDCITY_BIN to the built wildcity binary"
    wheel = build_wheel.build(Path(binary), tmp_path / "dist")
    assert re.fullmatch(r"wildcity-[\d.]+-py3-none-\w+\.whl", wheel.name)
    with zipfile.ZipFile(wheel) as archive:
        assert archive.testzip() is None
        assert "wildcity/py.typed" in archive.namelist()
        info = next(name.partition("/")[0] for name in archive.namelist() if ".dist-info/" in name)
        for name in ("LICENSE-APACHE", "LICENSE-MIT", "NOTICE"):
            assert archive.read(f"{info}/licenses/{name}") == (ROOT / name).read_bytes()
        others = archive.read(f"{info}/licenses/THIRD-PARTY").decode()
        metadata = archive.read(f"{info}/METADATA").decode()
    # A crate with a file of its licence, one without, and one of the tests, which is not in the program.
    assert "\nserde 1." in others and "\nmcap 0." in others and "Copyright (c) the authors of mcap" in others
    assert "\ntempfile-test" not in others and "\nrcgen " not in others
    assert "Permission is hereby granted" in others and "Apache License" in others
    assert metadata.count("License-File: ") == 4 and "License-File: THIRD-PARTY\n" in metadata
    assert "](../" not in metadata, "a link that leads nowhere"
    venv.create(tmp_path / "venv")
    bin_dir = tmp_path / "venv" / "bin"
    # By the pip of this environment, which need not be installed in that one first.
    pip = [sys.executable, "-m", "pip", "--python", bin_dir / "python"]
    run([*pip, "install", "--quiet", "--no-compile", wheel], tmp_path)
    environment = {"PATH": f"{bin_dir}:/usr/bin:/bin", "HOME": str(tmp_path)}
    # The twin that this program, at another place, has built.
    shutil.copytree(reader["XDG_DATA_HOME"], tmp_path / ".local" / "share")
    run(["wildcity", "demo", "--steps", "1"], tmp_path, environment)
    assert (tmp_path / "wildcity-demo" / "report.json").is_file()
    program = """
import wildcity
with wildcity.serve() as server, wildcity.connect(server.url) as client:
    assert server.process.args[0].startswith(%r), server.process.args
    print(client.open("demo").reset().images["front"].shape)
""" % str(bin_dir)
    assert run(["python", "-c", program], tmp_path, environment) == "(928, 1440, 3)\n"


def run(command: list[object], folder: Path, environment: dict[str, str] | None = None) -> str:
    words = [str(word) for word in command]
    path = environment["PATH"] if environment else None
    done = subprocess.run(
        ["env", f"PATH={path}", *words] if path else words,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_a_program_of_another_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    version, original = field(CLIENT / "pyproject.toml", "version"), subprocess.run

    def without_pip(command: list[Any], **options: Any) -> Any:
        if "--wheel-dir" not in command:
            return original(command, **options)
        # The other test has pip build it. Here its name is enough.
        folder = Path(command[command.index("--wheel-dir") + 1])
        return zipfile.ZipFile(folder / f"wildcity-{version}-py3-none-any.whl", "w").close()

    monkeypatch.setattr(subprocess, "run", without_pip)
    program = tmp_path / "wildcity"
    program.write_text("#!/bin/sh\necho wildcity 9.9.9\n# GLIBC_2.17\0\n")
    program.chmod(0o755)
    with pytest.raises(ValueError, match="is wildcity 9.9.9, the client is"):
        build_wheel.build(program, tmp_path / "dist")
    assert not (tmp_path / "dist").exists()


def test_links_of_the_description_lead_to_the_repository() -> None:
    metadata = (
        "Name: wildcity\n\nSee [the docs](../../docs/gym.md#reward), [this](README.md) and [web](https://a.example/b)."
    )
    absolute = build_wheel.with_absolute_links(metadata, "https://host.example/o/wildcity/", "1.2.3")
    at = "https://host.example/o/wildcity/blob/v1.2.3"
    assert absolute == (
        f"Name: wildcity\n\nSee [the docs]({at}/docs/gym.md#reward), [this]({at}/clients/python/README.md) "
        "and [web](https://a.example/b)."
    )
    assert build_wheel.with_absolute_links(metadata, None, "1.2.3").endswith(
        "See the docs, this and [web](https://a.example/b)."
    )
    with pytest.raises(ValueError, match=r"nowhere\.md, which does not exist"):
        build_wheel.with_absolute_links("\n\n[x](../../nowhere.md)", None, "1.2.3")


def test_a_crate_without_a_licence_is_refused(tmp_path: Path) -> None:
    crate = {
        "name": "odd",
        "version": "1.0.0",
        "license": "BSD-3-Clause",
        "manifest_path": str(tmp_path / "Cargo.toml"),
    }
    with pytest.raises(ValueError, match="odd has no file of its licence 'BSD-3-Clause'"):
        third_party.text_of([crate])
    (tmp_path / "LICENSES").mkdir()
    (tmp_path / "LICENSES" / "BSD.txt").write_text("Redistribution and use")
    assert third_party.text_of([crate]).endswith("odd 1.0.0:\n\nRedistribution and use\n")


def test_there_is_no_sdist(tmp_path: Path) -> None:
    program = f"import sys; sys.path.insert(0, {str(CLIENT)!r}); import build_backend; build_backend.build_sdist('.')"
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1 and "wildcity has no sdist" in done.stderr, done.stderr
    assert list(tmp_path.iterdir()) == []
    assert 'build-backend = "build_backend"' in (CLIENT / "pyproject.toml").read_text()


@pytest.mark.skipif(sys.platform != "linux", reason="glibc is of Linux")
def test_the_newest_glibc_symbol_gives_the_platform() -> None:
    tag = build_wheel.platform_tag(b"x GLIBC_2.9\0GLIBC_2.35\0GLIBC_2.17\0")
    assert tag.startswith("manylinux_2_35_")
    assert build_wheel.platform_tag(b"GLIBC_2.28\0", 28).startswith("manylinux_2_28_")
    with pytest.raises(
        ValueError, match=r"needs glibc 2\.29, and the wheel is for 2\.28: build it with `cargo zigbuild"
    ):
        build_wheel.platform_tag(b"GLIBC_2.29\0", 28)
    with pytest.raises(ValueError, match="names no glibc"):
        build_wheel.platform_tag(b"static")


def test_a_release_has_the_version_as_its_tag_and_a_section_of_the_changelog() -> None:
    version = field(CLIENT / "pyproject.toml", "version")
    notes = [sys.executable, str(ROOT / ".ci" / "release_notes.py")]
    done = subprocess.run([*notes, f"v{version}"], capture_output=True, text=True)
    assert done.returncode == 0 and "### " in done.stdout, done.stderr
    for tag in (version, f"v{version}.1", "v0.0.1"):
        assert subprocess.run([*notes, tag], capture_output=True).returncode == 1, tag
