"""Converts checkpoints of trainers to safetensors, which `wildcity import` reads.

    python -m wildcity.convert ckpt_29999.pt street.safetensors
    python -m wildcity.convert checkpoint_final.pth street.safetensors --model Background
    python -m wildcity.convert checkpoint_final.pth cars.safetensors --model RigidNodes

A checkpoint's sky network is written to the same file: `wildcity import street.safetensors --sky
street.safetensors` reads both. The last of these commands writes the moving objects, with the number of the object
that each Gaussian belongs to: `wildcity actor import cars.safetensors --tracked` makes an asset of each. Supported are
the checkpoints of gsplat (`splats`), drivestudio (`models`, of which one is converted), street_gaussians (`background`
and one model per object, likewise), nerfstudio's splatfacto, INRIA (a tuple), and 3dgrut, whose particles are Gaussians
only if they were trained with `render.particle_kernel_degree=2` and no surfels. What else a checkpoint has, such as a
sky, a colour correction or other models, is named in a warning; the state of optimizers is not. Conversion needs numpy
but not PyTorch, and runs no code from the file.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from os import PathLike
from typing import Any

import numpy as np
import numpy.typing as npt

from .checkpoint import CheckpointError, ConfigMap, load

__all__ = ["CheckpointError", "convert", "load", "models", "skipped", "sky", "splats"]

_FIELD_NAMES = {
    "means": ("means", "xyz", "positions"),
    "quats": ("quats", "rotation"),
    "scales": ("scales", "scaling", "scale"),
    "opacities": ("opacities", "opacity", "density"),
    "sh0": ("sh0", "features_dc", "feature_dc", "features_albedo"),
    "shN": ("shN", "features_rest", "feature_rest", "features_specular"),
    "point_ids": ("point_ids", "points_ids"),
    "semantic_class": ("semantic_class",),
}
"""gsplat's names of the fields, and all names of the same field in other checkpoints."""

_SKY_TENSORS = [f"sky_head.layers.{layer}.{part}" for layer in range(3) for part in ("weight", "bias")]
"""Tensors of drivestudio's SkyModel; it may also have `appearance_embedding.weight`."""

_GRUT_FIELDS = {"positions", "density", "features_albedo"}
"""Fields by which a checkpoint of 3dgrut is known."""

_GRUT_SETTINGS: dict[tuple[str, str], object] = {
    ("render", "particle_kernel_degree"): 2,
    ("model", "density_activation"): "sigmoid",
    ("model", "scale_activation"): "exp",
}
"""Settings of 3dgrut with the values of Gaussians."""

_WITHOUT_EFFECT = {
    "device_indicator_param",
    "lpips",
    "psnr",
    "ssim",
    "optimizer",
    "optimizers",
    "schedulers",
    "scalers",
}
"""Parts of a checkpoint that change no picture: metrics of nerfstudio, and the state of training."""

_SH_C0 = 0.28209479177387814
"""The SH function of degree 0."""

_TRAINERS = "gsplat, drivestudio, street_gaussians, splatfacto, INRIA or 3dgrut"

_Arrays = dict[str, npt.NDArray[Any]]


def convert(source: str | PathLike[str], target: str | PathLike[str], model: str | None = None) -> int:
    """Writes the Gaussians of a checkpoint, and its sky if it has one, as safetensors.

    Returns the number of Gaussians. `model` selects one of several models of a checkpoint. `target` is written
    completely or not at all. Raises `CheckpointError` if the checkpoint cannot be converted.
    """
    return _convert(source, load(source), target, model)


def _convert(source: str | PathLike[str], saved: Any, target: str | PathLike[str], model: str | None) -> int:
    tensors = _splats(source, saved, model)
    _write_safetensors(target, tensors | _float32(_sky_arrays(saved)))
    return len(tensors["means"])


def skipped(source: str | PathLike[str], model: str | None = None) -> list[str]:
    """Names of what is not converted with a model: its other arrays, such as `semantic`, and groups beside it.

    Groups are paths in the checkpoint, such as `sky_cubemap`, `models.RigidNodes` or `pipeline._model.bil_grids`. The
    state of optimizers has none.
    """
    return _skipped(source, load(source), model)


