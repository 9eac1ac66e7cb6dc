"""Decodes the binary frame, which has safetensors layout. Arrays are views of it, without a copy.

No object here refers to itself, not even through others: so a frame in shared memory is free as soon as the last
observation, view or array of it is gone.
"""

from __future__ import annotations

import base64
import html
import math
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .errors import BadFrame, ProtocolError, Refused
from .messages import Ego, ImageInfo, ManyMetadata, Metadata, Sweep
from .protocol import decode, parse_json

HEADER_BYTES = 1 << 20
"""Largest header that is accepted: 256 images take a quarter of it."""

HISTORY_POSES = 16
DTYPES: dict[str, np.dtype[Any]] = {
    "U8": np.dtype("u1"),
    "U16": np.dtype("<u2"),
    "F32": np.dtype("<f4"),
}


class Observation:
    """Images and state of the ego at one time. Arrays are read-only views of the frame; JPEG and PNG are decoded on
    demand.

    `images["front"]` is uint8 [height, width, 3]. `depth` (metres) and `opacity` are float32 [height, width],
    if the session asked for them. Depth is camera z, or distance for the lenses that can see 90° and more:
    fisheye and f-theta. After an `observe` of several poses these are the images of the first pose, and `views`
    has all of them.

    Raises `BadFrame` if the frame is not a valid observation.
    """

    def __init__(self, frame: bytes | memoryview) -> None:
        self.frame = frame
        self._tensors, text = _read_layout(frame, "observation")
        self._content = _Content(frame, self._tensors)
        try:
            self.metadata: Metadata = decode(Metadata, parse_json(text, "metadata"), "metadata")
        except BadFrame:
            raise
        except (ProtocolError, ValueError) as error:
            raise BadFrame(str(error)) from error
        self._check()
        poses = {image.pose for image in self.metadata.images} | {0}
        self.views: tuple[View, ...] = tuple(View(self._content, self.metadata.images, pose) for pose in sorted(poses))

    @property
    def ego(self) -> Ego:
        """State of the ego at this time."""
        return self.metadata.ego

    @property
    def history_xyz(self) -> NDArray[np.float32]:
        """float32 [16, 3]: past positions in metres in the current rig frame, 0.1 s apart, the last one zero."""
        return self.tensor("ego.history_xyz")

    @property
    def history_rot(self) -> NDArray[np.float32]:
        """float32 [16, 3, 3]: past rotations, rig(now) from rig(then), the last one the identity."""
        return self.tensor("ego.history_rot")

    @property
    def imu(self) -> NDArray[np.float32]:
        """float32 [n, 6]: specific force (m/s²) and angular velocity (rad/s) in the rig's axes, for each step since
        the previous observation; the last at `metadata.time_us`. Raises `KeyError` unless the session asked for it."""
        return self._sensor("sensor.imu", "imu=Imu()")

    @property
    def wheel_speed(self) -> NDArray[np.float32]:
        """float32 [n]: speed in m/s as the wheels measure it, at the times of `imu`. Raises `KeyError` unless the
        session asked for it."""
        return self._sensor("sensor.wheel_speed", "wheel_speed=WheelSpeed()")

    def _sensor(self, name: str, option: str) -> NDArray[Any]:
        if name not in self._tensors:
            raise KeyError(f"there is no {name}: open the session with sensors=Sensors({option})")
        return self.tensor(name)

    @property
    def images(self) -> Mapping[str, NDArray[np.uint8]]:
        """Colour images by camera, uint8 [height, width, 3]."""
        return self.views[0].images

    @property
    def depth(self) -> Mapping[str, NDArray[np.float32]]:
        """Camera z (distance for fisheye and f-theta) by camera, in metres, 0 where the opacity is 0."""
        return self.views[0].depth

    @property
    def opacity(self) -> Mapping[str, NDArray[np.float32]]:
        """Accumulated opacity by camera, 0 to 1."""
        return self.views[0].opacity

    @property
    def normals(self) -> Mapping[str, NDArray[np.float32]]:
        """Unit normals by camera, in its axes (x right, y down, z forward), 0 where there is no depth."""
        return self.views[0].normals

    @property
    def instances(self) -> Mapping[str, NDArray[np.uint16]]:
        """The owner of the Gaussian that each pixel shows, by camera: 0 none, 1 the twin, else `Actor.instance`."""
        return self.views[0].instances

    @property
    def semantics(self) -> Mapping[str, NDArray[np.uint8]]:
        """The class of the Gaussian that each pixel shows, by camera: an index of `opened.semantics.classes`."""
        return self.views[0].semantics

    @property
    def lidars(self) -> Mapping[str, PointCloud]:
        """The sweep of each LiDAR of the rig, by its name; empty after `observe` and between decisions."""
        sweeps = self.metadata.sweeps
        return _Sweeps({sweep.lidar: PointCloud(self._content, sweep) for sweep in sweeps})

    def frames(self, camera: str) -> NDArray[np.uint8]:
        """uint8 [k, height, width, 3]: the last k frames of a camera, oldest first.

        There are `Outputs.frames` of them, or fewer at the start of an episode. `frame_infos` has their times.
        Raises `KeyError` if there are no frames.
        """
        frames = [_decode_image(self._content, image) for image in self.frame_infos(camera)]
        if not frames:
            raise KeyError(f"{camera!r} has no frames in this observation")
        return np.stack(frames)

    def frame_infos(self, camera: str) -> tuple[ImageInfo, ...]:
        """Metadata of each of `frames`: index of the camera, times, hash."""
        every = (*self.metadata.images, *self.metadata.history)
        infos = (image for image in every if image.camera == camera and image.pose == 0)
        return tuple(sorted(infos, key=lambda image: -image.back))

    def tensor(self, name: str) -> NDArray[Any]:
        """A tensor of the frame by name, without a copy. Raises `KeyError` if there is no such tensor."""
        return self._content.tensor(name)

    def encoded(self, image: ImageInfo) -> memoryview:
        """The bytes of an image as received: a JPEG or PNG file, or raw pixels."""
        return self._content.encoded(image)

    def __repr__(self) -> str:
        m = self.metadata
        names = ", ".join(image.camera for image in m.images)
        return f"<Observation {m.seq}: step {m.step} at {m.time_us} us, images {names}>"

    def _repr_html_(self) -> str:
        """The images side by side, for notebooks."""
        parts = [f"<div>{html.escape(repr(self))}</div>"]
        for image in self.metadata.images:
            if image.pose != 0:
                continue
            picture = Image.fromarray(_decode_image(self._content, image))
            picture.thumbnail((320, 320))
            png = BytesIO()
            picture.save(png, "PNG")
            data = base64.b64encode(png.getvalue()).decode()
            parts.append(f'<img src="data:image/png;base64,{data}" title="{html.escape(image.camera)}">')
        return "".join(parts)

    def _check(self) -> None:
        self._expect("ego.history_xyz", "F32", (HISTORY_POSES, 3))
        self._expect("ego.history_rot", "F32", (HISTORY_POSES, 3, 3))
        for name, per_sample in (("sensor.imu", (6,)), ("sensor.wheel_speed", ())):
            if name in self._tensors:
                samples = self._tensors[name].shape[:1] or (0,)
                self._expect(name, "F32", (*samples, *per_sample))
        for image in (*self.metadata.images, *self.metadata.history):
            size = (image.height, image.width)
            if image.encoding == "raw":
                self._expect(image.tensor, "U8", (*size, 3))
            else:
                self._expect(image.tensor, "U8", None)
            for output, shape in (("depth", size), ("opacity", size), ("normals", (*size, 3))):
                if _sibling(image, output) in self._tensors:
                    self._expect(_sibling(image, output), "F32", shape)
            if _sibling(image, "instances") in self._tensors:
                self._expect(_sibling(image, "instances"), "U16", size)
            if _sibling(image, "semantics") in self._tensors:
                self._expect(_sibling(image, "semantics"), "U8", size)
        for sweep in self.metadata.sweeps:
            self._expect(_of_sweep(sweep, "points"), "F32", (sweep.returns, 3))
            self._expect(_of_sweep(sweep, "intensity"), "F32", (sweep.returns,))
            for ids in ("row", "column", "instance"):
                self._expect(_of_sweep(sweep, ids), "U16", (sweep.returns,))
            if _of_sweep(sweep, "class") in self._tensors:
                self._expect(_of_sweep(sweep, "class"), "U8", (sweep.returns,))

    def _expect(self, name: str, dtype: str, shape: tuple[int, ...] | None) -> None:
        """Checks type and shape of a tensor; with `shape` None, any one-dimensional one."""
        if name not in self._tensors:
            raise BadFrame(f"there is no tensor {name!r}")
        tensor = self._tensors[name]
        fits = len(tensor.shape) == 1 if shape is None else tensor.shape == shape
        if tensor.dtype != DTYPES[dtype] or not fits:
            raise BadFrame(
                f"tensor {name!r} is {tensor.dtype} {list(tensor.shape)}; "
                f"expected {dtype} {'[n]' if shape is None else list(shape)}"
            )


