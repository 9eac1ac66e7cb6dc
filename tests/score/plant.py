"""Plants one fault into each formula of the score package, and says which test or vector notices it.

    python3 tests/score/plant.py [FILE ..]      (cargo by $CARGO; minutes, most of them for the build)

The exit code is 1 if a fault is not noticed, 2 if the copies do not build.
"""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from plant import Copy, Fault, chosen, planted, run, source

# (file, tests, old, new)
FAULTS = [
    ("neuroncap.rs", "others.rs", "const FREE: f64 = 5.0", "const FREE: f64 = 4.0"),
    ("neuroncap.rs", "others.rs", "const TOUCHED: f64 = 4.0", "const TOUCHED: f64 = 5.0"),
    ("neuroncap.rs", "others.rs", "(1.0 - impact_mps / reference_mps).max(0.0)", "(1.0 - impact_mps / reference_mps)"),
    (
        "neuroncap.rs",
        "others.rs",
        "(ego_velocity_mps - actor_velocity_mps).length()",
        "ego_velocity_mps.length() - actor_velocity_mps.length()",
    ),
    ("neuroncap.rs", "others.rs", "center_x_m: 0.5", "center_x_m: 1.5"),
    ("bench2drive.rs", "others.rs", "Self::Pedestrian => 0.5", "Self::Pedestrian => 0.6"),
    ("bench2drive.rs", "others.rs", "Self::Vehicle => 0.6", "Self::Vehicle => 0.65"),
    ("bench2drive.rs", "others.rs", "Self::Static => 0.65", "Self::Static => 0.6"),
    ("bench2drive.rs", "others.rs", "(1.0 - outside_percent / 100.0)", "1.0"),
    ("bench2drive.rs", "others.rs", "infraction == Infraction::MinSpeed", "infraction == Infraction::RedLight"),
    ("bench2drive.rs", "others.rs", "&& outside_percent == 0.0", ""),
    ("bench2drive.rs", "others.rs", "const MOST_PERCENT: f64 = 1000.0", "const MOST_PERCENT: f64 = 2000.0"),
    ("bench2drive.rs", "others.rs", "samples.chunks_exact(SEGMENT)", "samples.chunks(SEGMENT)"),
    ("bench2drive.rs", "others.rs", "const FILTER: (usize, usize) = (7, 2)", "const FILTER: (usize, usize) = (3, 2)"),
    ("bench2drive.rs", "others.rs", "least < a && a < most", "a < most"),
    ("hugsim.rs", "hugsim.rs", "const STATIC_POINTS: usize = 100", "const STATIC_POINTS: usize = 99"),
    ("hugsim.rs", "hugsim.rs", "from_center.dot(forward).abs() < 0.5", "from_center.dot(forward).abs() <= 0.5"),
    ("hugsim.rs", "hugsim.rs", "0.0 < above_m", "-1.0 < above_m"),
    ("hugsim.rs", "hugsim.rs", "share < 0.3", "share < 0.2"),
    ("hugsim.rs", "hugsim.rs", "(5.0 * self.ttc + 2.0 * self.c) / 7.0", "(2.0 * self.ttc + 5.0 * self.c) / 7.0"),
    ("hugsim.rs", "hugsim.rs", "[0.5, 1.0].iter().any", "[0.5].iter().any"),
    ("hugsim.rs", "hugsim.rs", "const SHORT_PLAN_M: f64 = 1.0", "const SHORT_PLAN_M: f64 = 0.1"),
    ("hugsim.rs", "hugsim.rs", "(least..=most).contains(a)", "true || a > &least || a < &most"),
    ("hugsim.rs", "hugsim.rs", "(nearest_camera + 1) as f64", "nearest_camera as f64"),
    (
        "hugsim.rs",
        "hugsim.rs",
        "completions.iter().fold(0.0, |most: f64, &rc| most.max(rc))",
        "completions[completions.len() - 1]",
    ),
    ("navsim/rules.rs", "navsim.rs", "const DIRECTION_WINDOW: usize = 11", "const DIRECTION_WINDOW: usize = 10"),
    ("navsim/rules.rs", "navsim.rs", "[2.0, 6.0]", "[2.0, 5.0]"),
    ("navsim/rules.rs", "navsim.rs", "const SHORT_REFERENCE_M: f64 = 5.0", "const SHORT_REFERENCE_M: f64 = 4.9"),
    ("navsim/rules.rs", "navsim.rs", "[0, 3, 6, 9]", "[0, 3, 6, 8]"),
    ("navsim/rules.rs", "navsim.rs", "if speed_mps < TTC_STANDING_MPS", "if speed_mps < -TTC_STANDING_MPS"),
    ("navsim/rules.rs", "navsim.rs", "const AHEAD_RAD: f64 = 30.0", "const AHEAD_RAD: f64 = 10.0"),
    ("navsim/rules.rs", "navsim.rs", "const LANE_KEEPING_M: f64 = 0.5", "const LANE_KEEPING_M: f64 = 0.6"),
    (
        "navsim/rules.rs",
        "navsim.rs",
        "const LANE_KEEPING_SAMPLES: usize = 20",
        "const LANE_KEEPING_SAMPLES: usize = 19",
    ),
    ("navsim/rules.rs", "navsim.rs", "{ 0.0 } else { 0.5 });", "{ 0.0 } else { 0.0 });"),
    ("navsim/rules.rs", "navsim.rs", "lanes.iter().any(|lanes| lanes.off_drivable)", "false"),
    (
        "navsim/rules.rs",
        "navsim.rs",
        "let lights = if red { 0.0 } else { 1.0 };",
        "let lights = if red { 1.0 } else { 1.0 };",
    ),
    (
        "navsim/rules.rs",
        "navsim.rs",
        "scene.reference_progress_m.max(way_m * gate)",
        "scene.reference_progress_m.max(1e3 * gate)",
    ),
    (
        "navsim/rules.rs",
        "navsim.rs",
        "kind.is_at_fault_in(lanes[step])",
        "kind.is_at_fault_in(LanePosition::default())",
    ),
    (
        "navsim/rules.rs",
        "navsim.rs",
        "                ignored[k] = true;\n            }\n        }\n    }\n    found",
        "                found.score = 0.25;\n            }\n        }\n    }\n    found",
    ),
    ("navsim/comfort.rs", "navsim.rs", "+ center_x_m * rate * rate", "- center_x_m * rate * rate"),
    ("navsim/comfort.rs", "navsim.rs", "+ center_x_m * ego.yaw_acceleration_radps2", ""),
    ("navsim/comfort.rs", "navsim.rs", "n.min(8), 2", "n.min(7), 2"),
    ("navsim/comfort.rs", "navsim.rs", "n.min(15), 2", "n.min(9), 2"),
    ("navsim/comfort.rs", "navsim.rs", "low < value && value < high", "low <= value && value <= high"),
    ("navsim/comfort.rs", "navsim.rs", "[-4.05, 2.40]", "[-4.05, 3.60]"),
    ("navsim/comfort.rs", "navsim.rs", "of_yaw(2, 1)", "of_yaw(3, 2)"),
    ("navsim/comfort.rs", "navsim.rs", "angle - std::f64::consts::TAU * turns\n", "angle\n"),
    ("navsim/comfort.rs", "navsim.rs", "[0.7, 0.5, 0.1, 0.1]", "[0.9, 0.5, 0.1, 0.1]"),
    ("navsim/comfort.rs", "navsim.rs", "(squares / one.len() as f64).sqrt()", "squares / one.len() as f64"),
    ("navsim/mod.rs", "navsim.rs", "+ 2.0 * agent.ec", "+ 2.0 * filtered(agent.ec, human.ec)"),
    ("navsim/mod.rs", "navsim.rs", "if human == 0.0 { 1.0 }", "if human <= 0.5 { 1.0 }"),
    ("navsim/mod.rs", "navsim.rs", "rules * weighted / 16.0", "rules * weighted / 17.0"),
    ("navsim/mod.rs", "navsim.rs", "* filtered(agent.ddc, human.ddc)", ""),
    ("navsim/mod.rs", "navsim.rs", "5.0 * filtered(agent.ep, human.ep)", "4.0 * filtered(agent.ep, human.ep)"),
    ("statistics.rs", "statistics.rs", "1.959_963_984_540_054", "1.645"),
    ("statistics.rs", "statistics.rs", "(n - 1) as f64).sqrt()", "n as f64).sqrt()"),
    ("statistics.rs", "statistics.rs", "student_t(n - 1)", "student_t(n)"),
    ("statistics.rs", "statistics.rs", "(self.mean - half_width).max(least)", "self.mean - half_width + 0.0 * least"),
    ("statistics.rs", "statistics.rs", "(self.mean + half_width).min(most)", "self.mean + half_width + most.min(0.0)"),
    ("statistics.rs", "statistics.rs", "const LEAST_VALUES: usize = 3", "const LEAST_VALUES: usize = 2"),
    (
        "bench2drive.rs",
        "others.rs",
        "Self::RedLight | Self::ScenarioTimeout | Self::Yield => 0.7",
        "Self::RedLight | Self::ScenarioTimeout | Self::Yield => 0.8",
    ),
    ("bench2drive.rs", "others.rs", "Self::Stop => 0.8", "Self::Stop => 0.7"),
]
# Of files that several others use, with the tests of whole episodes: the whole package is copied.
WHOLE_FAULTS = [
    ("alpasim.rs", "others.rs", "const FULL_PROGRESS: f64 = 0.8", "const FULL_PROGRESS: f64 = 0.9"),
    ("alpasim.rs", "others.rs", "const SHORT_RECORDING_M: f64 = 5.0", "const SHORT_RECORDING_M: f64 = 4.0"),
    ("alpasim.rs", "others.rs", "rollout.collision_at_fault || rollout.offroad", "rollout.collision_at_fault"),
    ("alpasim.rs", "others.rs", "rollout.collision_at_fault || rollout.offroad", "rollout.offroad"),
    ("alpasim.rs", "others.rs", "rollout.progress.clamp(0.0, 1.0)", "rollout.progress"),
    ("alpasim.rs", "others.rs", ".min(1.0)\n}", "\n}"),
    ("alpasim.rs", "others.rs", "sides.last().copied()", "sides.first().copied()"),
    ("alpasim.rs", "others.rs", "if ego.front_line().touches(other)", "if ego.rear_line().touches(other)"),
    ("alpasim.rs", "others.rs", "self != Self::Rear", "self == Self::Front"),
    ("alpasim_plans.rs", "others.rs", "(-decay * k as f64).exp()", "(-decay * (k * k) as f64).exp()"),
    ("alpasim_plans.rs", "plans.rs", "const DECAY: f64 = 0.1", "const DECAY: f64 = 0.2"),
    ("alpasim_plans.rs", "plans.rs", "const HORIZON_US: i64 = 3_000_000", "const HORIZON_US: i64 = 2_900_000"),
    ("alpasim_plans.rs", "plans.rs", "const HORIZON_US: i64 = 3_000_000", "const HORIZON_US: i64 = 3_100_000"),
    ("alpasim_plans.rs", "plans.rs", "[500_000, 1_000_000", "[400_000, 1_000_000"),
    ("alpasim_plans.rs", "plans.rs", "1_000_000, 2_500_000", "1_100_000, 2_500_000"),
    ("alpasim_plans.rs", "plans.rs", "2_500_000, 5_000_000]", "2_400_000, 5_000_000]"),
    ("alpasim_plans.rs", "plans.rs", "2_500_000, 5_000_000]", "2_500_000, 4_900_000]"),
    ("alpasim_plans.rs", "plans.rs", "pose.time_us <= before.end_us()", "pose.time_us < before.end_us()"),
    ("alpasim_plans.rs", "plans.rs", "self.shape.center_x_m * DVec2::from_angle", "0.0 * DVec2::from_angle"),
    ("alpasim_plans.rs", "plans.rs", "pose.time_us <= until_us", "pose.time_us < until_us"),
    ("alpasim_plans.rs", "plans.rs", "(delta_us + dt_us - 1) / dt_us", "delta_us / dt_us"),
    ("alpasim_plans.rs", "plans.rs", "longest_us.min(self.record.end_us())", "longest_us"),
    ("alpasim_plans.rs", "plans.rs", ".min(recorded_us)", ""),
    ("alpasim_plans.rs", "plans.rs", "plan.decided_us() <= cut_us", "plan.decided_us() < cut_us"),
    ("alpasim_plans.rs", "plans.rs", "(1..=steps)", "(0..steps)"),
    ("alpasim_plans.rs", "plans.rs", "from.center_m.lerp(to.center_m, t)", "from.center_m"),
    ("alpasim_plans.rs", "plans.rs", "ego.distance_m(&other) <= 0.0", "ego.distance_m(&other) <= 0.1"),
    ("alpasim_plans.rs", "plans.rs", "ahead.peek()?;", ""),
    ("plan.rs", "plans.rs", "&self.poses[1..]", "&self.poses[..]"),
    ("plan.rs", "plans.rs", "turn - TAU * (turn / TAU).round()", "turn"),
    ("plan.rs", "plans.rs", "from.origin_m.lerp(to.origin_m, t)", "from.origin_m"),
    ("alpasim_road.rs", "plans.rs", "const EDGE_M: f64 = 1e-3", "const EDGE_M: f64 = 1e-4"),
    ("alpasim_road.rs", "plans.rs", "const EDGE_M: f64 = 1e-3", "const EDGE_M: f64 = 2e-3"),
    ("alpasim_road.rs", "plans.rs", "PI * 2.0 / 3.0", "PI / 2.0"),
    ("alpasim_road.rs", "plans.rs", "const HEADING_M: f64 = 0.01", "const HEADING_M: f64 = 1.0"),
    (
        "alpasim_road.rs",
        "plans.rs",
        "((ahead_m - behind_m).to_angle() - ego_rad).abs()",
        "turn_rad(ego_rad, (ahead_m - behind_m).to_angle()).abs()",
    ),
    ("alpasim_road.rs", "plans.rs", "lane.contains(center_m) && ", ""),
    ("alpasim_road.rs", "plans.rs", "!hold(&near, ego) && near", "near"),
    ("alpasim_road.rs", "plans.rs", "const SEAM_M: f64 = 0.2", "const SEAM_M: f64 = 2.0"),
    ("alpasim_road.rs", "plans.rs", "const SEAM_M: f64 = 0.2", "const SEAM_M: f64 = 0.05"),
    ("alpasim_road.rs", "plans.rs", "a_m.dot(*b_m) < 0.0 && ", ""),
    (
        "alpasim_road.rs",
        "plans.rs",
        "beside_m.all(|point_m| is_on_road(lanes, point_m))",
        "true || beside_m.next().is_none()",
    ),
    ("alpasim_road.rs", "plans.rs", ".filter(|&at_m| ego.holds(at_m))", ""),
    (
        "alpasim_road.rs",
        "plans.rs",
        "within_m.distance(point_m) <= reach_m",
        "within_m.distance(point_m) <= 0.0 * reach_m",
    ),
    ("alpasim_road.rs", "plans.rs", "turn_rad(0.0, yaw_rad)", "yaw_rad"),
    ("alpasim_box.rs", "plans.rs", "self.radius_m * (angle_rad", "0.0 * (angle_rad"),
    ("alpasim.rs", "plans.rs", "record.dt_us * step as i64", "record.dt_us * (step as i64 + 1)"),
    ("alpasim.rs", "plans.rs", "wrong || drive.wrong_lane == Some(true)", "wrong"),
    ("map.rs", "plans.rs", "side(&self.outline_m, point_m) != Side::Outside", "self.outline_m.len() > 99"),
    ("map.rs", "plans.rs", "a + share.clamp(0.0, 1.0) * way", "a"),
    ("polyline.rs", "plans.rs", "(a.lerp(b, t), (b - a) / length_m)", "(a, (b - a) / length_m)"),
    ("own.rs", "episodes.rs", "progress < record.least_progress", "progress <= record.least_progress"),
    ("own.rs", "episodes.rs", "(way_m / recorded_m).clamp(0.0, 1.0)", "(way_m / recorded_m * 1.1).clamp(0.0, 1.0)"),
    ("own.rs", "episodes.rs", "const LEAST_WAY_M: f64 = 2.0", "const LEAST_WAY_M: f64 = 0.0"),
    (
        "own.rs",
        "episodes.rs",
        "(Some(ActorClass::Pedestrian), _) if moves",
        "(Some(ActorClass::Pedestrian), _) if true",
    ),
    ("own.rs", "episodes.rs", "(_, true) => Fault::ContactAtFault", "(_, true) => return None"),
    ("own.rs", "episodes.rs", "(_, false) => return None", "(_, false) => Fault::ContactAtFault"),
    (
        "own.rs",
        "episodes.rs",
        "let judged = record.contacts.iter().filter(|contact| !contact.at_start);",
        "let judged = record.contacts.iter();",
    ),
    ("own.rs", "episodes.rs", "off_us < fault_us", "off_us <= fault_us"),
    ("own.rs", "episodes.rs", "fault: Fault::Static,", "fault: Fault::OffRoad,"),
    (
        "own.rs",
        "episodes.rs",
        "map.position(&shape.footprint(sample)).off_drivable",
        "map.position(&shape.footprint(sample)).in_multiple_lanes",
    ),
    (
        "own.rs",
        "episodes.rs",
        "time_to_contact_s(&own, &other)\n        })\n    };\n    (0..record.ego.len()).flat_map(at).reduce(f64::min)",
        "time_to_contact_s(&own, &other)\n        })\n    };\n    (0..record.ego.len()).flat_map(at).reduce(f64::max)",
    ),
    ("own.rs", "episodes.rs", "ego.velocity_mps.x * ego.yaw_rate_radps", "ego.velocity_mps.y * ego.yaw_rate_radps"),
    ("own.rs", "episodes.rs", "most(&|ego| ego.acceleration_mps2.x)", "most(&|ego| ego.acceleration_mps2.y)"),
    (
        "own.rs",
        "episodes.rs",
        "impacts.map(|contact| contact.impact_mps).reduce(f64::max)",
        "impacts.map(|contact| contact.impact_mps).reduce(f64::min)",
    ),
    ("bench2drive.rs", "episodes.rs", "contact.time_us - time_us < SAME_CONTACT_US || ", ""),
    ("bench2drive.rs", "episodes.rs", "is_same || contact.ego_velocity_mps.length() < STANDING_MPS", "is_same"),
    ("bench2drive.rs", "episodes.rs", "100.0 * outside_m / way_m", "outside_m / way_m"),
    ("bench2drive.rs", "episodes.rs", "100.0 * mean(&ego_mps) / traffic", "100.0 * traffic / mean(&ego_mps)"),
    (
        "neuroncap.rs",
        "episodes.rs",
        "Ok(stars(impact_mps, reference_mps.unwrap_or(f64::INFINITY)))",
        "Ok(stars(None, reference_mps.unwrap_or(f64::INFINITY)))",
    ),
    ("neuroncap.rs", "episodes.rs", "ActorClass::Pedestrian | ActorClass::Object", "ActorClass::Pedestrian"),
    ("all.rs", "episodes.rs", "neuroncap::NAME => [0.0, neuroncap::FREE]", "neuroncap::NAME => [0.0, 1.0]"),
    ("all.rs", "episodes.rs", "hugsim::NAME | bench2drive::SUCCESS", "bench2drive::SUCCESS"),
    ("alpasim.rs", "episodes.rs", "const CUT_M: f64 = 4.0", "const CUT_M: f64 = 400.0"),
    ("alpasim_box.rs", "episodes.rs", "const BOX_SHARE: f64 = 0.98", "const BOX_SHARE: f64 = 1.0"),
    ("alpasim_box.rs", "episodes.rs", "const CORNER_SHARE: f64 = 0.25", "const CORNER_SHARE: f64 = 0.0"),
    (
        "record.rs",
        "episodes.rs",
        "let t = (time_us - before_us) as f64 / (after_us - before_us) as f64;",
        "let t = 0.0;",
    ),
    ("record.rs", "episodes.rs", "station_m - 5.0, station_m + 50.0", "station_m - 5.0, station_m + 1e9"),
    (
        "polyline.rs",
        "navsim.rs",
        "let station_m = self.stations_m[k - 1] + ahead_m;",
        "let station_m = self.stations_m[k - 1] + 0.9 * ahead_m;",
    ),
    (
        "polyline.rs",
        "navsim.rs",
        "(start + ahead_m * along).distance(point_m)",
        "(start + 0.5 * ahead_m * along).distance(point_m)",
    ),
    ("map.rs", "navsim.rs", "lanes_with_corners > 1 && !one_holds_all", "lanes_with_corners > 1"),
    ("map.rs", "navsim.rs", "in_any.contains(&false)", "!in_any.contains(&true)"),
    ("map.rs", "navsim.rs", "(across > 0.0) == (b.y > a.y)", "across > 0.0"),
    ("map.rs", "navsim.rs", "lane.is_on_route || lane.is_intersection", "true"),
    ("map.rs", "navsim.rs", "corner_inside || edge_touches", "false"),
    (
        "savgol.rs",
        "navsim.rs",
        "let samples_before = if window.is_multiple_of(2) { half - 1 } else { half };",
        "let samples_before = half;",
    ),
    ("savgol.rs", "navsim.rs", "let scale = delta.powi(derivative as i32);", "let scale = 1.0;"),
    ("savgol.rs", "navsim.rs", "factor as f64 * x.powi", "x.powi"),
    ("savgol.rs", "navsim.rs", "at_edge = weights(window, i as f64, order, derivative);", "at_edge = inner.clone();"),
]


