"""Pushing to a real server: uploads resumed, refusals typed, versions switched."""

from __future__ import annotations

import contextlib
import json
import os
import random
import select
import socket
import struct
import subprocess
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import pytest
import wildcity
from conftest import vector
from wildcity import Camera, Pose, PushFailed, PushProgress, Refused, Rig, pushing
from wildcity.http_client import HttpClient
from wildcity.pushing import upload_all

RIG = Rig("one", (Camera("front", 96, 64, 60.0, 60.0, 48.0, 32.0, Pose((-15, 0, 1.5), (0.5, -0.5, 0.5, -0.5))),))
TOKEN = "pusher-pusher-pusher"
PLY = """ply
format binary_little_endian 1.0
element vertex {count}
property float x
property float y
property float z
property float f_dc_0
property float f_dc_1
property float f_dc_2
property float opacity
property float scale_0
property float scale_1
property float scale_2
property float rot_0
property float rot_1
property float rot_2
property float rot_3
end_header
"""


def write_ply(path: Path, x: float, seed: int, count: int = 2000) -> Path:
    """Writes Gaussians around a point on the x axis."""
    numbers = random.Random(seed)
    with path.open("wb") as file:
        file.write(PLY.format(count=count).encode())
        for _ in range(count):
            mean = [x + numbers.uniform(-9, 9), numbers.uniform(-9, 9), numbers.uniform(0, 3)]
            colour = [numbers.uniform(-1, 1) for _ in range(3)]
            file.write(struct.pack("<14f", *mean, *colour, 2, -2, -2, -2, 1, 0, 0, 0))
    return path


