"""Conversion of checkpoints to safetensors, and checkpoints that try to run code."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import subprocess
import sys
import types
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from wildcity import convert
from wildcity.convert import CheckpointError

N = 20


@pytest.fixture(autouse=True)
def fake_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """The names of PyTorch that a pickle refers to."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    for module, name in [
        (torch, "FloatStorage"),
        (torch, "DoubleStorage"),
        (torch, "BFloat16Storage"),
        (torch, "LongStorage"),
        (utils, "_rebuild_tensor_v2"),
        (utils, "_rebuild_parameter"),
    ]:
        stand_in = type(name, (), {"__module__": module.__name__})
        stand_in.__qualname__ = name
        setattr(module, name, stand_in)
    monkeypatch.setitem(sys.modules, "torch", torch)
    monkeypatch.setitem(sys.modules, "torch._utils", utils)


class Tensor:
    """A tensor that `save` writes as torch does; `wrong` replaces some of its numbers."""

    def __init__(self, values: Any, storage: str = "FloatStorage", **wrong: Any) -> None:
        self.values = np.asarray(values)
        self.storage, self.wrong = storage, wrong

    @property
    def strides(self) -> tuple[int, ...]:
        return tuple(step // self.values.itemsize for step in self.values.strides)


class Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=2)
        self.data: list[bytes] = []

    def reducer_override(self, item: Any) -> Any:
        if not isinstance(item, Tensor):
            return NotImplemented
        utils = sys.modules["torch._utils"]
        size = item.wrong.get("size", item.values.shape)
        stride = item.wrong.get("stride", item.strides)
        args = (Storage(item), item.wrong.get("offset", 0), size, stride, False, OrderedDict())
        return utils._rebuild_tensor_v2, args

    def persistent_id(self, item: Any) -> Any:
        if not isinstance(item, Storage):
            return None
        tensor = item.tensor
        self.data.append(tensor.values.tobytes())
        kind = getattr(sys.modules["torch"], tensor.storage)
        return ("storage", kind, str(len(self.data) - 1), "cuda:0", tensor.values.size)


class Storage:
    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor


def save(path: Path, value: Any, compression: int = zipfile.ZIP_STORED) -> Path:
    file = io.BytesIO()
    pickler = Pickler(file)
    pickler.dump(value)
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("archive/data.pkl", file.getvalue())
        archive.writestr("archive/byteorder", "little", zipfile.ZIP_STORED)
        for index, data in enumerate(pickler.data):
            archive.writestr(f"archive/data/{index}", data)
    return path


def gaussians(n: int = N, rest: int = 15) -> dict[str, np.ndarray[Any, Any]]:
    random = np.random.default_rng(1)

    def draw(*shape: int) -> np.ndarray[Any, Any]:
        return random.normal(size=shape).astype("<f4")

    return {
        "means": draw(n, 3),
        "quats": draw(n, 4),
        "scales": draw(n, 3),
        "opacities": draw(n),
        "sh0": draw(n, 1, 3),
        "shN": draw(n, rest, 3),
    }


