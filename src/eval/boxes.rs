//! Boxes around moving objects, from a log's labels, and the pixels that they hide.
//!
//! A twin has no moving vehicles and pedestrians, so pixels where a real image shows one do not
//! count. An object that stands still may be part of the twin, so its pixels count.

// A map in the order of names, so that results do not depend on a hash.
use std::collections::BTreeMap;
use std::io::{BufRead, Read as _};

use glam::{DVec2, DVec3};
use serde::Deserialize;
use serde::de::IgnoredAny;

use wildcity_log::{TrackRow, Tracks};
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::{Camera, Pose};

/// A box that is slower than this stands still, in m/s.
pub const MOVES_M_PER_S: f64 = 1.0;

/// Distance by which a hull is grown, in pixels.
pub const GROWN_PX: f64 = 3.0;

/// A track is interpolated between rows at most this far apart, in microseconds.
const LARGEST_GAP_US: i64 = 1_000_000;

/// Time for which a track is extrapolated before its first and after its last row, in microseconds.
const BEYOND_US: i64 = 100_000;

/// Number of points along an edge that is only in part in front of the camera.
const EDGE_POINTS: u32 = 64;

/// Longest line, in bytes. A box has some hundred.
const LINE_BYTES: u64 = 64 << 10;

/// Largest accepted side of a box, in metres.
const LARGEST_M: f64 = 100.0;

/// The boxes of a log, track by track.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Boxes {
    tracks: BTreeMap<String, Vec<Row>>,
}

/// A box at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Row {
    time_us: i64,
    size_m: DVec3,
    world_from_box: Pose,
    velocity_m_per_s: Option<DVec3>,
}

/// A box that moves, at the time of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MovingBox {
    /// Length along x, width along y, height along z, in metres.
    pub size_m: DVec3,
    /// Pose of its middle.
    pub world_from_box: Pose,
}

/// Why a file of boxes was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BoxesError {
    /// A line is not a valid box.
    #[error(
        "line {line}: {reason}; a line is {{\"time_us\", \"track\", \"size\": [length, width, height], \"world_from_box\": \
         {{\"xyz\", \"q\"}}}}, and perhaps \"velocity\""
    )]
    Line {
        /// Number of the line, from 1.
        line: usize,
        reason: String,
    },
    /// The text cannot be read.
    #[error("cannot read: {reason}")]
    Read { reason: String },
    /// A track has two boxes at one time.
    #[error("track {track:?} has two boxes at time_us {time_us}; give one")]
    Twice {
        track: String,
        /// The time, in microseconds.
        time_us: i64,
    },
}

/// A line of the file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    time_us: i64,
    track: Track,
    size: [f64; 3],
    world_from_box: Pose,
    velocity: Option<[f64; 3]>,
    /// Tables of logs have it; every box that moves is hidden.
    #[serde(rename = "class")]
    _class: Option<IgnoredAny>,
}

/// The name of a track: text, or a number.
#[derive(Deserialize)]
#[serde(untagged)]
enum Track {
    Text(String),
    Number(i64),
}

impl Boxes {
    /// Reads boxes: JSON objects, one a line.
    ///
    /// # Errors
    /// Names the first line that is not a valid box, or the track that has two boxes at one time.
    pub fn parse(text: &str) -> Result<Self, BoxesError> {
        Self::read(text.as_bytes())
    }

    /// Reads boxes line by line, as [`Boxes::parse`] does: only the boxes stay in memory.
    ///
    /// # Errors
    /// As [`Boxes::parse`], or the text cannot be read.
    pub fn read(mut lines: impl BufRead) -> Result<Self, BoxesError> {
        let mut boxes = Self::default();
        let mut text = Vec::new();
        // Blank lines are skipped, but counted: the message names the line of the file.
        for line in 1.. {
            text.clear();
            let read = (&mut lines).take(LINE_BYTES + 1).read_until(b'\n', &mut text);
            if read.map_err(|error| BoxesError::Read { reason: error.to_string() })? == 0 {
                break;
            }
            if text.len() as u64 > LINE_BYTES {
                let reason = format!("it has more than {LINE_BYTES} bytes");
                return Err(BoxesError::Line { line, reason });
            }
            if !text.trim_ascii().is_empty() {
                boxes.add(&text).map_err(|reason| BoxesError::Line { line, reason })?;
            }
        }
        boxes.sort()
    }

