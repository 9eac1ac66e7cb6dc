"""Drive a city twin: poses out, camera images in.

`connect` returns a blocking client, and `wildcity.aio.connect` returns the same client for asyncio. All numbers are
in SI units, or have their unit in their name. Frames and conventions are in `protocol/README.md` of the project.
"""

from importlib.metadata import version as _version

from .drives import RecordedDrive, recorded_drive
from .errors import (
    BadFrame,
    Code,
    ConnectFailed,
    Disconnected,
    ProtocolError,
    PushFailed,
    Refused,
    TimedOut,
    WildCityError,
)
from .observation import Observation, View
from .protocol import (
    Action,
    Camera,
    Dynamics,
    Ego,
    Exposure,
    ImageInfo,
    ImagePart,
    Lens,
    Metadata,
    Opened,
    Outputs,
    Pose,
    Resumed,
    Rig,
    Shutter,
    Station,
    Summary,
    Switched,
    TimedPose,
    Trajectory,
    TrajectoryInfo,
    Trust,
    TwinInfo,
    Welcome,
    Windshield,
    png_data_uri,
)
from .pushing import Push, PushProgress, push, rollback
from .serving import LocalServer, ServeFailed, serve
from .sync import Client, Session, connect

__version__ = _version("wildcity")

__all__ = [
    "Action",
    "BadFrame",
    "Camera",
    "Client",
    "Code",
    "ConnectFailed",
    "Disconnected",
    "Dynamics",
    "Ego",
    "Exposure",
    "ImageInfo",
    "ImagePart",
    "Lens",
    "LocalServer",
    "Metadata",
    "Observation",
    "Opened",
    "Outputs",
    "Pose",
    "ProtocolError",
    "Push",
    "PushFailed",
    "PushProgress",
    "RecordedDrive",
    "Refused",
    "Resumed",
    "Rig",
    "ServeFailed",
    "Session",
    "Shutter",
    "Station",
    "Summary",
    "Switched",
    "TimedOut",
    "TimedPose",
    "Trajectory",
    "TrajectoryInfo",
    "Trust",
    "TwinInfo",
    "View",
    "Welcome",
    "WildCityError",
    "Windshield",
    "connect",
    "png_data_uri",
    "push",
    "recorded_drive",
    "rollback",
    "serve",
]