def safetensors(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    data = path.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    body = data[8 + length :]
    tensors = {}
    for name, info in json.loads(data[8 : 8 + length]).items():
        start, end = info["data_offsets"]
        dtype = {"F32": "<f4", "F64": "<f8", "U8": "u1"}[info["dtype"]]
        tensors[name] = np.frombuffer(body[start:end], dtype).reshape(info["shape"])
    return tensors


def assert_same(found: dict[str, Any], wanted: dict[str, Any]) -> None:
    assert found.keys() == wanted.keys()
    for name, values in wanted.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def tensors(g: dict[str, np.ndarray[Any, Any]]) -> dict[str, Tensor]:
    return {name: Tensor(values) for name, values in g.items()}


def test_gsplat(tmp_path: Path) -> None:
    g = gaussians()
    source = save(tmp_path / "ckpt.pt", {"step": 29999, "splats": tensors(g)})
    assert convert.convert(source, tmp_path / "out.safetensors") == N
    assert_same(safetensors(tmp_path / "out.safetensors"), g)
    assert sorted(os.listdir(tmp_path)) == ["ckpt.pt", "out.safetensors"]


def test_classes_are_written_as_bytes(tmp_path: Path) -> None:
    g = gaussians()
    saved = tensors(g)
    saved["semantic_class"] = Tensor(np.arange(1, N + 1)[:, None], "LongStorage")
    source = save(tmp_path / "ckpt.pt", {"splats": saved})
    convert.convert(source, tmp_path / "out.safetensors")
    wanted = {**g, "semantic_class": np.arange(1, N + 1, dtype="u1")}
    assert_same(safetensors(tmp_path / "out.safetensors"), wanted)
    for wrong, says in ((np.arange(N - 1), "not 20 whole"), (np.full(N, 300), "from 300 to 300")):
        saved["semantic_class"] = Tensor(wrong, "LongStorage")
        with pytest.raises(CheckpointError, match=says):
            convert.splats(save(tmp_path / "ckpt.pt", {"splats": saved}))


def test_drivestudio_names_its_models(tmp_path: Path) -> None:
    g = gaussians()
    theirs = {"sh0": "features_dc", "shN": "features_rest"}

    def state(g: dict[str, np.ndarray[Any, Any]]) -> OrderedDict[str, Tensor]:
        state = OrderedDict((f"_{theirs.get(k, k)}", Tensor(v)) for k, v in g.items())
        state["_opacities"] = Tensor(g["opacities"][:, None])
        state["_features_dc"] = Tensor(g["sh0"][:, 0])
        return state

    saved = {"models": {"Background": state(g), "RigidNodes": state(gaussians(5)), "Sky": {}}}
    source = save(tmp_path / "checkpoint_final.pth", saved)
    with pytest.raises(CheckpointError, match="choose one of 'Background', 'RigidNodes'"):
        convert.splats(source)
    assert_same(convert.splats(source, "Background"), g)
    assert len(convert.splats(source, "RigidNodes")["means"]) == 5
    with pytest.raises(CheckpointError, match="no model 'Sky'"):
        convert.splats(source, "Sky")


def test_a_sky_is_written_to_the_same_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    shapes = {"0.weight": (8, 9), "0.bias": (8,), "1.weight": (8, 17), "1.bias": (8,)}
    shapes |= {"2.weight": (3, 8), "2.bias": (3,)}
    network = {f"sky_head.layers.{name}": rng.standard_normal(shape).astype("<f4") for name, shape in shapes.items()}
    network["appearance_embedding.weight"] = rng.standard_normal((4, 3)).astype("<f4")
    state = {name: Tensor(values) for name, values in network.items()}
    state["direction_encoding.scales"] = Tensor(np.ones(7, "<f4"))
    background = {f"_{name}": Tensor(values) for name, values in gaussians().items()}
    saved = {"models": {"Background": background, "Sky": state}}
    source = save(tmp_path / "checkpoint_final.pth", saved)
    found = convert.sky(source)
    assert found.keys() == network.keys()
    for name, values in network.items():
        np.testing.assert_array_equal(found[name], values)
    assert convert.convert(source, tmp_path / "street.safetensors") == N
    written = (tmp_path / "street.safetensors").read_bytes()
    assert b'"sky_head.layers.2.bias"' in written
    assert network["sky_head.layers.1.weight"].tobytes() in written
    del state["sky_head.layers.2.bias"]
    assert convert.sky(save(tmp_path / "half.pth", saved)) == {}


def test_splatfacto_and_inria(tmp_path: Path) -> None:
    g = gaussians(rest=8)
    names = {"sh0": "features_dc", "shN": "features_rest"}
    flat = {f"_model.gauss_params.{names.get(k, k)}": Tensor(v) for k, v in g.items()}
    assert_same(convert.splats(save(tmp_path / "a.ckpt", {"pipeline": flat})), g)
    order = ("means", "sh0", "shN", "scales", "quats", "opacities")
    captured = (2, *(Tensor(g[name]) for name in order), Tensor([1.0]), {}, 5.0)
    assert_same(convert.splats(save(tmp_path / "chkpnt.pth", (captured, 30000))), g)


def test_dtypes_strides_and_degree_0(tmp_path: Path) -> None:
    g = gaussians(rest=0)
    del g["shN"]
    saved = tensors(g)
    saved["means"] = Tensor(g["means"].astype("<f8") + 4.5e6, "DoubleStorage")
    # bfloat16 is the upper half of float32.
    halves = (g["scales"].view("<u4") >> 16).astype("<u2")
    saved["scales"] = Tensor(halves, "BFloat16Storage")
    saved["quats"] = Tensor(g["quats"].T.copy(), size=(N, 4), stride=(1, N))
    found = convert.splats(save(tmp_path / "ckpt.pt", {"splats": saved}))
    assert found["means"].dtype == np.float64
    np.testing.assert_array_equal(found["means"], saved["means"].values)
    np.testing.assert_array_equal(found["scales"].view("<u4") >> 16, halves)
    np.testing.assert_array_equal(found["quats"], g["quats"])
    assert "shN" not in found


class Evil:
    def __reduce__(self) -> Any:
        return os.mkdir, (os.environ["EVIL"],)


def test_nothing_in_a_checkpoint_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = tmp_path / "made"
    monkeypatch.setenv("EVIL", str(made))
    saved = {"splats": tensors(gaussians()), "optimizer": Evil(), "list": [Evil(), {"a": Evil()}]}
    source = save(tmp_path / "ckpt.pt", saved)
    assert len(convert.splats(source)["means"]) == N
    assert not made.exists()
    # The pickle is dangerous: Python's own unpickler runs it.
    pickle.loads(pickle.dumps(Evil()))
    assert made.exists()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"size": (2**60, 3)}, "in 60 numbers"),
        ({"size": (2**40, 3), "stride": (0, 1)}, "in 60 numbers"),
        ({"offset": 1}, "in 60 numbers"),
        ({"offset": -3}, "offset -3"),
        ({"stride": (-3, 1)}, "stride"),
        ({"stride": (2**62, 1)}, "in 60 numbers"),
        ({"stride": (3,)}, "damaged"),
        ({"size": ("a", 3)}, "size"),
    ],
)
def test_tensors_beyond_their_storage_are_refused(tmp_path: Path, wrong: Any, message: str) -> None:
    saved = tensors(gaussians())
    saved["means"] = Tensor(gaussians()["means"], **wrong)
    source = save(tmp_path / "ckpt.pt", {"splats": saved})
    with pytest.raises(CheckpointError, match=message):
        convert.splats(source)