class Many:
    """The answer to `step_many`: by session its observation, or the refusal of its step.

    The observations are views of the message, without a copy. Raises `BadFrame` if it is not such a message.
    """

    def __init__(self, frame: bytes | memoryview) -> None:
        tensors, text = _read_layout(frame, "many")
        try:
            metadata: ManyMetadata = decode(ManyMetadata, parse_json(text, "many"), "many")
        except (ProtocolError, ValueError) as failure:
            raise BadFrame(str(failure)) from failure
        self.seq = metadata.seq
        self.results: dict[str, Observation | Refused] = {}
        for answer in metadata.answers:
            name, error = answer.session, answer.error
            if error is not None and answer.tensor is None:
                self.results[name] = Refused(error.code, error.message, error.field, False)
                continue
            tensor = None if answer.tensor is None or error is not None else tensors.get(answer.tensor)
            if tensor is None or tensor.dtype != np.uint8 or len(tensor.shape) != 1:
                raise BadFrame(f"session {name!r} has neither an observation nor an error")
            observation = Observation(memoryview(frame)[tensor.start : tensor.start + tensor.shape[0]])
            if observation.metadata.session != name:
                raise BadFrame(f"the observation of {name!r} is of {observation.metadata.session!r}")
            self.results[name] = observation


class View:
    """The images of one pose."""

    def __init__(self, content: _Content, images: tuple[ImageInfo, ...], pose: int) -> None:
        self._content = content
        self._infos = {i.camera: i for i in images if i.pose == pose}

    @property
    def cameras(self) -> Mapping[str, ImageInfo]:
        """Metadata of each image by camera, in order: size, intrinsics, times and hash."""
        return self._infos

    @cached_property
    def images(self) -> Mapping[str, NDArray[np.uint8]]:
        """uint8 [height, width, 3] by camera. JPEG and PNG are decoded at the first access, and kept."""
        content = self._content
        have = ", ".join(self._infos) or "none"
        return _LazyArrays(self._infos, lambda image: _decode_image(content, image), f"images are of {have}")

    @cached_property
    def depth(self) -> Mapping[str, NDArray[np.float32]]:
        """float32 [height, width] by camera: camera z (distance for fisheye and f-theta), in metres."""
        return self._maps("depth")

    @cached_property
    def opacity(self) -> Mapping[str, NDArray[np.float32]]:
        """float32 [height, width] by camera: accumulated opacity, if the session asked for it."""
        return self._maps("opacity")

    @cached_property
    def normals(self) -> Mapping[str, NDArray[np.float32]]:
        """float32 [height, width, 3] by camera: unit normals of the visible surface, if the session asked for them."""
        return self._maps("normals")

    @cached_property
    def instances(self) -> Mapping[str, NDArray[np.uint16]]:
        """uint16 [height, width] by camera: 0 none, 1 the twin, else `Actor.instance`, if the session asked for
        them."""
        return self._maps("instances")

    @cached_property
    def semantics(self) -> Mapping[str, NDArray[np.uint8]]:
        """uint8 [height, width] by camera: an index of `opened.semantics.classes`, if the session asked for them."""
        return self._maps("semantics")

    def _maps(self, output: str) -> Mapping[str, NDArray[Any]]:
        content = self._content
        present = {name: i for name, i in self._infos.items() if _sibling(i, output) in content.tensors}
        have = f"{output} is of {', '.join(present)}"
        if not present:
            have = f"there is no {output}: open the session with outputs=Outputs({output}=True)"
        return _LazyArrays(present, lambda image: content.tensor(_sibling(image, output)), have)