@contextlib.contextmanager
def serving(folder: Path, *more: str) -> Iterator[str]:
    """Runs a server, and yields its HTTP address."""
    binary = os.environ.get("WILDCITY_BIN")
    assert binary, "set WILDCITY_BIN to the built wildcity binary"
    command = [binary, "serve", "--backend", "cpu", "--listen", "127.0.0.1:0", *more]
    for name in ("twins", "episodes", "uploads"):
        command += [f"--{name}", str(folder / name)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            yield line.strip().replace("listening on ws://", "http://").removesuffix("/v1/session")
        finally:
            process.terminate()
            assert process.wait(timeout=20) == 0, "the server did not stop cleanly"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(tmp_path_factory.mktemp("push")) as address:
        yield address


def test_a_scene_becomes_a_twin_and_then_another_version(server: str, tmp_path: Path) -> None:
    seen: list[PushProgress] = []
    path = write_ply(tmp_path / "a.ply", 0.0, 1)
    first = wildcity.push(path, twin="street", server=server, progress=seen.append)
    assert (first.version, first.report["gaussians"]) == (1, 2000)
    assert seen[0].state == "uploading" and seen[-1].state == "ready"
    # The server has these bytes already, under another name.
    copy = wildcity.push(path.rename(tmp_path / "copy.ply"), twin="copy", server=server)
    assert copy.report["files"][0]["name"] == "copy.ply"
    path = (tmp_path / "copy.ply").rename(path)
    uploaded = [step.done for step in seen if step.state == "uploading"]
    assert uploaded == sorted(uploaded) and uploaded[-1] == path.stat().st_size

    url = server.replace("http://", "ws://") + "/v1/session"
    with wildcity.connect(url) as client, client.open("street", rig=RIG) as session:
        before = session.reset()
        files = [write_ply(tmp_path / "b.ply", 64.0, 2), write_ply(tmp_path / "c.ply", 0.0, 3)]
        second = wildcity.push(files, twin="street", server=server, base=1, note="two blocks")
        assert second.version == 2
        assert [cell["cell"] for cell in second.report["cells"]] == [[0, 0], [1, 0]]
        assert session.reset().metadata.frame_hash == before.metadata.frame_hash
        switched = session.switch_version()
        assert (switched.version, switched.version_hash) == (2, second.version_hash)
        after = session.reset()
        assert after.metadata.version == 2
        assert after.metadata.frame_hash != before.metadata.frame_hash
    assert wildcity.rollback("street", 1, server=server) == 3


def test_the_frame_of_a_push(server: str, tmp_path: Path) -> None:
    first, second = write_ply(tmp_path / "a.ply", 0.0, 1), write_ply(tmp_path / "b.ply", 0.0, 2)
    wildcity.push(first, twin="aligned", server=server)
    never = wildcity.push(first, twin="aligned", server=server, frame="capture")
    assert (never.version, never.report["frame"], never.report["aligned"]) == (1, "capture", False)
    twice = {"scale": {"points": [[0, 0, 0], [0, 0, 1]], "distance_m": 2}}
    HttpClient(server, None, 60.0).json("POST", "/v1/twins/aligned/edits", twice)
    tops = []
    frames: list[Literal["twin", "capture"] | None] = [None, "twin", "capture"]
    for frame in frames:
        expected = contextlib.nullcontext() if frame else pytest.warns(UserWarning, match="the twin was aligned")
        with expected:
            pushed = wildcity.push(second, twin="aligned", server=server, frame=frame, cells="all")
        assert (pushed.report["frame"], pushed.report["aligned"]) == (frame or "twin", True)
        tops.append(pushed.report["ranges"]["mean_m"][1][2])
    assert tops[0] == tops[1] == pytest.approx(tops[2] / 2)
    with pytest.raises(Refused) as refused:
        wildcity.push(second, twin="aligned", server=server, frame="world")  # type: ignore[arg-type]
    assert (refused.value.code, refused.value.field) == ("invalid_request", "frame")


def test_a_push_in_the_frame_of_the_capture_is_the_golden_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sent: list[dict[str, Any]] = []

    def answer(_: HttpClient, method: str, path: str, body: Any) -> Any:
        if path == "/v1/uploads":
            return {"id": "blake3-0", "complete": True}
        sent.append(body)
        assert (method, path) == ("POST", "/v1/twins/city/pushes")
        return vector("http/push_capture.json")

    monkeypatch.setattr(HttpClient, "json_with_retries", answer)
    path = write_ply(tmp_path / "a.ply", 0.0, 1)
    pushed = wildcity.push(
        path,
        twin="city",
        axes="y-down-z-forward",
        scale=1.0,
        frame="capture",
        base=3,
        note="epoch 30",
        push_id="epoch-30",
    )
    golden = vector("http/new_push_capture.json")
    golden["files"][0]["name"] = "a.ply"
    # What is empty may be left out.
    assert {name: value for name, value in sent[0].items() if value != []} == {
        name: value for name, value in golden.items() if value != {}
    }
    assert (pushed.version, pushed.report["frame"], pushed.report["aligned"]) == (4, "capture", True)


def test_the_folder_of_a_sog_is_one_archive(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = tmp_path / "street"
    (folder / "0").mkdir(parents=True)
    means = {"files": ["means_l.webp", "means_u.webp"]}
    files = {
        "lod-meta.json": json.dumps({"filenames": ["0/meta.json", "coarse/meta.json"], "environment": None}),
        "0/meta.json": json.dumps({"means": means}),
    }
    for name in ("0/means_l.webp", "0/not_named.webp", "notes.json", "video.mp4"):
        files[name] = name
    for name, text in files.items():
        (folder / name).write_text(text)
    names: list[list[str]] = []
    archives: list[bytes] = []

    def upload(_: HttpClient, path: Path, __: object) -> str:
        assert path.name == "street.zip"
        with zipfile.ZipFile(path) as archive:
            names.append(archive.namelist())
            assert archive.read("0/means_l.webp") == b"0/means_l.webp"
        archives.append(path.read_bytes())
        return "blake3-0"

    monkeypatch.setattr(pushing, "_upload", upload)
    client = HttpClient("http://127.0.0.1:1", None, 1.0)
    wanted = [{"upload": "blake3-0", "axes": "identity", "scale": 1.0, "name": "street.zip"}]
    for path in (folder, folder / "lod-meta.json"):
        os.utime(folder / "0" / "meta.json", (0, len(names)))
        assert upload_all(client, [path], "identity", 1.0, lambda _: None) == wanted
    assert names == [["0/means_l.webp", "0/meta.json", "lod-meta.json"]] * 2 and archives[0] == archives[1]
    (tmp_path / "outside").write_text("secret")
    (folder / "link.json").symlink_to(tmp_path / "outside")
    for damaged, reason in (
        ('{"filenames": ["link.json"]}', "a link that leads out of the folder"),
        ('{"filenames": ["../street/0/meta.json"]}', "not below its folder"),
        ('{"filenames": [1]}', "names of files are texts"),
        ('{"means": 1}', "no description"),
        ("{", "no description"),
    ):
        (folder / "lod-meta.json").write_text(damaged)
        with pytest.raises(ValueError, match=reason):
            upload_all(client, [folder], "identity", 1.0, lambda _: None)
    (folder / "lod-meta.json").unlink()
    with pytest.raises(ValueError, match=r"is a folder without lod-meta\.json or meta\.json"):
        upload_all(client, [folder], "identity", 1.0, lambda _: None)
    with pytest.raises(FileNotFoundError, match=r"lod-meta\.json"):
        upload_all(client, [folder / "lod-meta.json"], "identity", 1.0, lambda _: None)


def test_refusals_raise_typed_errors(server: str, tmp_path: Path) -> None:
    wildcity.push(write_ply(tmp_path / "a.ply", 0.0, 1), twin="road", server=server)
    wildcity.push(write_ply(tmp_path / "b.ply", 0.0, 2), twin="road", server=server)
    late = write_ply(tmp_path / "c.ply", 0.0, 3)
    with pytest.raises(PushFailed) as conflict:
        wildcity.push(late, twin="road", server=server, base=1)
    assert (conflict.value.code, conflict.value.cells) == ("conflict", ((0, 0),))
    with pytest.raises(Refused) as named:
        wildcity.push(late, twin="road", server=server, base=1, cells=[(0, 0)])
    assert named.value.code == "conflict"

    bad = write_ply(tmp_path / "bad.ply", 0.0, 4)
    with bad.open("r+b") as file:
        file.seek(len(PLY.format(count=2000)) + 7 * 14 * 4 + 8)
        file.write(struct.pack("<f", float("nan")))
    with pytest.raises(PushFailed, match=r"Gaussian 7: z is NaN") as refused:
        wildcity.push(bad, twin="road", server=server)
    assert refused.value.code == "push_refused" and refused.value.report is not None
    assert refused.value.report["files"][0]["bad"] == 1
    with pytest.raises(ValueError, match="http"):
        wildcity.push(bad, twin="road", server="localhost:8080/v2")
    # Without a server: nothing is sent.
    wrong: list[Any] = [(0, 0), [(0, 0), "all"], "some", [(1, 2, 3)], [(3.5, 0)], ["37"]]
    for cells in wrong:
        with pytest.raises(ValueError, match=r"cells is .*; it must be"):
            wildcity.push(late, twin="road", server="http://127.0.0.1:1", cells=cells)
    with pytest.raises(wildcity.ConnectFailed):
        wildcity.rollback("road", 1, server="http://127.0.0.1:1")


def test_an_interrupted_upload_continues(server: str, tmp_path: Path) -> None:
    path = write_ply(tmp_path / "large.ply", 0.0, 5, count=60_000)
    with CuttingProxy(server, after_bytes=1_500_000) as address:
        pushed = wildcity.push(path, twin="cut", server=address)
    assert pushed.report["gaussians"] == 60_000


class CuttingProxy:
    """A proxy that cuts the first connection after some bytes."""

    def __init__(self, server: str, after_bytes: int) -> None:
        host, port = server.removeprefix("http://").split(":")
        self.target = (host, int(port))
        self.after_bytes = after_bytes
        self.has_cut = False
        self.listener = socket.create_server(("127.0.0.1", 0))

    def __enter__(self) -> str:
        threading.Thread(target=self.accept, daemon=True).start()
        return f"http://127.0.0.1:{self.listener.getsockname()[1]}"

    def __exit__(self, *_: object) -> None:
        self.listener.close()
        assert self.has_cut, "nothing was cut"

    def accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near = self.listener.accept()[0]
                far = socket.create_connection(self.target)
                threading.Thread(target=self.carry, args=(near, far), daemon=True).start()

    def carry(self, near: socket.socket, far: socket.socket) -> None:
        """Transfers in both directions, until one side closes or the connection is cut."""
        carried = 0
        with near, far, contextlib.suppress(OSError):
            while True:
                for one in select.select([near, far], [], [])[0]:
                    if not (data := one.recv(65536)):
                        return
                    (far if one is near else near).sendall(data)
                    carried += len(data)
                    if not self.has_cut and carried > self.after_bytes:
                        self.has_cut = True
                        return


def test_damaged_assets_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    damaged = [
        {"hash": "9f", "reason": "the folder of all assets whose hashes begin so: it is not a directory"},
        {"hash": "a" * 64, "name": "van", "reason": "its bytes hash to b"},
    ]
    answer: dict[str, Any] = {"actors": [], "damaged": damaged}
    monkeypatch.setattr(HttpClient, "json", lambda *_: answer)
    listed = wildcity.actors()
    assert listed.damaged == tuple(wildcity.DamagedActor(**one) for one in damaged)
    assert [one.name for one in listed.damaged] == [None, "van"]
    del damaged[1]["reason"]
    with pytest.raises(wildcity.ProtocolError, match=r"damaged\[1\].reason is missing"):
        wildcity.actors()


def test_an_asset_of_an_actor(server: str, tmp_path: Path) -> None:
    assert wildcity.actors(server=server) == wildcity.ActorList(())
    path = write_ply(tmp_path / "thing.ply", 0.0, 6, count=500)
    seen: list[PushProgress] = []
    thing = wildcity.push_actor(path, name="thing", kind="object", record="f32", server=server, progress=seen.append)
    assert (thing.name, thing.kind, thing.gaussians, thing.record) == ("thing", "object", 500, "f32")
    assert 10 < thing.box.length_m < 18.001 and thing.box.height_m <= 3.001
    assert thing.levels[0].gaussians == 500 and thing.levels[0].error_m == 0.0
    assert thing.provenance is not None and thing.provenance.source.startswith("blake3:")
    assert thing.provenance.options == ("axes=identity", "scale=1", "gaussians=200000")
    assert [seen[0].state, seen[-1].state] == ["uploading", "ready"]
    assert wildcity.push_actor(path, name="thing", kind="object", record="f32", server=server) == thing
    assert wildcity.actors(server=server) == wildcity.ActorList((thing,))
    assert wildcity.actor("thing", server=server) == wildcity.actor(thing.hash[:8], server=server) == thing

    for change, code, field in [
        ({"name": "../x"}, "invalid_name", "name"),
        ({"kind": "tank"}, "invalid_request", "class"),
        ({"gaussians": 10}, "out_of_range", "gaussians"),
        ({"scale": 0.0}, "invalid_request", "files[0].scale"),
        ({"scale": 1000.0}, "push_refused", None),
        ({"record": "q24"}, "conflict", "name"),
    ]:
        asked: dict[str, Any] = {"name": "thing", "kind": "object", "record": "f32", **change}
        with pytest.raises(Refused) as refused:
            wildcity.push_actor(path, server=server, **asked)
        assert (refused.value.code, refused.value.field) == (code, field)
    with pytest.raises(Refused) as unknown:
        wildcity.actor("bus", server=server)
    assert (unknown.value.code, unknown.value.field) == ("unknown_actor", "actor")
    with pytest.raises(wildcity.ConnectFailed):
        wildcity.push_actor(path, name="thing", server="http://127.0.0.1:1")


def test_tokens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tokens = tmp_path / "tokens.json"
    metrics = f"{TOKEN}-metrics"
    entries = [
        {"name": "ci", "role": "push", "token": TOKEN},
        {"name": "grafana", "role": "metrics", "token": metrics},
    ]
    tokens.write_text(json.dumps({"tokens": entries}))
    path = write_ply(tmp_path / "a.ply", 0.0, 1)
    with serving(tmp_path, "--tokens", str(tokens)) as address:
        with pytest.raises(Refused) as no_token:
            wildcity.push(path, twin="street", server=address)
        assert no_token.value.code == "unauthorized"
        assert wildcity.push(path, twin="street", server=address, token=TOKEN).version == 1
        monkeypatch.setenv("WILDCITY_TOKEN", TOKEN)
        with pytest.raises(Refused) as role:
            wildcity.rollback("street", 1, server=address)
        assert role.value.code == "forbidden"
        url = address.replace("http://", "ws://") + "/v1/session"
        # The token of the environment, and one that was read from a file.
        wildcity.connect(url).close()
        wildcity.connect(url, token=f"{TOKEN}\n").close()
        with pytest.raises(wildcity.ConnectFailed, match=": unauthorized: "):
            wildcity.connect(url, token="")
        with pytest.raises(wildcity.ConnectFailed, match=": forbidden: "):
            wildcity.connect(url, token=metrics)
        with pytest.raises(wildcity.ConnectFailed, match=": unauthorized: .*Authorization: Bearer TOKEN"):
            wildcity.connect(url, token="unknown")
        with pytest.raises(ValueError, match="^token: ") as damaged:
            wildcity.connect(url, token=f"{TOKEN}\n{TOKEN}")
        assert TOKEN not in str(damaged.value)
