"""Plants one fault into each formula of the eval package, and says which test notices it.

    python3 tests/eval/plant.py [FILE ..]      (cargo by $CARGO; minutes, most of them for the build)

The exit code is 1 if a fault is not noticed, 2 if the copies do not build.
"""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from plant import Copy, Fault, chosen, planted, run, source

# (file of src/eval, old, new)
FAULTS = [
    ("boxes.rs", "pub const MOVES_M_PER_S: f64 = 1.0", "pub const MOVES_M_PER_S: f64 = 1.1"),
    ("boxes.rs", "pub const GROWN_PX: f64 = 3.0", "pub const GROWN_PX: f64 = 2.0"),
    ("boxes.rs", "const LARGEST_GAP_US: i64 = 1_000_000", "const LARGEST_GAP_US: i64 = 2_000_000"),
    ("boxes.rs", "const LARGEST_GAP_US: i64 = 1_000_000", "const LARGEST_GAP_US: i64 = 999_999"),
    ("boxes.rs", "const BEYOND_US: i64 = 100_000", "const BEYOND_US: i64 = 200_000"),
    ("boxes.rs", "row.size_m *= alignment.metres_per_unit;", ""),
    (
        "boxes.rs",
        "alignment.new_from_old.rotation * v * alignment.metres_per_unit",
        "alignment.new_from_old.rotation * v",
    ),
    ("boxes.rs", "alignment.new_from_old.rotation * v * alignment", "v * alignment"),
    ("boxes.rs", "row.world_from_box = alignment.pose(&row.world_from_box);", ""),
    ("boxes.rs", "(Some(a), Some(b)) => a.lerp(b, share)", "(Some(a), Some(_)) => a"),
    ("boxes.rs", "before.size_m.lerp(next.size_m, share)", "before.size_m"),
    ("boxes.rs", "velocity * (time_us - row.time_us) as f64 * 1e-6", "velocity * 0.0 * time_us as f64"),
    ("boxes.rs", "neighbour.filter(|(a, b)| gap_us(a, b) <= LARGEST_GAP_US)", "neighbour"),
    (
        "boxes.rs",
        "row.velocity_m_per_s.or(near.map(|(a, b)| between(a, b)))?",
        "near.map(|(a, b)| between(a, b)).or(row.velocity_m_per_s)?",
    ),
    ("boxes.rs", "if points.len() < corners.len()", "if points.len() > corners.len()"),
    ("boxes.rs", "from ^ 1, from ^ 2, from ^ 4", "from ^ 1, from ^ 2"),
    ("boxes.rs", "perp_dot(point - a) <= 0.0", "perp_dot(point - a) >= 0.0"),
    ("boxes.rs", "row as f64 + 0.5);", "row as f64);"),
    ("boxes.rs", "polygon.len() > 2 && edges()", "polygon.len() > 9 && edges()"),
    ("boxes.rs", "share.clamp(0.0, 1.0)).distance", "share).distance"),
    ("lidar.rs", "LARGEST_GAP_US: i64 = 200_000", "LARGEST_GAP_US: i64 = 300_000"),
    ("lidar.rs", "SAME_PX: f64 = 2.0", "SAME_PX: f64 = 1.5"),
    ("lidar.rs", "LEAST_OPACITY: f32 = 0.5", "LEAST_OPACITY: f32 = 0.4"),
    ("lidar.rs", "[0.0, 10.0, 30.0, 80.0]", "[0.0, 15.0, 30.0, 80.0]"),
    ("lidar.rs", "[0.0, 10.0, 30.0, 80.0]", "[0.0, 10.0, 30.0, 60.0]"),
    ("lidar.rs", "timed.retain(|(_, point_m)| point_m.is_finite());", ""),
    ("lidar.rs", "timed.sort_by_key(|(time_us, _)| *time_us);", ""),
    ("lidar.rs", "self.rig_from_lidar.transform_point(*point_m)", "*point_m"),
    ("lidar.rs", "let rotation = slerp(a.rotation, b.rotation, share);", "let rotation = a.rotation;"),
    ("lidar.rs", "a.position_m.lerp(b.position_m, share)", "a.position_m"),
    ("lidar.rs", "if a.dot(b) < 0.0 {", "if a.dot(b) > 0.0 {"),
    ("lidar.rs", "|time_us| *time_us <= to_us", "|time_us| *time_us < to_us"),
    ("lidar.rs", "|time_us| *time_us < from_us", "|time_us| *time_us <= from_us"),
    ("lidar.rs", "&& map.depth_m[pixel] > 0.0", ""),
    ("lidar.rs", "map.counts.is_none_or(|counts| counts[pixel])", "true"),
    ("lidar.rs", "a.depth_m.total_cmp(&b.depth_m)", "b.depth_m.total_cmp(&a.depth_m)"),
    ("lidar.rs", "(-1..=1).flat_map(|dy|", "(0..=0).flat_map(|dy|"),
    ("lidar.rs", "map.camera.depth_m(point_m)", "point_m.length()"),
    ("lidar.rs", "_ => 0.5 * (sorted[middle - 1] + sorted[middle])", "_ => sorted[middle]"),
    ("lidar.rs", "bin.points as f64 * bin.mean_m", "bin.mean_m"),
    ("lidar.rs", "filter(|image| image.points > 0).collect()", "collect()"),
    ("flicker.rs", "if *valid > 0.0", "if *valid >= 0.0"),
    ("flicker.rs", "count += 3", "count += 1"),
    ("flicker.rs", "sum as f64 / 255.0", "sum as f64 / 256.0"),
    ("reprojection.rs", "*valid > 0.0 &&", ""),
    ("reprojection.rs", "&& counts.is_none_or(|counts| counts.get(pixel) == Some(&true))", ""),
    ("reprojection.rs", "truth.to_vec(), back.to_vec()", "back.to_vec(), back.to_vec()"),
    ("extrapolation.rs", "repaired.flicker / rendered.flicker", "rendered.flicker / repaired.flicker"),
    ("extrapolation.rs", ".filter(|value| !value.is_nan())", ""),
    (
        "extrapolation.rs",
        "trust: mean_of(views.iter().map(|view| view.trust))",
        "trust: mean_of(views.iter().map(|view| view.covered))",
    ),
    (
        "extrapolation.rs",
        "covered: mean_of(views.iter().map(|view| view.covered))",
        "covered: mean_of(views.iter().map(|view| view.trust))",
    ),
    (
        "extrapolation.rs",
        "reprojection_flip: mean(&|view| view.reprojection.flip)",
        "reprojection_flip: mean(&|view| view.reprojection.share)",
    ),
    (
        "extrapolation.rs",
        "reprojection_share: mean(&|view| view.reprojection.share)",
        "reprojection_share: mean(&|view| view.reprojection.flip)",
    ),
    ("kid.rs", "powi(3)", "powi(2)"),
    ("kid.rs", "dot / x.len() as f64 + 1.0", "dot / x.len() as f64"),
    ("kid.rs", "dot / x.len() as f64 + 1.0", "dot + 1.0"),
    ("kid.rs", "count * (count - 1.0)", "count * count"),
    ("kid.rs", "&of[at + 1..]", "&of[at..]"),
    ("kid.rs", "2.0 * between / pairs", "between / pairs"),
    ("kid.rs", "let other = at + (self.next()", "let other = (self.next()"),
    ("kid.rs", "variance.sqrt()", "variance"),
    ("kid.rs", "random.choose(subset_size, b.len())", "random.choose(subset_size, subset_size)"),
    ("exposure.rs", "covariance[c] / variance[c]", "variance[c] / covariance[c]"),
    ("exposure.rs", "mean_to[c] - gain[c] * mean_from[c]", "mean_to[c] - mean_from[c]"),
    ("exposure.rs", "if is_flat(c) { 1.0 }", "if is_flat(c) { 0.0 }"),
    ("exposure.rs", ".clamp(0.0, 1.0))", ")"),
    ("scores.rs", "count + 3))", "count + 1))"),
    ("scores.rs", "-10.0 * (squared", "-20.0 * (squared"),
    ("scores.rs", "ssim: ssim.within,", "ssim: ssim.mirrored,"),
    ("scores.rs", "ssim_mirrored: ssim.mirrored,", "ssim_mirrored: ssim.within,"),
    ("scores.rs", "error_sum / (values / 3) as f64", "error_sum / values as f64"),
    ("scores.rs", "rendered.copy_from_slice(truth);", ""),
    ("scores.rs", "*error = 0.0;", ""),
    ("scores.rs", "let rendered = exposure.apply(rendered);", ""),
    ("scores.rs", "let ssim = Ssim::of(&changed, truth", "let ssim = Ssim::of(truth, truth"),
    ("scores.rs", "pair.size_px(), pair.counts());", "pair.size_px(), None);"),
    ("pair.rs", "self.counts.as_ref().map_or(1.0, share)", "self.counts.as_ref().map_or(0.0, share)"),
    (
        "pair.rs",
        ".map(move |(_, (rendered, truth))| (unit(rendered), unit(truth)))",
        ".map(move |(_, (rendered, truth))| (unit(truth), unit(rendered)))",
    ),
    ("means.rs", "image.rendered.values > 0", "true"),
    ("means.rs", "psnr_db: after.psnr_db - before.psnr_db", "psnr_db: before.psnr_db - after.psnr_db"),
    ("means.rs", "ssim: after.ssim - before.ssim", "ssim: after.ssim"),
    ("means.rs", "flip: after.flip - before.flip", "flip: before.flip - after.flip"),
    ("means.rs", "|(after, before)| after - before", "|(after, _)| after"),
    ("means.rs", "ssim_mirrored: mean(&|scores| scores.ssim_mirrored)", "ssim_mirrored: mean(&|scores| scores.ssim)"),
    ("means.rs", "flip: mean(&|scores| scores.flip)", "flip: mean(&|scores| scores.counted)"),
    ("means.rs", "filter(|v| !v.is_nan())", "filter(|_| true)"),
]