class PointCloud:
    """The returns of one sweep of a LiDAR, row by row. Arrays are read-only views of the frame."""

    def __init__(self, content: _Content, sweep: Sweep) -> None:
        self._content = content
        self.metadata = sweep

    @property
    def points(self) -> NDArray[np.float32]:
        """float32 [n, 3]: positions in metres in the rig's axes when each was measured. A sweep of a moving ego is
        skewed; `times_us` says when, to deskew it."""
        return self._tensor("points")

    @property
    def intensity(self) -> NDArray[np.float32]:
        """float32 [n]: mean luminance of what was hit. Twins are trained on images and know no infrared light."""
        return self._tensor("intensity")

    @property
    def rows(self) -> NDArray[np.uint16]:
        """uint16 [n]: the row of each return's beam, in the order of the rig file."""
        return self._tensor("row")

    @property
    def columns(self) -> NDArray[np.uint16]:
        """uint16 [n]: the column of each return's beam, in the order in which they are fired."""
        return self._tensor("column")

    @property
    def instances(self) -> NDArray[np.uint16]:
        """uint16 [n]: the owner of what was hit: 1 the twin, else `Actor.instance`."""
        return self._tensor("instance")

    @property
    def classes(self) -> NDArray[np.uint8]:
        """uint8 [n]: the class of what was hit, an index of `opened.semantics.classes`, if they were asked for."""
        if _of_sweep(self.metadata, "class") not in self._content.tensors:
            raise KeyError("there are no classes: open the session with outputs=Outputs(semantics=True)")
        return self._tensor("class")

    @property
    def times_us(self) -> NDArray[np.float64]:
        """float64 [n]: when each return was measured, in simulated microseconds."""
        sweep = self.metadata
        step = (sweep.end_us - sweep.start_us) / max(sweep.columns - 1, 1)
        return sweep.end_us - (sweep.columns - 1 - self.columns.astype(np.float64)) * step

    @property
    def ranges(self) -> NDArray[np.float32]:
        """float32 [rows, columns]: distance from the LiDAR in metres; 0 for beams without a return."""
        m = self.metadata
        image = np.zeros((m.rows, m.columns), np.float32)
        image[self.rows, self.columns] = np.linalg.norm(self.points - np.array(m.lidar_to_rig.xyz, np.float32), axis=1)
        return image

    def _tensor(self, name: str) -> NDArray[Any]:
        return self._content.tensor(_of_sweep(self.metadata, name))

    def __len__(self) -> int:
        return self.metadata.returns

    def __repr__(self) -> str:
        m = self.metadata
        return f"<PointCloud {m.lidar}: {m.returns} of {m.rows} x {m.columns} beams, to {m.end_us} us>"


