"""Plants one fault into each formula of contacts, and says which test or vector notices it.

    python3 tests/sim/plant.py [FILE ..]        (cargo by $CARGO; minutes, most of them for the build)

The exit code is 1 if a fault is not noticed, 2 if the copies do not build.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from plant import Copy, Fault, chosen, planted, run, source

# (file of src/sim/contact, old, new)
FAULTS = [
    (
        "footprint.rs",
        "let gap_m = along_m.abs() - self.radius_m(axis) - other.radius_m(axis);",
        "let gap_m = along_m.abs() - self.radius_m(axis) - 0.9 * other.radius_m(axis);",
    ),
    (
        "footprint.rs",
        "[self.forward, self.left(), other.forward, other.left()]",
        "[self.forward, self.left(), self.forward, self.left()]",
    ),
    ("footprint.rs", "pub const TOUCH_M: f64 = 1e-10;", "pub const TOUCH_M: f64 = 1e-8;"),
    ("footprint.rs", "pub const TOUCH_M: f64 = 1e-10;", "pub const TOUCH_M: f64 = -1e-8;"),
    ("footprint.rs", "ahead_m.hypot(aside_m)", "ahead_m.max(aside_m)"),
    ("footprint.rs", "from_own.chain(from_other)", "from_own.chain(from_other).take(4).map(|d| d + 0.01)"),
    ("footprint.rs", "if gap_m > widest.0", "if gap_m < widest.0 || widest.0 == f64::NEG_INFINITY"),
    ("body.rs", "center.z + size.height_m", "center.z + 2.0 * size.height_m"),
    ("body.rs", "self.is_level_with(other) && self", "self"),
    ("sweep.rs", "first_s.max(times_s[0].min(times_s[1]))", "first_s.min(times_s[0].min(times_s[1]))"),
    ("sweep.rs", "last_s.min(times_s[0].max(times_s[1]))", "last_s.max(times_s[0].max(times_s[1]))"),
    ("sweep.rs", "(last_s >= 0.0).then_some", "(last_s >= -1e9).then_some"),
    ("sweep.rs", "b.velocity_mps - a.velocity_mps", "b.velocity_mps"),
    ("sweep.rs", "if along_m.abs() > reach_m", "if along_m.abs() > 2.0 * reach_m"),
    ("fault.rs", "input.ego_velocity_mps.length() <= STANDING_MPS", "input.ego_velocity_mps.length() <= -1.0"),
    ("fault.rs", "> -input.other_velocity_mps.dot(normal)", ">= -input.other_velocity_mps.dot(normal)"),
    ("fault.rs", "> -input.other_velocity_mps.dot(normal)", "> input.other_velocity_mps.dot(normal)"),
    (
        "fault.rs",
        "Self::StoppedTrack | Self::ActiveFront => true",
        "Self::StoppedTrack => true, Self::ActiveFront => false",
    ),
    ("solid.rs", "SOLID_OPACITY: f64 = 0.5", "SOLID_OPACITY: f64 = 0.3"),
    ("solid.rs", "SIDE_MARGIN_M: f64 = 0.1", "SIDE_MARGIN_M: f64 = 0.0"),
    ("solid.rs", "GROUND_MARGIN_M: f64 = 0.3", "GROUND_MARGIN_M: f64 = 0.1"),
    ("solid.rs", "FREE_AREA_M2: f64 = 0.05", "FREE_AREA_M2: f64 = 0.03"),
    ("solid.rs", "2.0 * self.most_on_drive_m2", "self.most_on_drive_m2"),
    ("solid.rs", "self.opacity * PI * longest", "PI * longest"),
    ("solid.rs", "(a * b).max(a * c).max(b * c)", "(a * b).min(a * c).min(b * c)"),
    ("detector.rs", "MAX_SWEPT_SPEED_MPS: f64 = 60.0", "MAX_SWEPT_SPEED_MPS: f64 = 1e9"),
    ("detector.rs", "MAX_SWEPT_SPEED_MPS: f64 = 60.0", "MAX_SWEPT_SPEED_MPS: f64 = 0.0"),
    ("detector.rs", "&& !touched_before", ""),
    ("detector.rs", "contact.at_start = true;", ""),
]


def copy(fault: Fault) -> Copy:
    folder = Path(__file__).resolve().parents[2] / "src" / "sim" / "contact"
    files = {}
    for path in folder.glob("*.rs"):
        text = path.read_text()
        if path.name == fault.file:
            text = planted(text, fault)
        files[path.name] = text.replace("crate::traffic", "wildcity_sim::traffic")
    return Copy(files, source("tests/sim/contact.rs").replace("wildcity_sim::contact", "super::mutant"))


def main() -> int:
    faults = [Fault(*fault) for fault in chosen(FAULTS)]
    return run("sim", faults, [copy(fault) for fault in faults])


if __name__ == "__main__":
    sys.exit(main())
