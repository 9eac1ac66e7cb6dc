"""Views that `wildcity train augment` wrote, as a data set of a trainer.

`AugmentedViews` is a map data set as PyTorch knows them: it has a length, and an item is a dict of numpy arrays, of
which `torch.utils.data.DataLoader` makes tensors. It does not need PyTorch. docs/augmentation.md of the project shows
a training loop.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from PIL import Image

from .errors import WildCityError

FORMAT = "wildcity.augment/1"
"""Format of augment.json that is read."""

Item = dict[str, npt.NDArray[Any]]


class AugmentedError(WildCityError):
    """A folder was not made by `wildcity train augment`, is not complete, or has a file that differs from its hash."""


@dataclass(frozen=True)
class AugmentedSample:
    """Properties of one view except its pixels. Distances are in metres."""

    folder: Path
    """Folder of its round."""
    round: int
    name: str
    """Its path below `images/`, `masks/` and `depth/`."""
    camera: str
    trajectory: str
    station_m: float
    """Along the drive."""
    offset_m: float
    """To the left of the drive; negative to the right."""
    trust: float
    weight: float
    """Factor of its loss; a recorded image has 1."""
    repaired: bool
    """Whether a model repaired it; else it is as rendered."""
    camera_model: str
    """`PINHOLE`, `OPENCV` or `OPENCV_FISHEYE`."""
    files: dict[str, str]
    """SHA-256 by path below `folder`."""
    K: npt.NDArray[np.float64]
    distortion: npt.NDArray[np.float64]
    """k1, k2, p1, p2 or, for a fisheye, k1 to k4; empty for a pinhole."""
    world_from_camera: npt.NDArray[np.float64]


class AugmentedViews:
    """The views of some rounds.

    An item has `image` uint8 [h, w, 3], `mask` bool [h, w] (which pixels count), `depth` float32 [h, w] (metres, 0 for
    none: z, or the distance for a fisheye), `K` float64 [3, 3] (pixels, centres at 0.5), `world_from_camera` and
    `camera_from_world` float64 [4, 4] (the twin's axes; camera x right, y down, z forward), `weight` and `trust`
    float32; with lenses also `distortion`. Images of cameras of different sizes do not fit into one batch: choose
    `cameras`, or take a batch size of 1.
    """

    def __init__(
        self,
        folder: str | PathLike[str],
        rounds: Iterable[int] | Literal["all", "newest"] = "all",
        *,
        cameras: Iterable[str] | None = None,
        verify: bool = False,
    ) -> None:
        """`rounds` are numbers, `"all"`, or `"newest"`; `verify` compares every file with its hash first."""
        folder = Path(folder)
        there = sorted(_rounds(folder))
        if not there:
            raise AugmentedError(f"{folder} has no round_N: give the --out of `wildcity train augment`")
        if rounds == "all":
            chosen = there
        elif rounds == "newest":
            chosen = there[-1:]
        elif isinstance(rounds, str):
            raise AugmentedError(f'rounds={rounds!r}: give "all", "newest" or numbers')
        else:
            chosen = sorted(set(rounds))
        missing = [number for number in chosen if number not in there]
        if missing:
            raise AugmentedError(f"{folder} has the rounds {there}, and not {missing}")
        wanted = None if cameras is None else set(cameras)
        samples = [sample for number in chosen for sample in _samples(folder / f"round_{number}")]
        if wanted is not None:
            known = {sample.camera for sample in samples}
            if not wanted <= known:
                raise AugmentedError(f"cameras {sorted(wanted - known)} are not in {sorted(known)}")
            samples = [sample for sample in samples if sample.camera in wanted]
        self.samples: list[AugmentedSample] = samples
        self.rounds: list[int] = chosen
        if verify:
            self.verify()

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Item:
        sample = self.samples[index]
        with Image.open(sample.folder / "images" / sample.name) as file:
            image = np.array(file.convert("RGB"))
        with Image.open(sample.folder / "masks" / sample.name) as file:
            mask = np.array(file) >= 128
        with Image.open(sample.folder / "depth" / sample.name) as file:
            depth = np.array(file).astype(np.float32) * np.float32(1e-3)
        item: Item = {
            "image": image,
            "mask": mask,
            "depth": depth,
            "K": sample.K.copy(),
            "world_from_camera": sample.world_from_camera.copy(),
            "camera_from_world": _inverse(sample.world_from_camera),
            "weight": np.asarray(sample.weight, np.float32),
            "trust": np.asarray(sample.trust, np.float32),
        }
        if sample.camera_model != "PINHOLE":
            item["distortion"] = sample.distortion.copy()
        return item

    def __iter__(self) -> Iterator[Item]:
        return (self[index] for index in range(len(self)))

    def verify(self) -> None:
        """Compares every file with its SHA-256. Raises `AugmentedError` that names the first one that differs."""
        for sample in self.samples:
            for name, expected in sample.files.items():
                path = sample.folder / name
                if not path.is_file():
                    raise AugmentedError(f"{path} is missing: run `wildcity train augment` again")
                if hashlib.sha256(path.read_bytes()).hexdigest() != expected:
                    raise AugmentedError(
                        f"{path} differs from its hash in augment.json: run `wildcity train augment` again"
                    )


def _rounds(folder: Path) -> Iterator[int]:
    for path in folder.glob("round_*/augment.json"):
        number = path.parent.name.removeprefix("round_")
        if number.isdecimal():
            yield int(number)


def _samples(folder: Path) -> Iterator[AugmentedSample]:
    record = _json(folder / "augment.json")
    if record.get("format") != FORMAT:
        raise AugmentedError(f"{folder / 'augment.json'}: format {record.get('format')!r}, not {FORMAT}")
    if not record["complete"]:
        raise AugmentedError(f"{folder} is not complete: run `wildcity train augment` again")
    transforms = _json(folder / "transforms.json")
    frames = {frame["file_path"]: frame for frame in transforms["frames"]}
    model = transforms["camera_model"]
    names = {"PINHOLE": [], "OPENCV": ["k1", "k2", "p1", "p2"]}.get(model, ["k1", "k2", "k3", "k4"])
    for sample in record["samples"]:
        frame = frames[f"images/{sample['name']}"]
        pose = sample["world_from_camera"]
        yield AugmentedSample(
            folder=folder,
            round=record["made_with"]["options"]["round"],
            name=sample["name"],
            camera=sample["camera"],
            trajectory=sample["trajectory"],
            station_m=sample["station_m"],
            offset_m=sample["offset_m"],
            trust=sample["trust"],
            weight=sample["weight"],
            repaired=sample.get("repair", {}).get("status") == "repaired",
            camera_model=model,
            files=sample["files"],
            K=np.array([[frame["fl_x"], 0.0, frame["cx"]], [0.0, frame["fl_y"], frame["cy"]], [0.0, 0.0, 1.0]]),
            distortion=np.array([frame[name] for name in names], np.float64),
            world_from_camera=_matrix(pose["xyz"], pose["q"]),
        )


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise AugmentedError(f"{path}: {error}") from error


def _matrix(xyz: list[float], q: list[float]) -> npt.NDArray[np.float64]:
    """The 4 x 4 matrix of a pose; q is w, x, y, z."""
    w, x, y, z = q
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = xyz
    return matrix


def _inverse(a_from_b: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The inverse of a rigid 4 x 4 matrix."""
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = a_from_b[:3, :3].T
    b_from_a[:3, 3] = -a_from_b[:3, :3].T @ a_from_b[:3, 3]
    return b_from_a