class _Sweeps(dict[str, PointCloud]):
    """Sweeps by the names of their LiDARs."""

    def __missing__(self, name: str) -> PointCloud:
        known = ", ".join(self) or "none: open the session with a rig that has one, such as 'vehicle6-lidar'"
        raise KeyError(f"no sweep of a LiDAR {name!r} in this observation; there is {known}")


class _LazyArrays(Mapping[str, NDArray[Any]]):
    """Arrays by camera, made at the first access. `have` says which arrays exist, for errors."""

    def __init__(self, infos: Mapping[str, ImageInfo], make: Callable[[ImageInfo], NDArray[Any]], have: str) -> None:
        self._infos = infos
        self._make = make
        self._have = have
        self._made: dict[str, NDArray[Any]] = {}

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._infos:
            raise KeyError(f"{name!r}: {self._have}")
        if name not in self._made:
            self._made[name] = self._make(self._infos[name])
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._infos)

    def __len__(self) -> int:
        return len(self._infos)


@dataclass(frozen=True)
class _Tensor:
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    start: int
    """Offset of its first byte in the frame."""


class _Content:
    """The bytes of a frame, and the tensors in it."""

    def __init__(self, frame: bytes | memoryview, tensors: dict[str, _Tensor]) -> None:
        self.frame = frame
        self.tensors = tensors

    def tensor(self, name: str) -> NDArray[Any]:
        tensor = self.tensors[name]
        array = np.frombuffer(self.frame, tensor.dtype, math.prod(tensor.shape), tensor.start)
        return array.reshape(tensor.shape)

    def encoded(self, image: ImageInfo) -> memoryview:
        tensor = self.tensors[image.tensor]
        return memoryview(self.frame)[tensor.start : tensor.start + math.prod(tensor.shape)]


def _of_sweep(sweep: Sweep, tensor: str) -> str:
    return f"lidar/{sweep.lidar}/{tensor}"