def test_inconsistent_shapes_are_refused(tmp_path: Path) -> None:
    saved = tensors(gaussians())
    saved["quats"] = Tensor(gaussians(N - 1)["quats"])
    with pytest.raises(CheckpointError, match=r"quats has shape \(19, 4\), not \(20, 4\)"):
        convert.splats(save(tmp_path / "ckpt.pt", {"splats": saved}))
    del saved["quats"]
    with pytest.raises(CheckpointError, match="has no Gaussians of gsplat"):
        convert.splats(save(tmp_path / "ckpt.pt", {"splats": saved}))


def test_compression_is_refused(tmp_path: Path) -> None:
    source = save(tmp_path / "ckpt.pt", {"splats": tensors(gaussians())}, zipfile.ZIP_DEFLATED)
    with pytest.raises(CheckpointError, match="compressed"):
        convert.splats(source)


def test_any_damage_raises_checkpoint_error(tmp_path: Path) -> None:
    whole = save(tmp_path / "ckpt.pt", {"splats": tensors(gaussians(3))}).read_bytes()
    broken = tmp_path / "broken.pt"
    for end in range(0, len(whole), 7):
        broken.write_bytes(whole[:end])
        with pytest.raises(CheckpointError):
            convert.splats(broken)
    # Damage in the pickle itself, with valid checksums of the archive.
    with zipfile.ZipFile(tmp_path / "ckpt.pt") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    program = files["archive/data.pkl"]
    refused = 0
    for at in range(len(program)):
        files["archive/data.pkl"] = program[:at] + bytes([program[at] ^ 0x15]) + program[at + 1 :]
        with zipfile.ZipFile(broken, "w") as archive:
            for name, data in files.items():
                archive.writestr(name, data)
        try:
            convert.splats(broken)
        except CheckpointError:
            refused += 1
    assert refused > len(program) // 2


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    source = save(tmp_path / "ckpt.pt", {"splats": tensors(gaussians())})
    (tmp_path / "taken").mkdir()
    with pytest.raises(CheckpointError, match="cannot write"):
        convert.convert(source, tmp_path / "taken")
    assert sorted(os.listdir(tmp_path)) == ["ckpt.pt", "taken"]


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = save(tmp_path / "ckpt.pt", {"splats": tensors(gaussians())})
    target = tmp_path / "out.safetensors"
    assert convert.main([str(source), str(target)]) == 0
    assert capsys.readouterr().out == f"{target}: 20 Gaussians\n"
    assert convert.main([str(tmp_path / "none.pt"), str(target)]) == 1
    assert "error: cannot read" in capsys.readouterr().err


