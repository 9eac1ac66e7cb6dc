"""Drive a city twin: poses out, camera images in.

`connect` gives a blocking client; `wildcity.aio.connect` the same for asyncio. Everything is in SI
units; frames and conventions are in `protocol/README.md` of the project.
"""

from importlib.metadata import version as _version

from .errors import (
    BadFrame,
    Code,
    ConnectFailed,
    Disconnected,
    ProtocolError,
    Refused,
    TimedOut,
    WildCityError,
)
from .observation import Observation, View
from .protocol import (
    Camera,
    Ego,
    ImageInfo,
    Metadata,
    Opened,
    Outputs,
    Pose,
    Resumed,
    Rig,
    Station,
    Summary,
    TrajectoryInfo,
    TwinInfo,
    Welcome,
)
from .sync import Client, Session, connect

__version__ = _version("wildcity")

__all__ = [
    "BadFrame",
    "Camera",
    "Client",
    "Code",
    "ConnectFailed",
    "Disconnected",
    "Ego",
    "ImageInfo",
    "Metadata",
    "Observation",
    "Opened",
    "Outputs",
    "Pose",
    "ProtocolError",
    "Refused",
    "Resumed",
    "Rig",
    "Session",
    "Station",
    "Summary",
    "TimedOut",
    "TrajectoryInfo",
    "TwinInfo",
    "View",
    "Welcome",
    "WildCityError",
    "connect",
]