def _skipped(source: str | PathLike[str], saved: Any, model: str | None) -> list[str]:
    found = _chosen(source, saved, model)[1]
    converted = {id(values) for values in _sky_arrays(saved).values()}
    converted |= {id(values) for values in found.arrays.values()}
    names = list(found.skipped)
    own = found.path
    for path in _array_paths(saved, (), converted):
        if path[: len(own)] == own and len(path) == len(own) + 1:
            continue  # It is one of `found.skipped`, or of the fields of training alone.
        shared = 0
        while shared < min(len(own), len(path) - 1) and own[shared] == path[shared]:
            shared += 1
        names.append(".".join(path[: shared + 1]))
    return list(dict.fromkeys(names))


def splats(source: str | PathLike[str], model: str | None = None) -> _Arrays:
    """The Gaussians of a checkpoint, with gsplat's names and shapes.

    means [N,3], quats [N,4] (w, x, y, z), scales [N,3] (natural logarithm), opacities [N] (logit), sh0 [N,1,3],
    shN [N,K,3]; of drivestudio's RigidNodes also point_ids [N], the object of each Gaussian; and semantic_class [N],
    uint8, if the checkpoint has whole numbers of this name. Raises `CheckpointError` if there is no such model, or
    several and `model` is None.
    """
    return _splats(source, load(source), model)


def _splats(source: str | PathLike[str], saved: Any, model: str | None) -> _Arrays:
    name, found = _chosen(source, saved, model)
    return _checked_arrays(source, name, found)


def _chosen(source: str | PathLike[str], saved: Any, model: str | None) -> tuple[str, _Found]:
    """The model of a name, or the only one."""
    found = _found(source, saved)
    if not found:
        raise CheckpointError(f"{source} has no Gaussians of {_TRAINERS}")
    names = ", ".join(repr(name) for name in found)
    if model is None:
        if len(found) != 1:
            raise CheckpointError(f"{source} has several models: choose one of {names} (--model)")
        return next(iter(found.items()))
    if model not in found:
        raise CheckpointError(f"{source}: there is no model {model!r}, only {names}")
    return model, found[model]


def sky(source: str | PathLike[str]) -> _Arrays:
    """The sky network of a checkpoint as float32, with the names that `wildcity import --sky` reads.

    Empty if there is no sky.
    """
    return _float32(_sky_arrays(load(source)))


def _float32(arrays: _Arrays) -> _Arrays:
    return {name: values.astype("<f4") for name, values in arrays.items()}


def _sky_arrays(saved: Any) -> _Arrays:
    """The arrays of the sky network, as they are in the checkpoint."""
    for arrays in _mappings(saved):
        prefixes = {key.removesuffix(_SKY_TENSORS[0]) for key in arrays if key.endswith(_SKY_TENSORS[0])}
        for prefix in sorted(prefixes):
            names = [*_SKY_TENSORS, "appearance_embedding.weight"]
            found = {name: arrays.get(prefix + name) for name in names}
            if all(isinstance(found[name], np.ndarray) for name in _SKY_TENSORS):
                return {name: values for name, values in found.items() if isinstance(values, np.ndarray)}
    return {}


def _array_paths(value: Any, path: tuple[str, ...], left_out: set[int]) -> Iterator[tuple[str, ...]]:
    """Where a checkpoint has arrays that belong to no optimizer, but for objects with the ids of `left_out`."""
    if id(value) in left_out or len(path) > 64:
        return
    if isinstance(value, np.ndarray):
        if value.size > 0 and not any(step in _WITHOUT_EFFECT for step in path):
            yield path
        return
    if isinstance(value, Mapping):
        if {"state", "param_groups"} <= value.keys():
            return  # The state of an optimizer of PyTorch.
        items: list[tuple[Any, Any]] = list(value.items())
    elif _is_inria(value):
        return  # It has nothing but the Gaussians and the state of their training.
    elif isinstance(value, (list, tuple)):
        items = list(enumerate(value))
    else:
        return
    left_out.add(id(value))  # A pickle may hold a container many times, also in itself.
    for key, item in items:
        yield from _array_paths(item, (*path, *str(key).split(".")), left_out)


def _mappings(value: Any, depth: int = 0) -> Iterator[Mapping[str, Any]]:
    """All nested mappings, with their string keys."""
    if isinstance(value, Mapping) and depth <= 8:
        yield {key: item for key, item in value.items() if isinstance(key, str)}
        for item in value.values():
            yield from _mappings(item, depth + 1)


