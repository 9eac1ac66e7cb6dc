"""A scene of many files as one archive: a push has at most 256 files, and a streamed SOG has nine for each block."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

METAS = ("lod-meta.json", "meta.json")
"""Files that describe a SOG; the first is that of a streamed one."""


@contextlib.contextmanager
def packed(path: Path, is_only: bool) -> Iterator[Path]:
    """An archive of the SOG in a folder, if `path` is a folder, or the only file of a push and describes a SOG;
    otherwise the path itself. The same files give the same bytes, so that an upload continues where it stopped.

    Raises `ValueError` if the folder has no SOG.
    """
    if not path.is_dir() and not (is_only and path.name in METAS):
        yield path
        return
    folder = path if path.is_dir() else path.parent
    if not any((folder / meta).is_file() for meta in METAS):
        metas = " or ".join(METAS)
        raise ValueError(f"{folder} is a folder without {metas}: give a scene file, and the files that it names")
    names = sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*") if _is_part(file))
    with tempfile.TemporaryDirectory() as temporary:
        archive = Path(temporary) / f"{folder.resolve().name}.zip"
        with zipfile.ZipFile(archive, "w") as written:
            for name in names:
                # Without a time of the file system. The images are compressed already.
                entry = zipfile.ZipInfo(name)
                entry.file_size = (folder / name).stat().st_size
                with (folder / name).open("rb") as file, written.open(entry, "w") as out:
                    shutil.copyfileobj(file, out)
        yield archive


def _is_part(path: Path) -> bool:
    return path.suffix in (".json", ".webp") and path.is_file()