def _sibling(image: ImageInfo, output: str) -> str:
    """Name of another tensor of an image: `camera/front/rgb` and `depth` give `camera/front/depth`."""
    return image.tensor.removesuffix("rgb") + output


def _decode_image(content: _Content, image: ImageInfo) -> NDArray[np.uint8]:
    if image.encoding == "raw":
        return content.tensor(image.tensor)
    file = BytesIO(content.encoded(image))
    try:
        with Image.open(file, formats=[image.encoding.upper()]) as opened:
            # Checked before decoding, so that a small file cannot cause a large allocation.
            if opened.size != (image.width, image.height):
                raise BadFrame(
                    f"{image.tensor!r} is {opened.width}x{opened.height} px; expected {image.width}x{image.height}"
                )
            pixels = np.asarray(opened.convert("RGB"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise BadFrame(f"{image.tensor!r} cannot be decoded: {error}") from error
    pixels.flags.writeable = False
    return pixels


def _read_layout(frame: bytes | memoryview, key: str) -> tuple[dict[str, _Tensor], str]:
    """The tensors, checked to fill the frame without overlap, and the JSON of that key in `__metadata__`."""
    if len(frame) < 8:
        raise BadFrame(f"the frame ends within its header length, at {len(frame)} bytes")
    (header_bytes,) = struct.unpack_from("<Q", frame)
    if header_bytes > min(len(frame) - 8, HEADER_BYTES):
        raise BadFrame(
            f"the header length is {header_bytes}; the frame has {len(frame) - 8} bytes "
            f"after it, and at most {HEADER_BYTES} are accepted"
        )
    try:
        # Decoded here, because `json` would accept other encodings than UTF-8.
        header = parse_json(bytes(frame[8 : 8 + header_bytes]).decode(), "the header")
    except (ProtocolError, UnicodeDecodeError) as error:
        raise BadFrame(f"the header cannot be read: {error}") from error
    if not isinstance(header, dict):
        raise BadFrame(f"the header is a {type(header).__name__}; expected a JSON object")
    metadata = header.pop("__metadata__", None)
    text = metadata.get(key) if isinstance(metadata, dict) else None
    if not isinstance(text, str):
        raise BadFrame(f"the header's __metadata__ has no {key}")
    return _read_table(header, 8 + header_bytes, len(frame)), text


def _read_table(header: dict[str, Any], data_start: int, frame_bytes: int) -> dict[str, _Tensor]:
    rows = [(_offsets(name, info), name, info) for name, info in header.items()]
    tensors = {}
    end = 0
    for (start, stop), name, info in sorted(rows, key=lambda row: row[0]):
        if start != end:
            raise BadFrame(f"tensor {name!r} has offset {start}, the previous one ends at {end}")
        tensor = _Tensor(_dtype(name, info), _shape(name, info), data_start + start)
        wanted = math.prod(tensor.shape) * tensor.dtype.itemsize
        if stop - start != wanted:
            raise BadFrame(f"tensor {name!r} has {stop - start} bytes; its shape asks for {wanted}")
        tensors[name] = tensor
        end = stop
    if data_start + end != frame_bytes:
        raise BadFrame(f"the tensors end at offset {end}, the frame at {frame_bytes - data_start}")
    return tensors


def _offsets(name: str, info: Any) -> tuple[int, int]:
    offsets = info.get("data_offsets") if isinstance(info, dict) else None
    if not _are_counts(offsets) or len(offsets) != 2 or offsets[0] > offsets[1]:
        raise BadFrame(f"tensor {name!r} has offsets {offsets}; expected [start, end]")
    return offsets[0], offsets[1]


def _shape(name: str, info: dict[str, Any]) -> tuple[int, ...]:
    shape = info.get("shape")
    if not _are_counts(shape):
        raise BadFrame(f"tensor {name!r} has shape {shape}; expected counts")
    return tuple(shape)


def _dtype(name: str, info: dict[str, Any]) -> np.dtype[Any]:
    dtype = info.get("dtype")
    if not isinstance(dtype, str) or dtype not in DTYPES:
        raise BadFrame(f"tensor {name!r} has dtype {dtype!r}; expected {' or '.join(DTYPES)}")
    return DTYPES[dtype]


def _are_counts(values: Any) -> TypeGuard[list[int]]:
    """Whether a value is a list of integers that are not negative. True and False are not integers here."""
    return isinstance(values, list) and all(type(v) is int and v >= 0 for v in values)
