"""Requests over HTTP: pushes of trained scenes as new versions of a twin, rollbacks, recorded drives."""

from __future__ import annotations

import hashlib
import operator
import os
import time
import urllib.parse
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

from .errors import ConnectFailed, PushFailed, Refused
from .http_client import ATTEMPTS, RETRY_DELAY_S, HttpClient
from .messages import Code, Drive
from .packing import packed
from .protocol import decode

CHUNK_BYTES = 1 << 20
"""Bytes of a file that are read at a time."""
POLL_INTERVAL_S = 0.1
"""Time between two requests for the state of a push."""

State = Literal[
    "uploading",
    "queued",
    "ingesting",
    "validating",
    "committing",
    "prefetching",
    "ready",
    "refused",
    "failed",
]


@dataclass(frozen=True)
class PushProgress:
    """Progress of a push: `done` of `total` items within its state (bytes, Gaussians or views)."""

    state: State
    done: int
    total: int


@dataclass(frozen=True)
class Push:
    """A finished push: the new version, and what the server found in the files."""

    id: str
    twin: str
    version: int
    version_hash: str
    report: dict[str, Any]


def push(
    files: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    twin: str,
    server: str = "http://127.0.0.1:8080",
    token: str | None = None,
    axes: str | None = None,
    scale: float | None = None,
    frame: Literal["twin", "capture"] | None = None,
    cells: Literal["all"] | Sequence[tuple[int, int]] | None = None,
    base: int | None = None,
    record: Literal["f32", "h52", "q32", "q24"] | None = None,
    levels: bool = True,
    profile: Sequence[str] = (),
    note: str | None = None,
    min_psnr_db: float | None = None,
    drop_bad: bool = False,
    push_id: str | None = None,
    progress: Callable[[PushProgress], None] | None = None,
    timeout: float = 60.0,
) -> Push:
    """Uploads scene files, makes them the next version of a twin, and returns when that version is ready.

    files: one or more files, which are merged into one scene; or a folder with a SOG, or only its `meta.json` or
        `lod-meta.json`.
    twin: name of the twin; it is created if it does not exist.
    server: `http://HOST:PORT` or `https://HOST:PORT`.
    token: for a server that was started with tokens; the default is `$WILDCITY_TOKEN`.
    axes, scale: axis convention and metres per unit of the files, as in `wildcity import`. The default is the axes that
        a file records, or those with which the twin was imported.
    frame: "twin", which is the default, or "capture": the axes and the unit with which the capture was imported, before
        `wildcity twin align`. `report["frame"]` is the frame that was used; `report["aligned"]` is true if they differ.
    cells: the 64 m cells (x, y) to replace, or "all"; the default is those that contain Gaussians of the files.
    base: the version that the scene was trained from; cells that changed since then are not overwritten.
    record, levels, profile, note: storage format, levels of detail, changes of the render profile as
        `["near=0.2"]`, and a description for people, of up to 1,000 characters.
    min_psnr_db: refuse the push if a view along the twin's drives has a lower PSNR than this, in dB, or if no view
        shows anything.
    drop_bad: leave out Gaussians that cannot be drawn; otherwise the push is refused if there are any.
    push_id: id of the push; sending the same id again does not make a second version.
    progress: is called with every change of the progress.
    timeout: how long one HTTP answer may take, in seconds.

    An interrupted upload continues where it stopped. What of a file is not read is a warning of Python.

    Raises `PushFailed` if the scene is refused, `Refused` if a request is refused, and `ConnectFailed` if the
    server does not answer; `ValueError` if `cells` or a SOG cannot be understood, and `OSError` if a file cannot be
    read.
    """
    paths = [files] if isinstance(files, (str, os.PathLike)) else list(files)
    wanted_cells = _checked_cells(cells)
    http_client = HttpClient(server, token, timeout)
    report = progress or (lambda _: None)
    request: dict[str, Any] = {
        "id": push_id or uuid.uuid4().hex,
        "files": upload_all(http_client, paths, axes, scale, report),
        "levels": levels,
        "profile": list(profile),
    }
    if min_psnr_db is not None:
        request["golden"] = {"min_psnr_db": min_psnr_db}
    if drop_bad:
        request["drop_bad"] = True
    optional = {"frame": frame, "cells": wanted_cells, "base": base, "record": record, "note": note}
    request |= {name: value for name, value in optional.items() if value is not None}
    path = f"/v1/twins/{urllib.parse.quote(twin, safe='')}/pushes"
    # The request has an id, so the server carries it out once even if it is repeated after a lost answer.
    answer = http_client.json_with_retries("POST", path, request)
    repetitions = 0
    while True:
        counts = answer["progress"]
        report(PushProgress(answer["state"], counts["done"], counts["total"]))
        if answer["state"] in ("ready", "refused", "failed"):
            push = _finished_push(answer)
            for file in push.report.get("files", []):
                for warning in [*file.get("warnings", []), *file.get("assumed", [])]:
                    warnings.warn(f"{file['name']}: {warning}", stacklevel=2)
            if frame is None and push.report.get("aligned"):
                warnings.warn(
                    f"version {push.version} of twin {twin}: the twin was aligned, and the files were taken to be in "
                    'its axes. If they are in the axes of its capture, roll back and push with frame="capture"; with '
                    'frame="twin" there is no warning',
                    stacklevel=2,
                )
            return push
        time.sleep(POLL_INTERVAL_S)
        try:
            answer = http_client.json_with_retries("GET", f"{path}/{answer['id']}", None)
        except Refused as refused:
            # The server was restarted and has lost the push, but not the uploads.
            if refused.code != "unknown_push" or repetitions >= ATTEMPTS:
                raise
            repetitions += 1
            answer = http_client.json_with_retries("POST", path, request)


