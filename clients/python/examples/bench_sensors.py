"""Cost of the effects of sensors: processor time of the server for one step with each of them, against one without.

    python bench_sensors.py WS_URL SERVER_PID [ROUNDS]

Every way is a session of the twin `demo` with six raw images of `vehicle6`. In each round every way has one step of the
same action, in turn. Linux only.
"""

import statistics
import sys
import time
from pathlib import Path

import wildcity
from wildcity import CameraSensor, Sensors

CAMERAS = ("front", "front_left", "front_right", "left", "right", "rear")
NOISE = wildcity.ImageNoise(full_well=5000, read=8)
EXPOSURE = wildcity.ExposureDrift(stops=0.25, period_us=2_000_000)
DIRT = wildcity.LensDirt(spots=12, radius=0.04, opacity=0.75)
LATE = wildcity.LateFrames(chance=0.1, by_us=100_000)
FREEZE = wildcity.FrozenFrames(chance=0.01, for_us=1_000_000)
IMU = wildcity.Imu(wildcity.AxisNoise(0.02, 0.05), wildcity.AxisNoise(0.002, 0.001))
WHEELS = wildcity.WheelSpeed(noise=0.05, scale=0.01)


def on_all(camera: CameraSensor) -> Sensors:
    return Sensors(cameras=dict.fromkeys(CAMERAS, camera))


WAYS: dict[str, Sensors | None] = {
    "off": None,
    "off, again": None,
    "noise": on_all(CameraSensor(noise=NOISE)),
    "exposure": on_all(CameraSensor(exposure=EXPOSURE)),
    "dirt": on_all(CameraSensor(dirt=DIRT)),
    "lost, late and frozen frames": on_all(CameraSensor(drop=0.02, late=LATE, freeze=FREEZE)),
    "imu and wheel_speed": Sensors(imu=IMU, wheel_speed=WHEELS),
    "delay_us": Sensors(delay_us=200_000),
}


def processor_ms(pid: int) -> float:
    """Processor time of all threads of a process that still run."""
    files = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(file.read_text().split()[0]) for file in files) / 1e6


def main(url: str, pid: int, rounds: int) -> None:
    took: dict[str, list[float]] = {way: [] for way in WAYS}
    with wildcity.connect(url) as client:
        raw = wildcity.Outputs(encoding="raw")
        sessions = {
            way: client.open(
                "demo", session=f"way-{k}", rig="vehicle6", outputs=raw, dynamics="kinematic", sensors=sensors
            )
            for k, (way, sensors) in enumerate(WAYS.items())
        }
        for session in sessions.values():
            session.reset(seed=1)
        ways = list(WAYS)
        for number in range(rounds):
            first = number % len(ways)
            for way in ways[first:] + ways[:first]:
                before = processor_ms(pid)
                sessions[way].step(wildcity.Action(0.5, 0.005))
                time.sleep(0.02)  # For what the server does after its answer.
                took[way].append(processor_ms(pid) - before)
    for way, ms in took.items():
        ratios = sorted(one / off for one, off in zip(ms, took["off"], strict=True))
        quarter = len(ratios) // 4
        print(
            f"{way}: {statistics.median(ms):.1f} ms, ratio {statistics.median(ratios):.3f} "
            f"({ratios[quarter]:.3f} to {ratios[-1 - quarter]:.3f})"
        )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 12)