    /// The boxes of a log's tracks, which are in memory already.
    pub fn from_tracks(tracks: &Tracks) -> Self {
        let row = |row: &TrackRow| Row {
            time_us: row.time_us,
            size_m: DVec3::from_array(row.size),
            world_from_box: row.world_from_box,
            velocity_m_per_s: row.velocity.map(DVec3::from_array),
        };
        let each = tracks.each();
        let tracks = each.map(|(name, rows)| (name.to_owned(), rows.iter().map(row).collect()));
        Self { tracks: tracks.collect() }
    }

    /// Adds the box of a line.
    fn add(&mut self, text: &[u8]) -> Result<(), String> {
        let line: Line = serde_json::from_slice(text).map_err(|error| error.to_string())?;
        if let Some(side) = line.size.iter().find(|side| !(0.0..=LARGEST_M).contains(*side)) {
            return Err(format!("size has {side:?}; 0 to {LARGEST_M} m"));
        }
        if let Some(value) = line.velocity.iter().flatten().find(|value| !value.is_finite()) {
            return Err(format!("velocity has {value:?}; give finite numbers"));
        }
        // A number and its text are the same track.
        let name = match line.track {
            Track::Text(name) => name,
            Track::Number(number) => number.to_string(),
        };
        self.tracks.entry(name).or_default().push(Row {
            time_us: line.time_us,
            size_m: DVec3::from_array(line.size),
            world_from_box: line.world_from_box,
            velocity_m_per_s: line.velocity.map(DVec3::from_array),
        });
        Ok(())
    }

    /// Rows of a track may come in any order. From here on they are sorted, which `moving_at`
    /// relies on.
    fn sort(mut self) -> Result<Self, BoxesError> {
        for (track, rows) in &mut self.tracks {
            rows.sort_by_key(|row| row.time_us);
            if let Some(pair) = rows.windows(2).find(|pair| pair[0].time_us == pair[1].time_us) {
                let time_us = pair[0].time_us;
                return Err(BoxesError::Twice { track: track.clone(), time_us });
            }
        }
        Ok(self)
    }

    /// The boxes in other axes and another unit.
    #[must_use]
    pub fn aligned(mut self, alignment: &Alignment) -> Self {
        for row in self.tracks.values_mut().flatten() {
            row.world_from_box = alignment.pose(&row.world_from_box);
            row.size_m *= alignment.metres_per_unit;
            // The rotation turns a velocity; the move of the origin does not change it.
            let turned = |v: DVec3| alignment.new_from_old.rotation * v * alignment.metres_per_unit;
            row.velocity_m_per_s = row.velocity_m_per_s.map(turned);
        }
        self
    }

    /// Number of tracks with at least one box.
    pub fn tracks(&self) -> usize {
        self.tracks.len()
    }

    /// The boxes that move faster than [`MOVES_M_PER_S`] at a time, interpolated between the rows
    /// around it.
    pub fn moving_at(&self, time_us: i64) -> Vec<MovingBox> {
        self.tracks.values().filter_map(|rows| moving_at(rows, time_us)).collect()
    }
}

/// The box of a track at a time, if it moves then.
fn moving_at(rows: &[Row], time_us: i64) -> Option<MovingBox> {
    // Rows up to the time come before it, with one at the time itself.
    let after = rows.partition_point(|row| row.time_us <= time_us);
    let before = after.checked_sub(1).map(|at| &rows[at]);
    let next = rows.get(after);
    let gap_us = |a: &Row, b: &Row| b.time_us - a.time_us;
    // Between two rows that are near enough in time.
    if let (Some(before), Some(next)) = (before, next)
        && gap_us(before, next) <= LARGEST_GAP_US
    {
        let share = (time_us - before.time_us) as f64 / gap_us(before, next) as f64;
        let velocity = match (before.velocity_m_per_s, next.velocity_m_per_s) {
            (Some(a), Some(b)) => a.lerp(b, share),
            // One given velocity is better than a difference of positions, which has the noise of
            // both.
            (Some(one), None) | (None, Some(one)) => one,
            (None, None) => between(before, next),
        };
        let world_from_box = before.world_from_box.interpolate(&next.world_from_box, share);
        let size_m = before.size_m.lerp(next.size_m, share);
        return (velocity.length() > MOVES_M_PER_S).then_some(MovingBox { size_m, world_from_box });
    }
    // At an end of the track or of a part of it.
    let (row, neighbour) = match (before, next) {
        (Some(row), _) if time_us - row.time_us <= BEYOND_US => {
            // The row before it, for a difference; the neighbour may be on the other side of a gap.
            (row, after.checked_sub(2).map(|at| (&rows[at], row)))
        }
        (_, Some(row)) if row.time_us - time_us <= BEYOND_US => {
            (row, rows.get(after + 1).map(|next| (row, next)))
        }
        // Farther from any row than a tenth of a second: the track is not there.
        _ => return None,
    };
    let near = neighbour.filter(|(a, b)| gap_us(a, b) <= LARGEST_GAP_US);
    // Without any velocity it is unknown whether the box moves: nothing is hidden.
    let velocity = row.velocity_m_per_s.or(near.map(|(a, b)| between(a, b)))?;
    let mut world_from_box = row.world_from_box;
    world_from_box.position_m += velocity * (time_us - row.time_us) as f64 * 1e-6;
    let size_m = row.size_m;
    (velocity.length() > MOVES_M_PER_S).then_some(MovingBox { size_m, world_from_box })
}

