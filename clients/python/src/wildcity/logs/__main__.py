"""The command line of `wildcity.logs`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from . import KINDS, LogError, Options, Report, convert, detect
from .kinds import named

_ABOUT = """Converts a log of a data set, or a bag, to a folder of the format wildcity.log/1.

The kind is found by the content of SOURCE. Nothing is resampled: all rows have the times at which they were recorded.
Images are copied byte for byte. What of the source the log does not have is printed, and listed in log.json. A run
that was killed goes on when the same command is given again; OUT exists only when it is whole."""

_EXAMPLES = """examples:
  python -m wildcity.logs data/nuscenes --list
  python -m wildcity.logs data/nuscenes --log scene-0061 --out scene-0061
  python -m wildcity.logs data/nuscenes --log scene-0061 --out scene-0061 --reference
  python -m wildcity.logs drive.mcap --out drive
  wildcity log check scene-0061                       (then: what a twin needs and lacks)

kinds:
"""


def _parser() -> argparse.ArgumentParser:
    kinds = "".join(f"  {kind.name:<14} {kind.title}: {kind.looks}\n" for kind in KINDS)
    parser = argparse.ArgumentParser(prog="python -m wildcity.logs", description=_ABOUT, epilog=_EXAMPLES + kinds)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("source", type=Path, metavar="SOURCE", help="folder or file of the data set or the bag")
    wanted = parser.add_mutually_exclusive_group(required=True)
    wanted.add_argument("--out", type=Path, metavar="OUT", help="folder of the log; it must not exist")
    wanted.add_argument("--list", action="store_true", help="print the names of the logs in SOURCE, for --log")
    parser.add_argument("--kind", choices=[kind.name for kind in KINDS], help="kind of the source, if it is not found")
    parser.add_argument("--log", metavar="NAME", help="which log of the source: a scene, a drive or a segment")
    parser.add_argument("--reference", action="store_true", help="name the images where they lie, and copy none")
    parser.add_argument("--rig", type=Path, metavar="FILE", help="rig file or calibration, of poses and bags")
    parser.add_argument("--pose-of", choices=["rig", "camera"], help="of poses: whose they are (rig, unless set)")
    parser.add_argument("--rate", type=float, metavar="HZ", help="images a second, of cameras.json without times")
    origin = "of maps in degrees: LATITUDE,LONGITUDE[,ALTITUDE] of the twin's origin"
    parser.add_argument("--origin", type=_place, metavar="PLACE", help=origin)
    bags = parser.add_argument_group("bags")
    bags.add_argument("--rig-frame", metavar="FRAME", help="frame of the vehicle (else base_footprint, base_link, ..)")
    bags.add_argument("--world-frame", metavar="FRAME", help="frame of the world (else the root of tf)")
    bags.add_argument("--odometry", metavar="TOPIC", help="the Odometry topic that gives the poses, of several")
    bags.add_argument("--leave-out", metavar="TOPIC", action="append", default=[], help="a topic that is not converted")
    parser.add_argument("--licence", metavar="TEXT", help="note on the licence, for log.json")
    return parser


def _place(text: str) -> tuple[float, float, float]:
    """LATITUDE,LONGITUDE[,ALTITUDE]. Raises `ValueError`, of which argparse makes a usage error."""
    latitude, longitude, *rest = (float(part) for part in text.split(","))
    if not (abs(latitude) < 90 and abs(longitude) <= 180 and len(rest) < 2):
        raise ValueError(text)
    return latitude, longitude, rest[0] if rest else 0.0


def _print(report: Report) -> None:
    rows = ", ".join(f"{count} rows of {table}" for table, count in report.rows.items())
    print(f"{report.out}: {rows}")
    if report.resumed:
        print(f"went on: {report.resumed} files were whole")
    for gap in report.gaps:
        print(f"gap: {gap}")
    for sentence in report.left_out:
        print(f"left out: {sentence}")
    if "poses" in report.rows:
        print(f"next: wildcity log check {report.out}")


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit code: 0, 1 if the source cannot be converted, 2 (by argparse) if the arguments are wrong."""
    chosen = _parser().parse_args(arguments)
    try:
        kind = named(chosen.kind) if chosen.kind else detect(chosen.source)
        if not chosen.kind:
            print(f"{chosen.source}: {kind.title}", file=sys.stderr)
        if chosen.list:
            print("\n".join(kind.converter().logs(chosen.source)))
            return 0
        names = ("log", "rig_frame", "world_frame", "odometry", "pose_of", "licence")
        given = {name: getattr(chosen, name) for name in names}
        values = {**given, "leave_out": ", ".join(chosen.leave_out)}
        options = Options(
            reference=chosen.reference,
            rig=chosen.rig,
            origin=chosen.origin,
            rate=chosen.rate,
            values=values,
            leave_out=tuple(chosen.leave_out),
            **given,
        )
        _print(convert(chosen.source, chosen.out, options, kind.name))
    except LogError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        # Of a disk that is full or a file that may not be read, wherever it happens: the next run goes on.
        print(f"error: {error}; make space or change the rights, and run the command again", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stopped: the same command goes on", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