def models(source: str | PathLike[str]) -> dict[str, _Arrays]:
    """All models of Gaussians of a checkpoint, by name, each as `splats` returns it."""
    found = _found(source, load(source))
    return {name: _checked_arrays(source, name, model) for name, model in found.items()}


@dataclass
class _Found:
    """Arrays of a model: of the known fields by gsplat's names, and the names of the others."""

    path: tuple[str, ...] = ()
    arrays: _Arrays = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    has_plain_colours: bool = False
    """Whether colours of degree 0 are the logits of colours, as splatfacto and drivestudio train them."""


def _found(source: str | PathLike[str], saved: Any) -> dict[str, _Found]:
    """All models of a checkpoint, as they are in the file."""
    _check_kernel(source, saved)
    return {name or "splats": found for name, found in _candidates(saved, ())}


def _checked_arrays(source: str | PathLike[str], name: str, found: _Found) -> _Arrays:
    try:
        shaped = _shaped(found.arrays)
    except CheckpointError as error:
        raise CheckpointError(f"{source}, model {name!r}: {error}") from error
    if found.has_plain_colours:
        colours = 1 / (1 + np.exp(-shaped["sh0"].astype("<f8")))
        shaped["sh0"] = ((colours - 0.5) / _SH_C0).astype("<f4")
    return shaped


def _check_kernel(source: str | PathLike[str], saved: Any) -> None:
    """Refuses the particles of 3dgrut that are no Gaussians: its default ray tracer trains a degree of 4."""
    for values in _mappings(saved):
        config = values.get("config", {})
        is_readable = config.is_readable if isinstance(config, ConfigMap) else isinstance(config, Mapping)
        if values.keys() >= _GRUT_FIELDS and not is_readable:
            raise CheckpointError(
                f"{source}: its config is of a class that cannot be read, so the kernel of its particles is unknown: "
                "save it as a dictionary, or as OmegaConf's DictConfig"
            )
        for (section, key), wanted in _GRUT_SETTINGS.items():
            found = values.get(key, wanted)
            if found != wanted:
                raise CheckpointError(
                    f"{source}: {section}.{key} is {found!r}; only {wanted!r} makes Gaussians: "
                    f"train with {section}.{key}={wanted}"
                )
        if values.get("primitive_type") == "trisurfel":
            raise CheckpointError(
                f"{source}: render.primitive_type is 'trisurfel', planar surfels, which are no Gaussians: "
                "train with another render.primitive_type"
            )


def _is_inria(value: Any) -> bool:
    """Whether it is INRIA's (capture(), iteration): degree, xyz, dc, rest, scaling, rotation, opacity, ..."""
    return isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], tuple)


def _candidates(value: Any, path: tuple[str, ...], name: str = "", depth: int = 0) -> Iterator[tuple[str, _Found]]:
    """All groups of arrays that have every field of Gaussians, with their name in the checkpoint."""
    if depth > 8:
        return
    is_inria = _is_inria(value)
    if is_inria:
        keys = ("xyz", "features_dc", "features_rest", "scaling", "rotation", "opacity")
        value = dict(zip(keys, value[0][1:7], strict=False))
    if not isinstance(value, Mapping):
        return
    groups: dict[str, _Found] = {}
    for key, item in value.items():
        if isinstance(key, str) and isinstance(item, np.ndarray):
            prefix, _, last = key.rpartition(".")
            steps = tuple(prefix.split(".")) if prefix else ()
            group = groups.setdefault(prefix, _Found((*path, *steps)))
            plain = last.lstrip("_")
            known = [ours for ours, theirs in _FIELD_NAMES.items() if plain in theirs]
            for ours in known:
                group.arrays[ours] = item
            if plain == "features_rest" and item.size == 0:
                group.has_plain_colours = not is_inria
            if not known:
                group.skipped.append(key)
        elif isinstance(key, str):
            yield from _candidates(item, (*path, *key.split(".")), key, depth + 1)
    for prefix, found in groups.items():
        if _FIELD_NAMES.keys() - {"shN", "point_ids", "semantic_class"} <= found.arrays.keys():
            _cut_to_active(found.arrays, value.get("n_active_features"))
            yield ".".join(part for part in (name, prefix) if part), found