def copy(index: int, fault: Fault) -> Copy:
    """A copy of the package with its own tests, without the page."""
    folder = Path(__file__).resolve().parents[2] / "src" / "eval"
    files = {}
    for path in folder.glob("*.rs"):
        text = path.read_text()
        if path.name == fault.file:
            text = planted(text, fault)
        text = re.sub(r"\bcrate::", f"crate::planted::m{index:03}::mutant::", text)
        if path.name == "lib.rs":
            text = re.sub(r"^(//!|mod page|pub use page).*\n", "", text, flags=re.MULTILINE)
        files["mod.rs" if path.name == "lib.rs" else path.name] = text
    tests = "".join(f"mod {name} {{\n{suite(name)}\n}}\n" for name in ("boxes", "kid", "lidar", "means"))
    return Copy(files, tests)


def suite(name: str) -> str:
    text = re.sub(r"^//!.*\n", "", source(f"tests/eval/{name}.rs"), flags=re.MULTILINE)
    text = re.sub(r"include_(str|bytes)!\(\"", r'include_\1!("../../', text)
    return re.sub(r"\bwildcity_eval\b", "super::super::mutant", text)


def main() -> int:
    faults = [Fault(*fault) for fault in chosen(FAULTS)]
    return run("eval", faults, [copy(index, fault) for index, fault in enumerate(faults)])


if __name__ == "__main__":
    sys.exit(main())