/// The velocity from one row to a later one, in m/s.
fn between(a: &Row, b: &Row) -> DVec3 {
    let moved_m = b.world_from_box.position_m - a.world_from_box.position_m;
    moved_m / ((b.time_us - a.time_us) as f64 * 1e-6)
}

impl MovingBox {
    /// The convex hull of its corners on the image of a camera, in pixels, in one sense of
    /// rotation; empty if it is not in front of the camera. If only a part of an edge is within the
    /// camera's field, that part counts.
    pub fn hull_px(&self, camera: &Camera, world_from_camera: &Pose) -> Vec<DVec2> {
        let camera_from_box = world_from_camera.inverse() * self.world_from_box;
        // The bits of the index are the signs along x, y and z, so that two corners differ in one
        // bit along an edge.
        let corner = |index: usize| {
            let sign = |bit: usize| if index >> bit & 1 == 1 { 0.5 } else { -0.5 };
            let of_size = DVec3::new(sign(0), sign(1), sign(2));
            camera_from_box.transform_point(self.size_m * of_size)
        };
        let corners: [DVec3; 8] = [0, 1, 2, 3, 4, 5, 6, 7].map(corner);
        let at_px = corners.map(|corner| camera.project(corner));
        let mut points: Vec<DVec2> = at_px.iter().copied().flatten().collect();
        // A corner outside of the lens' field has no place on the image: the visible parts of edges
        // stand in for it.
        if points.len() < corners.len() {
            for from in 0..8_usize {
                // Three edges from each corner; each edge is visited from its lower index only, 12
                // in all.
                for to in [from ^ 1, from ^ 2, from ^ 4].into_iter().filter(|to| *to > from) {
                    let along = |step: u32| {
                        let share = f64::from(step) / f64::from(EDGE_POINTS);
                        camera.project(corners[from].lerp(corners[to], share))
                    };
                    points.extend((1..EDGE_POINTS).filter_map(along));
                }
            }
        }
        hull(points)
    }
}

/// The convex hull of points (Andrew's monotone chain), in one sense of rotation, without points on
/// its edges.
fn hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.retain(|point| point.is_finite());
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let half = |points: &mut dyn Iterator<Item = DVec2>| {
        let mut chain: Vec<DVec2> = Vec::new();
        for point in points {
            // The last two points and the new one turn right or go straight: the middle one is not
            // on the hull.
            while let [.., a, b] = chain[..]
                && (b - a).perp_dot(point - a) <= 0.0
            {
                chain.pop();
            }
            chain.push(point);
        }
        // The end of one chain is the beginning of the other.
        chain.pop();
        chain
    };
    let mut lower = half(&mut points.iter().copied());
    lower.extend(half(&mut points.iter().rev().copied()));
    lower
}

