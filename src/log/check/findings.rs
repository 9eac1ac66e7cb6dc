//! What a twin needs and a log lacks, and what looks wrong.

use serde::Serialize;

use super::{Alignment, CameraCoverage, Missing, Report, Stream};
use crate::log::Log;

/// A difference of the clocks of LiDAR and camera that is worth a word, in milliseconds: 0.2 m at
/// 20 m/s.
const LATE_MS: f64 = 10.0;

/// Poses and fixes differ or drift by more than a satellite receiver without corrections, in
/// metres.
const GPS_M: f64 = 5.0;

/// A camera sees each place from near if its images are this near to each other, in metres.
const SPACING_M: f64 = 5.0;

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// A twin of the log would be wrong, or cannot be made.
    Error,
    /// A part of the log looks wrong.
    Warning,
    /// Something that a twin can have, and the log has not.
    Note,
}

/// Something about a log that its user should know.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    pub level: Level,
    /// A sentence: what, where, and what to do.
    pub text: String,
}

struct Findings(Vec<Finding>);

impl Findings {
    fn add(&mut self, level: Level, text: impl Into<String>) {
        self.0.push(Finding { level, text: text.into() });
    }

    /// Adds a sentence if it is true.
    fn add_if(&mut self, is_true: bool, level: Level, text: impl FnOnce() -> String) {
        if is_true {
            self.add(level, text());
        }
    }
}

/// Everything that is worth a word about a report, the worst first.
pub(super) fn find(log: &Log, report: &Report, missing: &Missing) -> Vec<Finding> {
    let mut found = Findings(Vec::new());
    if let Some(first) = &missing.first {
        let count = missing.count;
        let text = format!("{count} files that rows name do not exist; the first is {first}");
        found.add(Level::Error, text);
    }
    find_gaps(report, &mut found);
    find_path(report, &mut found);
    report.coverage.iter().for_each(|camera| find_coverage(camera, &mut found));
    report.alignment.iter().for_each(|camera| find_alignment(camera, &mut found));
    find_gps(report, &mut found);
    find_lacks(log, report, &mut found);
    // Stable: findings of one level stay in the order of the page.
    found.0.sort_by_key(|finding| finding.level);
    found.0
}

fn find_gaps(report: &Report, found: &mut Findings) {
    for Stream { sensor, gaps, missing, longest, .. } in &report.streams {
        // Only what exceeds the limit of a gap is in this list.
        let Some(worst) = longest.first() else { continue };
        let [from_s, length_s] = [worst.from_us as f64, worst.length_us as f64].map(|us| us / 1e6);
        found.add(
            Level::Warning,
            format!(
                "{sensor}: gaps: {gaps}, missing rows: about {missing}; the longest gap, of {length_s:.2} s, \
                 begins at {from_s:.2} s"
            ),
        );
    }
}

fn find_path(report: &Report, found: &mut Findings) {
    let path = &report.path;
    found.add_if(path.leaps > 0, Level::Warning, || {
        let first_s = path.leaps_us.first().map_or(0.0, |us| *us as f64 / 1e6);
        let leaps = path.leaps;
        format!(
            "poses leap {leaps} times, first at {first_s:.2} s: a clock jumps there, or the position was corrected"
        )
    });
    found.add_if(path.unplaced_s > 0.0, Level::Warning, || {
        let unplaced_s = path.unplaced_s;
        format!(
            "poses are more than 0.2 s apart during {unplaced_s:.1} s: images and points of these times are not placed"
        )
    });
}

fn find_coverage(coverage: &CameraCoverage, found: &mut Findings) {
    let CameraCoverage { camera, images, unplaced, longest_m, .. } = coverage;
    // A few images before the first pose are usual; if most have none, the clocks do not match.
    let level = if 2 * unplaced > *images { Level::Error } else { Level::Warning };
    found.add_if(*unplaced > 0, level, || {
        format!(
            "camera {camera}: {unplaced} of {images} images have no pose at their time: clocks differ, or poses are missing"
        )
    });
    found.add_if(*longest_m > SPACING_M, Level::Warning, || {
        format!("camera {camera}: {longest_m:.1} m of the drive have no image")
    });
}

fn find_alignment(alignment: &Alignment, found: &mut Findings) {
    let Alignment { camera, points, shown, lidar_late_ms, drift_px, .. } = alignment;
    found.add_if(*points > 0 && *shown == 0.0, Level::Error, || {
        format!("camera {camera}: its images show none of {points} LiDAR points: a mount or a clock is wrong")
    });
    let late_ms = lidar_late_ms.unwrap_or(0.0);
    found.add_if(late_ms.abs() > LATE_MS, Level::Warning, || {
        let late = if late_ms > 0.0 { "late" } else { "early" };
        format!(
            "camera {camera}: the times of the LiDAR are {:.0} ms {late} against the camera's: check clock.offsets_us",
            late_ms.abs()
        )
    });
    let Some(right_px) = *drift_px else { return };
    let side = if right_px > 0.0 { "right" } else { "left" };
    found.add(
        Level::Warning,
        format!(
            "camera {camera}: its images move by {:.0} px to the {side} against the LiDAR, from the first to the last \
             third of the log: a mount moves",
            right_px.abs()
        ),
    );
}

fn find_gps(report: &Report, found: &mut Findings) {
    let Some(gps) = &report.gps else { return };
    found.add_if(gps.drift_m > GPS_M, Level::Warning, || {
        format!("poses drift by {:.1} m against satellite fixes", gps.drift_m)
    });
    let [east_m, north_m] = gps.offset_m;
    found.add_if(east_m.hypot(north_m) > 2.0 * GPS_M, Level::Warning, || {
        format!("satellite fixes are {east_m:.1} m east and {north_m:.1} m north of the poses: check world.geo")
    });
}

fn find_lacks(log: &Log, report: &Report, found: &mut Findings) {
    let has = |kind: &str| report.streams.iter().any(|stream| stream.sensor.starts_with(kind));
    let all = |masks: fn(&CameraCoverage) -> usize| {
        // Without any image this is true: then the lack of images is said, and not that of masks.
        report.coverage.iter().all(|camera| masks(camera) == camera.images)
    };
    let lacks = [
        (!has("camera"), "there are no images: a scene is trained on images"),
        (!has("lidar"), "there is no LiDAR: training needs points to begin with, such as COLMAP's"),
        (
            report.tracks.is_none(),
            "there are no tracks: moving objects cannot be masked or replayed",
        ),
        (report.lanes.is_none(), "there is no map: scenarios get no lanes"),
        (
            log.header.world.geo.is_none(),
            "world.geo is missing: the twin has no place on the earth",
        ),
        (!has("imu"), "there is no imu"),
        (!has("gps"), "there is no gps: drift of the poses cannot be seen"),
        (!all(|one| one.sky_masks), "not all images have a mask of the sky"),
        (!all(|one| one.ground_masks), "not all images have a mask of the ground"),
    ];
    for (index, (is_lacking, text)) in lacks.into_iter().enumerate() {
        // The first of the list is the one that no twin can do without.
        let level = if index == 0 { Level::Error } else { Level::Note };
        found.add_if(is_lacking, level, || text.to_owned());
    }
    for sentence in &log.header.left_out {
        found.add(Level::Note, format!("left out by the converter: {sentence}"));
    }
}