def family(fault: Fault, tests: str) -> Copy:
    """A copy of one score's files; the other files are those of the package."""
    name = fault.file.split("/")[0].removesuffix(".rs")
    paths = ["mod.rs", "rules.rs", "comfort.rs"] if name == "navsim" else ["mod.rs"]
    files = {}
    for path in paths:
        file = f"navsim/{path}" if name == "navsim" else fault.file
        text = source(f"src/score/{file}")
        if file == fault.file:
            text = planted(text, fault)
        text = re.sub(r"\b(?:crate|super)::(?:record|savgol|polyline|map|scored)::", "wildcity_score::", text)
        files[path] = text.replace("use super::navsim::bounds;", "use wildcity_score::navsim::bounds;")
    text = re.sub(rf"\bwildcity_score::{name}\b", "super::mutant", source(f"tests/score/{tests}"))
    of_family = "super::mutant as neuroncap" if name == "neuroncap" else "wildcity_score::neuroncap"
    text = text.replace(
        "use wildcity_score::{EgoSample, alpasim_plans, neuroncap};",
        f"use wildcity_score::{{EgoSample, alpasim_plans}};\nuse {of_family};",
    )
    text = re.sub(r"use super::mutant::\{\s*self, ", f"use super::mutant as {name};\nuse super::mutant::{{", text)
    return Copy(files, text)