/// Clears the pixels of an image whose middle is within `grown_px` of a hull as
/// [`MovingBox::hull_px`] has it.
///
/// `counts` is `[height, width]`.
pub fn hide(hull_px: &[DVec2], size_px: [u32; 2], grown_px: f64, counts: &mut [bool]) {
    let Some(first) = hull_px.first() else { return };
    let low = hull_px.iter().fold(*first, |low, point| low.min(*point)) - grown_px;
    let high = hull_px.iter().fold(*first, |high, point| high.max(*point)) + grown_px;
    // The range of pixels whose middles lie between two positions.
    let range = |low: f64, high: f64, side: u32| {
        // The first pixel whose middle, at + 0.5, is not before the position; clamped, because a
        // hull may lie beyond the image.
        let first = (low - 0.5).ceil().clamp(0.0, f64::from(side)) as usize;
        let after = ((high - 0.5).floor() + 1.0).clamp(0.0, f64::from(side)) as usize;
        first..after
    };
    for row in range(low.y, high.y, size_px[1]) {
        for column in range(low.x, high.x, size_px[0]) {
            let middle = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
            if is_near(middle, hull_px, grown_px) {
                counts[row * size_px[0] as usize + column] = false;
            }
        }
    }
}

/// Whether a point is within a convex polygon, or at most `distance` from it.
fn is_near(point: DVec2, polygon: &[DVec2], distance: f64) -> bool {
    let edges = || polygon.iter().zip(polygon.iter().cycle().skip(1));
    let is_left = |(a, b): (&DVec2, &DVec2)| (*b - *a).perp_dot(point - *a) >= 0.0;
    // Fewer than three points enclose nothing: only their distance counts.
    if polygon.len() > 2 && edges().all(is_left) {
        return true;
    }
    edges().any(|(a, b)| {
        let along = *b - *a;
        // The foot of the perpendicular as a share of the edge; the bound is for a polygon of one
        // point.
        let share = (point - *a).dot(along) / along.length_squared().max(f64::MIN_POSITIVE);
        (*a + along * share.clamp(0.0, 1.0)).distance(point) <= distance
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_scene::geometry::camera::Pinhole;

    fn row(time_us: i64, x_m: f64, more: &str) -> String {
        format!(
            "{{\"time_us\": {time_us}, \"track\": 7, \"size\": [4, 2, 1.5], \"world_from_box\": {{\"xyz\": [{x_m}, 0, 10], \
             \"q\": [1, 0, 0, 0]}}{more}}}\n"
        )
    }

    fn x_m(text: &str, time_us: i64) -> Option<f64> {
        let found = Boxes::parse(text).unwrap().moving_at(time_us);
        found.first().map(|one| one.world_from_box.position_m.x)
    }

    #[test]
    fn long_lines_are_refused_and_others_are_read_one_by_one() {
        let text = row(0, 0.0, "") + &" ".repeat(70_000) + "\n";
        let said = Boxes::read(text.as_bytes()).unwrap_err().to_string();
        assert!(said.starts_with("line 2: it has more than 65536 bytes"), "{said}");
        let said = Boxes::read(&b"\xff\n"[..]).unwrap_err().to_string();
        assert!(said.starts_with("line 1: "), "{said}");
        let text = row(0, 0.0, "") + "\r\n \n" + row(100_000, 1.0, "").trim_end();
        assert_eq!(x_m(&text, 50_000), Some(0.5), "without an end of line");
    }

    #[test]
    fn a_box_is_where_its_track_is_at_the_time() {
        // Rows out of order, a blank line, and a gap of 1.8 s, which is longer than tracks are
        // interpolated over.
        let track = row(200_000, 1.0, "") + &row(0, 0.0, "") + "\n" + &row(2_000_000, 9.0, "");
        assert_eq!(x_m(&track, 0), Some(0.0));
        assert_eq!(x_m(&track, 50_000), Some(0.25));
        assert!((x_m(&track, 250_000).unwrap() - 1.25).abs() < 1e-12, "it goes on at 5 m/s");
        assert!((x_m(&track, -100_000).unwrap() + 0.5).abs() < 1e-12);
        // 0.1 s beyond each end and into the gap is the limit; the last row has no near neighbour
        // and no velocity.
        for time_us in [-100_001, 300_001, 1_000_000, 1_950_000, 2_050_000, 2_500_000] {
            assert_eq!(x_m(&track, time_us), None, "{time_us}");
        }
    }

    #[test]
    fn between_two_rows_size_and_velocity_change_too() {
        let wide = row(1_000_000, 8.0, ", \"velocity\": [1.5, 0, 0]").replace("4, 2", "5, 3");
        let track = row(0, 0.0, ", \"velocity\": [0.5, 0, 0]") + &wide;
        let boxes = Boxes::parse(&track).unwrap();
        assert!(boxes.moving_at(490_000).is_empty(), "0.99 m/s");
        let moving = boxes.moving_at(750_000)[0];
        assert_eq!(moving.size_m, DVec3::new(4.75, 2.75, 1.5));
        assert_eq!(moving.world_from_box.position_m.x, 6.0);
        // Its own velocity also counts where the track ends, before that of the rows.
        assert!((x_m(&track, 1_100_000).unwrap() - 8.15).abs() < 1e-12);
    }

    #[test]
    fn boxes_go_to_other_axes_and_another_unit() {
        let rotation = glam::DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
        let new_from_old = Pose { position_m: DVec3::new(1.0, 2.0, 3.0), rotation };
        let alignment = Alignment { new_from_old, metres_per_unit: 2.0 };
        let text = row(0, 5.0, ", \"velocity\": [0.75, 0, 0]");
        let plain = Boxes::parse(&text).unwrap();
        assert!(plain.moving_at(0).is_empty(), "0.75 units of a second");
        let moving = plain.aligned(&alignment).moving_at(100_000)[0];
        assert_eq!(moving.size_m, DVec3::new(8.0, 4.0, 3.0));
        // 1.5 m/s along y.
        let wanted = alignment.point_m(DVec3::new(5.0, 0.0, 10.0)) + DVec3::Y * 0.15;
        let away_m = moving.world_from_box.position_m.distance(wanted);
        assert!(away_m < 1e-12, "{moving:?} {wanted}");
        assert!(moving.world_from_box.rotation.angle_between(rotation) < 1e-7, "{moving:?}");
    }

    #[test]
    fn what_stands_still_hides_nothing() {
        let slow = row(0, 0.0, "") + &row(100_000, 0.099, "");
        assert_eq!(x_m(&slow, 50_000), None, "0.99 m/s");
        let fast = row(0, 0.0, "") + &row(100_000, 0.101, "");
        assert!(x_m(&fast, 50_000).is_some());
        // A velocity of the file counts more than the difference of the rows.
        let told = row(0, 0.0, ", \"velocity\": [0, 0.5, 0]");
        assert_eq!(x_m(&(told + &row(100_000, 9.0, "")), 50_000), None);
        assert_eq!(x_m(&row(0, 0.0, ", \"velocity\": [3, 0, 0]"), 100_000), Some(0.3));
        assert_eq!(x_m(&row(0, 0.0, ""), 0), None, "one row has no speed");
    }

    #[test]
    fn wrong_lines_are_named() {
        let refused = |text: &str| Boxes::parse(text).unwrap_err().to_string();
        let said = refused(&(row(0, 0.0, "") + "{\"time_us\": 1}"));
        assert!(said.starts_with("line 2: missing field"), "{said}");
        let said = refused(&row(0, 0.0, ", \"colour\": 1"));
        assert!(said.contains("colour"), "{said}");
        let said = refused(&row(0, 0.0, "").replace("4, 2", "4, -2"));
        assert!(said.contains("size has -2.0"), "{said}");
        let said = refused(&(row(5, 0.0, "") + &row(5, 1.0, "")));
        assert!(said.contains("track \"7\" has two boxes at time_us 5"), "{said}");
    }

    #[test]
    fn a_box_around_the_camera_hides_what_is_ahead() {
        let pinhole = Pinhole { fx: 50.0, fy: 50.0, cx: 40.0, cy: 30.0 };
        let camera = Camera::from_pinhole(80, 60, pinhole);
        let at = |z_m: f64| MovingBox {
            size_m: DVec3::new(2.0, 2.0, 8.0),
            // The box reaches from 4 m before its middle to 4 m behind: at 3 m a part of it is
            // behind the camera.
            world_from_box: Pose { position_m: DVec3::new(0.0, 1.5, z_m), ..Pose::IDENTITY },
        };
        let hidden = |one: MovingBox| {
            let mut counts = vec![true; camera.pixels()];
            let hull = one.hull_px(&camera, &Pose::IDENTITY);
            hide(&hull, [80, 60], GROWN_PX, &mut counts);
            counts
        };
        assert!(hidden(at(-20.0)).iter().all(|counts| *counts), "behind");
        let beside = hidden(at(3.0));
        assert!(!beside[59 * 80 + 40], "below the middle");
        assert!(beside[5 * 80 + 40], "the sky");
    }
}