def rollback(
    twin: str,
    version: int,
    *,
    server: str = "http://127.0.0.1:8080",
    token: str | None = None,
    timeout: float = 60.0,
) -> int:
    """Makes an old version of a twin the latest again, as a new version, and returns the new number.

    Raises `Refused` if the server refuses, and `ConnectFailed` if it does not answer.
    """
    path = f"/v1/twins/{urllib.parse.quote(twin, safe='')}/rollback"
    answer = HttpClient(server, token, timeout).json("POST", path, {"version": version})
    return int(answer["version"])


def recorded_drive(
    twin: str,
    name: str,
    *,
    from_m: float | None = None,
    to_m: float | None = None,
    every_m: float | None = None,
    version: int | None = None,
    server: str = "http://127.0.0.1:8080",
    token: str | None = None,
    timeout: float = 60.0,
) -> Drive:
    """Poses of a recorded drive of a twin, as `DriveSection` describes them; of the latest version if it is None.

    Raises `Refused` if the server refuses, and `ConnectFailed` if it does not answer.
    """
    optional = {"version": version, "from_m": from_m, "to_m": to_m, "every_m": every_m}
    query = urllib.parse.urlencode({key: value for key, value in optional.items() if value is not None})
    twin, name = (urllib.parse.quote(text, safe="") for text in (twin, name))
    answer = HttpClient(server, token, timeout).json("GET", f"/v1/twins/{twin}/trajectories/{name}?{query}", None)
    drive: Drive = decode(Drive, answer, "drive")
    return drive


def _finished_push(answer: dict[str, Any]) -> Push:
    """The push if it is ready; raises `PushFailed` if it was refused or failed."""
    if answer["state"] == "ready":
        return Push(
            answer["id"],
            answer["twin"],
            answer["version"],
            answer["version_hash"],
            answer.get("report") or {},
        )
    error = answer["error"]
    code: Code = error["code"]
    cells = tuple((x, y) for x, y in error.get("cells", ()))
    raise PushFailed(code, error["message"], cells, answer.get("report"))


def _checked_cells(
    cells: Literal["all"] | Sequence[tuple[int, int]] | None,
) -> Literal["all"] | list[tuple[int, int]] | None:
    """The cells as a request has them.

    Raises `ValueError` if it is not a list of cells.
    """
    if cells is None or (isinstance(cells, str) and cells == "all"):
        return cells
    try:
        return [(operator.index(x), operator.index(y)) for x, y in cells]
    except (TypeError, ValueError) as error:
        raise ValueError(f'cells is {cells!r}; it must be "all" or a list of cells, as [(3, -1)]') from error


def upload_all(
    http_client: HttpClient,
    paths: Sequence[str | os.PathLike[str]],
    axes: str | None,
    scale: float | None,
    report: Callable[[PushProgress], None],
) -> list[dict[str, Any]]:
    """Uploads files, and returns them in the form that a request needs. A file in a subfolder next to the first file is
    named with this subfolder, as in the first file. A folder with a SOG is one archive."""
    files: list[dict[str, Any]] = []
    for path in map(Path, paths):
        with packed(path, is_only=len(paths) == 1) as sent:
            upload = _upload(http_client, sent, report)
        folder = Path(paths[0]).parent
        is_beside = sent == path and path.is_relative_to(folder)
        name = path.relative_to(folder).as_posix() if is_beside else sent.name
        given = {"axes": axes, "scale": scale}
        given = {field: value for field, value in given.items() if value is not None}
        files.append({"upload": upload, **given, "name": name})
    return files


def _upload(http_client: HttpClient, path: Path, report: Callable[[PushProgress], None]) -> str:
    """Uploads the bytes of a file that the server lacks, and returns the id of the upload."""
    digest = hashlib.sha256()
    size = 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
            size += len(chunk)
        announcement = {"name": path.name, "size": size, "digest": f"sha-256:{digest.hexdigest()}"}
        failures = 0
        furthest = -1
        while True:
            known = http_client.json_with_retries("POST", "/v1/uploads", announcement)
            if known["complete"]:
                report(PushProgress("uploading", size, size))
                return str(known["id"])
            offset = int(known["offset"])
            # An attempt that transferred something starts the count of failures again.
            failures = 0 if offset > furthest else failures + 1
            furthest = max(furthest, offset)
            if failures:
                time.sleep(RETRY_DELAY_S * 2**failures)
            file.seek(offset)
            headers = {"Upload-Offset": str(offset), "Content-Length": str(size - offset)}
            try:
                body = _chunks(file, offset, size, report)
                http_client.json("PATCH", f"/v1/uploads/{known['id']}", body, headers)
            except ConnectFailed:
                if failures >= ATTEMPTS:
                    raise
            except Refused as refused:
                # An earlier connection has sent more, or the server was busy.
                if refused.code not in ("upload_offset", "busy", "timed_out") or failures >= ATTEMPTS:
                    raise


def _chunks(file: BinaryIO, offset: int, size: int, report: Callable[[PushProgress], None]) -> Iterator[bytes]:
    """The bytes of a file from `offset` on, with a report after each chunk."""
    while offset < size and (chunk := file.read(min(CHUNK_BYTES, size - offset))):
        yield chunk
        offset += len(chunk)
        report(PushProgress("uploading", offset, size))