def data() -> Path | None:
    """Folder of the real data. If it is absent: None, with a message on standard error."""
    beside = Path(__file__).parents[3] / "../shared/data"
    root = Path(os.environ.get("WILDCITY_DATA", beside))
    if root.is_dir():
        return root
    assert os.environ.get("WILDCITY_DATA_REQUIRED") != "1", f"no real data at {root}"
    print(f"NOT RUN: no real data at {root}", file=sys.stderr)
    return None


def test_files_that_torch_saved() -> None:
    root = data()
    if root is None:
        return
    folder = root / "conformance/pt_gsplat"
    means = convert.load(folder / "means.pt")
    quats, scales = convert.load(folder / "quats.pt"), convert.load(folder / "scales.pt")
    assert means.shape == scales.shape == (54_275, 3)
    assert quats.shape == (54_275, 4)
    with zipfile.ZipFile(folder / "means.pt") as archive:
        np.testing.assert_array_equal(means.ravel(), np.frombuffer(archive.read("archive/data/0"), "<f4"))
    lengths = np.linalg.norm(quats, axis=1)
    assert 0.05 < lengths.min() < 0.5 and 1.5 < lengths.max() < 4, "quaternions as trained"
    poses = convert.load(folder / "camtoworlds.pt")
    assert poses.shape[-2:] == (4, 4)
    np.testing.assert_array_equal(poses.reshape(-1, 4, 4)[:, 3], [[0, 0, 0, 1]])
    assert np.isfinite(means).all()


