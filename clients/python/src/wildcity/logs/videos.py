"""Frames of videos as PNG, by PyAV: nothing is lost after decoding."""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import av

from .errors import LogError
from .progress import Progress
from .writer import LogWriter

__all__ = ["add_video"]


def add_video(writer: LogWriter, camera: str, video: Path, times: list[int], times_path: Path) -> None:
    """Adds the frames of a video as images of a camera. times: of each frame, in microseconds, increasing."""
    count = 0
    with Progress(f"{camera}, frames", len(times)) as progress:
        for frame in _frames(video):
            if count >= len(times):
                raise LogError(times_path, f"{len(times)} times, but the video has more frames", "download it again")
            if count and times[count] <= times[count - 1]:
                problem = f"the time {times[count]} follows {times[count - 1]}: the clock runs backwards"
                raise LogError(times_path, problem, "download the clip again")
            writer.image_bytes(camera, times[count], ".png", partial(_png, frame))
            count += 1
            progress.step()
    if count != len(times):
        raise LogError(video, f"{count} frames for {len(times)} times", "download it again: it may be cut off")


def _frames(video: Path) -> Iterator[Any]:
    """Frames of a video, decoded one by one."""
    try:
        with av.open(str(video)) as container:
            yield from container.decode(video=0)
    except (av.FFmpegError, IndexError) as error:
        raise LogError(video, f"cannot decode the video: {error}", "download it again") from None


def _png(frame: Any) -> bytes:
    out = io.BytesIO()
    frame.to_image().save(out, "PNG", compress_level=3)
    return out.getvalue()