def whole(fault: Fault, tests: str, module: str) -> Copy:
    """A copy of the package."""
    folder = Path(__file__).resolve().parents[2] / "src" / "score"
    files = {}
    for path in folder.rglob("*.rs"):
        file = str(path.relative_to(folder))
        text = path.read_text()
        if file == fault.file:
            text = planted(text, fault)
        text = re.sub(r"#\[cfg\(test\)\]\nmod tests \{.*", "", text, flags=re.DOTALL)
        text = re.sub(r"\bcrate::", f"crate::planted::{module}::mutant::", text)
        files["mod.rs" if file == "lib.rs" else file] = re.sub(r"^//!.*\n", "", text, flags=re.MULTILINE)
    return Copy(files, re.sub(r"\bwildcity_score\b", "super::mutant", source(f"tests/score/{tests}")))


def main() -> int:
    faults, copies = [], []
    for file, tests, old, new in chosen(FAULTS):
        faults.append(Fault(file, old, new))
        copies.append(family(faults[-1], tests))
    for file, tests, old, new in chosen(WHOLE_FAULTS):
        faults.append(Fault(file, old, new))
        copies.append(whole(faults[-1], tests, f"m{len(copies):03}"))
    return run("score", faults, copies)


if __name__ == "__main__":
    sys.exit(main())