def _cut_to_active(arrays: _Arrays, degree: Any) -> None:
    """3dgrut stores coefficients of all degrees, and says the highest one that its training had reached."""
    rest = arrays.get("shN")
    if isinstance(degree, int) and degree >= 0 and rest is not None and len(rest):
        coefficients = (degree + 1) ** 2 - 1
        arrays["shN"] = rest.reshape(len(rest), -1)[:, : 3 * coefficients]


def _shaped(arrays: _Arrays) -> _Arrays:
    """The arrays with gsplat's shapes, as float32. Means in float64 stay float64."""
    means = arrays["means"]
    n = len(means)
    rest = arrays.get("shN")
    rest = np.zeros((n, 0, 3), np.float32) if rest is None or rest.size == 0 else rest
    wanted: dict[str, tuple[npt.NDArray[Any], tuple[int, ...]]] = {
        "means": (means, (n, 3)),
        "quats": (arrays["quats"], (n, 4)),
        "scales": (arrays["scales"], (n, 3)),
        "opacities": (arrays["opacities"], (n,)),
        "sh0": (arrays["sh0"], (n, 1, 3)),
        "shN": (rest, (n, rest.size // (3 * n) if n else 0, 3)),
    }
    shaped = {}
    for name, (values, shape) in wanted.items():
        if values.size != np.prod(shape) or (values.ndim > 0 and len(values) != n):
            changing = name == "sh0" and values.ndim == 3 and values.shape[1] > 1
            reason = ": colours that change with time (fourier_dim above 1) are not read" if changing else ""
            raise CheckpointError(f"{name} has shape {values.shape}, not {shape}{reason}")
        if not np.issubdtype(values.dtype, np.floating):
            raise CheckpointError(f"{name} is {values.dtype}, not a floating-point number")
        is_double = name == "means" and values.dtype == np.float64
        shaped[name] = values.reshape(shape).astype("<f8" if is_double else "<f4")
    if shaped["shN"].shape[1] == 0:
        del shaped["shN"]
    ids = arrays.get("point_ids")
    if ids is not None:
        if ids.size != n or not np.issubdtype(ids.dtype, np.integer):
            raise CheckpointError(f"point_ids is {ids.dtype} {ids.shape}, not {n} whole numbers")
        shaped["point_ids"] = ids.reshape(n).astype("<i8")
    classes = arrays.get("semantic_class")
    if classes is not None:
        if classes.size != n or not np.issubdtype(classes.dtype, np.integer):
            raise CheckpointError(f"semantic_class is {classes.dtype} {classes.shape}, not {n} whole numbers")
        if n and not 0 <= classes.min() <= classes.max() <= 255:
            raise CheckpointError(f"semantic_class has values from {classes.min()} to {classes.max()}, not classes")
        shaped["semantic_class"] = classes.reshape(n).astype("u1")
    return shaped


def _write_safetensors(target: str | PathLike[str], tensors: _Arrays) -> None:
    header = {}
    offset = 0
    for name, values in tensors.items():
        header[name] = {
            "dtype": f"{values.dtype.kind.upper()}{8 * values.itemsize}",
            "shape": list(values.shape),
            "data_offsets": [offset, offset + values.nbytes],
        }
        offset += values.nbytes
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    path = os.fspath(target)
    part = f"{path}.{os.getpid()}.part"
    try:
        with open(part, "xb") as file:
            file.write(struct.pack("<Q", len(text)) + text)
            for values in tensors.values():
                file.write(np.ascontiguousarray(values).data)
        os.replace(part, path)
    except OSError as error:
        raise CheckpointError(f"cannot write {path}: {error}") from error
    finally:
        if os.path.exists(part):
            os.remove(part)


def main(arguments: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m wildcity.convert", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("source", help=f"checkpoint of {_TRAINERS}")
    parser.add_argument("target", help="safetensors file to write")
    parser.add_argument("--model", help="name of the model to convert, if there are several")
    chosen = parser.parse_args(arguments)
    try:
        # Read once: a checkpoint has gigabytes.
        saved = load(chosen.source)
        left_out = _skipped(chosen.source, saved, chosen.model)
        count = _convert(chosen.source, saved, chosen.target, chosen.model)
    except CheckpointError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if left_out:
        print(f"warning: not converted: {', '.join(left_out)}", file=sys.stderr)
    print(f"{chosen.target}: {count} Gaussians")
    return 0


if __name__ == "__main__":
    sys.exit(main())
