"""A scene of many files as one archive: a push has at most 256 files, and a streamed SOG has nine for each block."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DESCRIPTION_BYTES = 64 << 20
"""Largest size of a description, in bytes: the limit of the server."""

METAS = ("lod-meta.json", "meta.json")
"""Files that describe a SOG; the first describes a streamed SOG."""


@contextlib.contextmanager
def packed(path: Path, is_only: bool) -> Iterator[Path]:
    """An archive of the SOG in a folder, if `path` is a folder, or the only file of a push and describes a SOG;
    otherwise the path itself. The same files give the same bytes, so that an upload continues where it stopped.

    Raises `ValueError` if the folder has no SOG, or a description in it cannot be understood.
    """
    if not path.is_dir() and not (is_only and path.name in METAS):
        yield path
        return
    folder, meta = path.parent, path.name
    if path.is_dir():
        found = [meta for meta in METAS if (path / meta).is_file()]
        if not found:
            known = " or ".join(METAS)
            raise ValueError(f"{path} is a folder without {known}: give a scene file, and the files that it names")
        folder, meta = path, found[0]
    names = _named_files(folder, meta)
    with tempfile.TemporaryDirectory() as temporary:
        archive = Path(temporary) / f"{folder.resolve().name}.zip"
        with zipfile.ZipFile(archive, "w") as written:
            for name in sorted(names):
                # Without a time of the file system. The images are compressed already.
                entry = zipfile.ZipInfo(name)
                entry.file_size = (folder / name).stat().st_size
                with (folder / name).open("rb") as file, written.open(entry, "w") as out:
                    shutil.copyfileobj(file, out)
        yield archive


def _named_files(folder: Path, meta: str) -> set[str]:
    """The description and the files that it names, and those that these name, relative to the folder.

    Named files that do not exist are left out: a server needs only the finest blocks, and reports which it misses.
    """
    names = {meta}
    unread = [meta]
    while unread:
        name = unread.pop()
        if (folder / name).stat().st_size > DESCRIPTION_BYTES:
            raise ValueError(f"{folder / name} has more than {DESCRIPTION_BYTES} bytes")
        try:
            blocks, images = _files_of(json.loads((folder / name).read_bytes()))
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise ValueError(f"{folder / name} is no description of a SOG: {error}") from error
        beside = name[: name.rfind("/") + 1]
        for named in blocks + images:
            path = beside + named
            if not _is_below(named):
                raise ValueError(f"{folder / name} names {named!r}, which is not below its folder")
            if not (folder / path).resolve().is_relative_to(folder.resolve()):
                raise ValueError(f"{folder / name} names {named!r}, a link that leads out of the folder")
            if path not in names and (folder / path).is_file():
                names.add(path)
                if named in blocks:
                    unread.append(path)
    return names


def _files_of(description: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Names of the blocks of a streamed scene, and of images."""
    environment = description.get("environment")
    blocks = [*description.get("filenames", []), *([environment] if environment else [])]
    parts = [description.get(part) for part in ("means", "scales", "quats", "sh0", "shN")]
    images = [name for part in parts if part for name in part["files"]]
    if not all(isinstance(name, str) for name in blocks + images):
        raise TypeError("names of files are texts")
    return blocks, images


def _is_below(name: str) -> bool:
    """Whether a name leads to a file below the folder that it is relative to."""
    return all(step not in ("", ".", "..") for step in name.split("/")) and not any(c in name for c in "\\\0")
