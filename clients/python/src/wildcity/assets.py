"""Assets of actors over HTTP, from which other vehicles and pedestrians are drawn."""

from __future__ import annotations

import os
import urllib.parse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from .http_client import HttpClient
from .protocol import decode
from .pushing import PushProgress, upload_all

ACTOR_TIMEOUT_S = 3600.0
"""How long the client waits until an asset is stored: as long as a server reads by default, and earlier pushes."""

ActorClass = Literal["vehicle", "pedestrian", "bicycle", "object"]


@dataclass(frozen=True)
class ActorBox:
    """The box of an actor in metres: x points forward, y to the left, z up, from the ground under its middle."""

    length_m: float
    width_m: float
    height_m: float


@dataclass(frozen=True)
class ActorProvenance:
    """The origin of an asset: the BLAKE3 of the files, the program that made it, and the options."""

    source: str
    builder: str
    options: tuple[str, ...]


@dataclass(frozen=True)
class ActorLevel:
    """One level of detail: its Gaussians, the upper bound of its geometric error in metres, and its bytes."""

    gaussians: int
    error_m: float
    bytes: int


@dataclass(frozen=True)
class ActorAsset:
    """An asset of an actor. Scenarios name it by its hash, or by its name if no other asset has this name.

    provenance: None for a token that is limited to some twins, since it may name others.
    """

    hash: str
    name: str
    # Not "class", which is a keyword.
    kind: ActorClass
    box: ActorBox
    gaussians: int
    sh_degree: int
    record: str
    bytes: int
    levels: tuple[ActorLevel, ...]
    provenance: ActorProvenance | None = None


@dataclass(frozen=True)
class DamagedActor:
    """An asset that differs from what was stored or cannot be read, or a folder of assets that cannot be listed.

    hash: for a folder, the two digits that the hashes of its assets begin with.
    name: the name in its file, if that can be read.
    """

    hash: str
    reason: str
    name: str | None = None


@dataclass(frozen=True)
class ActorList:
    """The assets of a server in order of name and hash, and those that are damaged."""

    actors: tuple[ActorAsset, ...]
    damaged: tuple[DamagedActor, ...] = ()


def push_actor(
    files: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    name: str,
    kind: ActorClass = "vehicle",
    server: str = "http://127.0.0.1:8080",
    token: str | None = None,
    axes: str = "identity",
    scale: float = 1.0,
    gaussians: int | None = None,
    record: Literal["f32", "h52", "q32", "q24"] | None = None,
    progress: Callable[[PushProgress], None] | None = None,
    timeout: float = 60.0,
) -> ActorAsset:
    """Uploads files, makes an asset of them, and returns when it is stored. `wildcity actor import` of the same file
    with the same options gives the same hash.

    files: one or more files of Gaussians, or a glTF mesh with the files that it names.
    name: name of the asset. It must not be the name of an asset with other content.
    kind: what it is.
    server: `http://HOST:PORT` or `https://HOST:PORT`.
    token: for a server that was started with tokens; the default is `$WILDCITY_TOKEN`. It needs the role `push`, and
        must not be limited to some twins.
    axes, scale: axis convention and metres per unit of the files. Their axes become x forward, y left, z up; a glTF
        file that looks along +z, as the standard says, has "0 0 1 1 0 0 0 1 0".
    gaussians: number of flat Gaussians that cover the triangles of a mesh, 1,000 to 1,000,000; 200,000 by default.
    record: storage format of a Gaussian; "q32" by default.
    progress: is called with every change of the progress of the upload, and with the state "ready" at the end.
    timeout: how long the answer to one part of an upload may take, in seconds.

    An interrupted upload continues where it stopped, and an asset that exists already is not made again.

    Raises `Refused` if the files or the request are refused, and `ConnectFailed` if the server does not answer.
    """
    paths = [files] if isinstance(files, (str, os.PathLike)) else list(files)
    report = progress or (lambda _: None)
    request: dict[str, Any] = {
        "name": name,
        "class": kind,
        "files": upload_all(HttpClient(server, token, timeout), paths, axes, scale, report),
    }
    optional = {"gaussians": gaussians, "record": record}
    request |= {field: value for field, value in optional.items() if value is not None}
    answer = HttpClient(server, token, ACTOR_TIMEOUT_S).json("POST", "/v1/actors", request)
    report(PushProgress("ready", 1, 1))
    return _actor(answer, "actor")


def actors(*, server: str = "http://127.0.0.1:8080", token: str | None = None, timeout: float = 60.0) -> ActorList:
    """All assets of a server, and those that are damaged.

    Raises `Refused` if the server refuses, and `ConnectFailed` if it does not answer.
    """
    answer = decode(dict, HttpClient(server, token, timeout).json("GET", "/v1/actors", None), "the list of actors")
    listed = decode(list, answer.get("actors"), "actors")
    return ActorList(
        tuple(_actor(actor, f"actors[{index}]") for index, actor in enumerate(listed)),
        decode(tuple[DamagedActor, ...], answer.get("damaged", []), "damaged"),
    )


def actor(
    name: str, *, server: str = "http://127.0.0.1:8080", token: str | None = None, timeout: float = 60.0
) -> ActorAsset:
    """The asset with a name, with a hash, or with a hash that begins with the given digits (at least 4).

    Raises `Refused` if there is no such asset or more than one, and `ConnectFailed` if the server does not answer.
    """
    path = f"/v1/actors/{urllib.parse.quote(name, safe='')}"
    return _actor(HttpClient(server, token, timeout).json("GET", path, None), "actor")


def _actor(answer: Any, path: str) -> ActorAsset:
    """An asset from JSON, in which its kind is called `class`."""
    fields = decode(dict, answer, path)
    renamed = {"kind" if name == "class" else name: value for name, value in fields.items()}
    decoded: ActorAsset = decode(ActorAsset, renamed, path)
    return decoded