def test_checkpoints_of_street_gaussians_and_3dgrut(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    root = data()
    if root is None:
        return
    folder = root / "cases/street_gaussians"
    street = folder / "street_gaussians.pth"
    with pytest.raises(CheckpointError, match="choose one of 'background', 'obj_001'"):
        convert.splats(street)
    background = convert.splats(street, "background")
    assert background["means"].shape == (20, 3) and background["shN"].shape == (20, 3, 3)
    np.testing.assert_array_equal(background["means"], convert.load(street)["background"]["xyz"])
    assert convert.main([str(street), str(tmp_path / "out"), "--model", "background"]) == 0
    assert capsys.readouterr().err == "warning: not converted: semantic, obj_001\n"

    grut = convert.splats(folder / "3dgrut.pt")
    saved = convert.load(folder / "3dgrut.pt")
    assert grut["shN"].shape == (20, 15, 3)
    np.testing.assert_array_equal(grut["sh0"][:, 0], saved["features_albedo"])
    np.testing.assert_array_equal(grut["shN"].reshape(20, 45), saved["features_specular"])
    np.testing.assert_array_equal(grut["opacities"], saved["density"][:, 0])


def test_3dgrut_says_its_degree_and_its_kernel(tmp_path: Path) -> None:
    g = gaussians()
    saved = grut(g)
    source = save(tmp_path / "ckpt_last.pt", saved | {"n_active_features": 1})
    np.testing.assert_array_equal(convert.splats(source)["shN"], g["shN"][:, :3])
    config = {"render": {"particle_kernel_degree": 4}}
    source = save(tmp_path / "ckpt_4.pt", saved | {"config": config})
    with pytest.raises(CheckpointError, match="particle_kernel_degree is 4"):
        convert.splats(source)


class Node:
    """Stands for a class of OmegaConf, whose objects are pickled with their state."""

    def __init__(self, **state: Any) -> None:
        self.__dict__.update(state)


@pytest.fixture
def omegaconf(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes what `OmegaConf.create` makes of a dictionary."""
    classes: dict[str, Any] = {}
    for module, name in [("dictconfig", "DictConfig"), ("listconfig", "ListConfig"), ("nodes", "AnyNode")]:
        made = types.ModuleType(f"omegaconf.{module}")
        classes[name] = type(name, (Node,), {"__module__": made.__name__, "__qualname__": name})
        setattr(made, name, classes[name])
        monkeypatch.setitem(sys.modules, made.__name__, made)
    monkeypatch.setitem(sys.modules, "omegaconf", types.ModuleType("omegaconf"))

    def create(value: Any, parent: Any = None) -> Any:
        if isinstance(value, dict):
            node = classes["DictConfig"](_metadata=None, _parent=parent)
            node._content = {key: create(item, node) for key, item in value.items()}
            return node
        if isinstance(value, list):
            node = classes["ListConfig"](_metadata=None, _parent=parent)
            node._content = [create(item, node) for item in value]
            return node
        return classes["AnyNode"](_metadata=None, _parent=parent, _flags_cache=None, _val=value)

    return create


def grut(g: dict[str, np.ndarray[Any, Any]]) -> dict[str, Any]:
    """What 3dgrut saves, without its config."""
    names = {"means": "positions", "quats": "rotation", "scales": "scale", "opacities": "density"}
    names |= {"sh0": "features_albedo", "shN": "features_specular"}
    saved: dict[str, Any] = {names[name]: Tensor(values) for name, values in g.items()}
    saved["features_specular"] = Tensor(g["shN"].reshape(N, 45))
    return saved


def test_a_config_of_omegaconf_is_read(tmp_path: Path, omegaconf: Any) -> None:
    usual = {"render": {"particle_kernel_degree": 2, "sizes": [1, "a"]}, "model": {"density_activation": "sigmoid"}}
    source = save(tmp_path / "ckpt_last.pt", grut(gaussians()) | {"config": omegaconf(usual)})
    assert len(convert.splats(source)["means"]) == N
    assert convert.skipped(source) == []
    config = convert.load(source)["config"]
    assert config["render"]["particle_kernel_degree"] == 2
    assert list(config["render"]["sizes"]) == [1, "a"]
    for section, key, value in [
        ("render", "particle_kernel_degree", 4),
        ("render", "primitive_type", "trisurfel"),
        ("model", "density_activation", "none"),
        ("model", "scale_activation", "softplus"),
    ]:
        for create in (omegaconf, dict):
            changed = create(usual | {section: {key: value}})
            source = save(tmp_path / "other.pt", grut(gaussians()) | {"config": changed})
            with pytest.raises(CheckpointError, match=f"{section}.{key} is {value!r}"):
                convert.splats(source)


def test_a_config_that_cannot_be_read_is_refused(tmp_path: Path, omegaconf: Any) -> None:
    reference = omegaconf({})
    reference._content = "${other}"
    for config in (reference, omegaconf(3), types.SimpleNamespace(render=2)):
        source = save(tmp_path / "ckpt_last.pt", grut(gaussians()) | {"config": config})
        with pytest.raises(CheckpointError, match="config is of a class that cannot be read"):
            convert.splats(source)


def test_colours_without_higher_degrees_are_those_of_their_trainer(tmp_path: Path) -> None:
    g = gaussians(rest=0)
    names = {"sh0": "features_dc", "shN": "features_rest"}
    # splatfacto and drivestudio draw sigmoid(features_dc) at degree 0; INRIA, 0.5 + C0 f_dc.
    colours = 1 / (1 + np.exp(-g["sh0"].astype("<f8")))
    splatfacto = {f"_model.gauss_params.{names.get(k, k)}": Tensor(v) for k, v in g.items()}
    drivestudio = {f"_{names.get(k, k)}": Tensor(v) for k, v in g.items()}
    for saved in ({"pipeline": splatfacto}, {"models": {"Background": drivestudio}}):
        found = convert.splats(save(tmp_path / "degree_0.ckpt", saved))
        np.testing.assert_allclose(0.5 + 0.28209479177387814 * found["sh0"], colours, atol=1e-6)
        assert "shN" not in found
    order = ("means", "sh0", "shN", "scales", "quats", "opacities")
    captured = (0, *(Tensor(g[name]) for name in order), Tensor([1.0]), {}, 5.0)
    inria = convert.splats(save(tmp_path / "chkpnt.pth", (captured, 30000)))
    np.testing.assert_array_equal(inria["sh0"], g["sh0"])


def test_arrays_beside_the_model_are_named_by_their_group(tmp_path: Path) -> None:
    g = gaussians()
    one = Tensor(np.ones(4, "<f4"))
    adam = {"state": {0: {"exp_avg": one}}, "param_groups": [{"lr": 1.0}]}

    def left_out(saved: Any, model: str | None = None) -> list[str]:
        return convert.skipped(save(tmp_path / "ckpt.pt", saved), model)

    beside = {"bil_grids": {"grids": one}, "pose_adjust": {"embeds.weight": one}, "appearance": [one]}
    gsplat = {"step": 1, "splats": tensors(g) | {"features": one}, **beside, "optimizers": {"a": one}, "adam": adam}
    assert left_out(gsplat) == ["features", "bil_grids", "pose_adjust", "appearance"]
    flat = {f"_model.gauss_params.{k}": Tensor(v) for k, v in g.items()}
    flat |= {"_model.bil_grids.grids": one, "_model.camera_optimizer.pose_adjustment": one, "_model.lpips.w": one}
    wanted = ["pipeline._model.bil_grids", "pipeline._model.camera_optimizer"]
    assert left_out({"pipeline": flat, "optimizers": {"means": adam}}) == wanted
    street = {"background": tensors(g), "obj_001": tensors(g), "sky_cubemap": {"params": {"sky_cube_map": one}}}
    assert left_out(street, "background") == ["obj_001", "sky_cubemap"]
    drive = {"models": {"Background": tensors(g), "Affine": {"embedding.weight": one}}, "optimizer": adam}
    assert left_out(drive) == ["models.Affine"]


def test_what_cannot_be_converted_is_named(tmp_path: Path) -> None:
    g = gaussians()
    saved = {"background": tensors(g), "obj_001": tensors(g | {"sh0": np.zeros((N, 5, 3), "<f4")})}
    source = save(tmp_path / "iteration_30000.pth", saved)
    assert_same(convert.splats(source, "background"), g)
    with pytest.raises(CheckpointError, match="fourier_dim"):
        convert.splats(source, "obj_001")
    with pytest.raises(CheckpointError, match="has no Gaussians of gsplat"):
        convert.splats(save(tmp_path / "empty.pth", {"iter": 1}), "background")


def test_converted_files_can_be_imported(tmp_path: Path) -> None:
    binary = os.environ.get("WILDCITY_BIN")
    assert binary, "set WILDCITY_BIN to the wildcity binary"
    source = save(tmp_path / "ckpt.pt", {"splats": tensors(gaussians())})
    convert.convert(source, tmp_path / "out.safetensors")
    command = [binary, "import", tmp_path / "out.safetensors", "--twin", "converted"]
    done = subprocess.run([*command, "--twins", tmp_path / "twins"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "20 Gaussians of SH degree 3" in done.stdout
