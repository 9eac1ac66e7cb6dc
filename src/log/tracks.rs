//! The tracks of a log in memory: as recorded actors of a scenario, and as boxes that hide points.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;

use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::{MAX_NAME_BYTES, is_name};
use wildcity_sim::scenario::{KeyframeSection, PoseSection, TrackSection, TracksFile};

use crate::error::LogError;
use crate::log::Log;
use crate::row::TrackRow;

/// An object that is slower stands still and is part of the scene, in m/s.
const MOVES_M_PER_S: f64 = 1.0;

/// A box is known this long before and after a row of its track, in microseconds.
const NEAR_US: i64 = 500_000;

/// A box is grown by this much to each side, in metres: labels are not exact.
const GROWN_M: f64 = 0.2;

/// The rows of each track, in order of time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tracks {
    rows: BTreeMap<String, Vec<TrackRow>>,
}

impl Tracks {
    /// The rows of a log within a time, both ends included; none if the log has no tracks.
    ///
    /// # Errors
    /// A row cannot be used.
    pub fn read(log: &Log, [from_us, until_us]: [i64; 2]) -> Result<Self, LogError> {
        let mut tracks = Self::default();
        let Some(rows) = log.tracks()? else { return Ok(tracks) };
        for row in rows {
            let row = row?;
            if (from_us..=until_us).contains(&row.time_us) {
                tracks.add(row);
            }
        }
        Ok(tracks)
    }

    /// Adds a row. Its name is that of the list in which it is, and so is not kept twice.
    fn add(&mut self, mut row: TrackRow) {
        let track = std::mem::take(&mut row.track);
        self.rows.entry(track).or_default().push(row);
    }

    /// The name of each track and its rows, which have no names of their own.
    pub fn each(&self) -> impl Iterator<Item = (&str, &[TrackRow])> {
        self.rows.iter().map(|(track, rows)| (track.as_str(), rows.as_slice()))
    }

    /// The number of different tracks.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether there is no track.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The tracks as recorded actors of a scenario. Ids of a log are any text: what a scenario does
    /// not accept in a name becomes `_`. The size and the class of an actor are those of its first
    /// row.
    pub fn recorded_actors(&self) -> TracksFile {
        let mut names = BTreeSet::new();
        let tracks = self.rows.iter().map(|(track, rows)| TrackSection {
            id: new_name(track, &mut names),
            class: rows[0].class,
            size: rows[0].size,
            asset: None,
            keyframes: rows.iter().map(keyframe).collect(),
        });
        TracksFile { format: TracksFile::FORMAT.to_owned(), tracks: tracks.collect() }
    }

    /// The tracks that have a row near a time: few of a long log.
    pub fn near(&self, time_us: i64) -> NearTracks<'_> {
        let is_near = |rows: &&[TrackRow]| {
            // A list is made with its first row, so it is never empty.
            let from_us = rows[0].time_us;
            let to_us = rows[rows.len() - 1].time_us;
            // A point may be seen half a second from the image, and its box be known half a second
            // from that.
            let reach_us = 2 * NEAR_US;
            time_us >= from_us.saturating_sub(reach_us) && time_us <= to_us.saturating_add(reach_us)
        };
        NearTracks { rows: self.rows.values().map(Vec::as_slice).filter(is_near).collect() }
    }
}

/// The tracks that have a row near a time.
#[derive(Clone, Debug)]
pub struct NearTracks<'a> {
    rows: Vec<&'a [TrackRow]>,
}

impl NearTracks<'_> {
    /// Whether a point of the world is in a box that moves faster than 1 m/s at a time, within half
    /// a second of that of [`Tracks::near`].
    pub fn hides(&self, point_m: DVec3, time_us: i64) -> bool {
        self.rows.iter().any(|rows| {
            let after = rows.partition_point(|row| row.time_us <= time_us);
            // The row before or at the time, and the one after it; either may not exist.
            let around = [after.checked_sub(1), Some(after)].into_iter().flatten();
            let known = around.filter(|at| *at < rows.len());
            let near = known.min_by_key(|at| rows[*at].time_us.abs_diff(time_us));
            near.is_some_and(|at| is_hidden(rows, at, point_m, time_us))
        })
    }
}

/// Whether a point is in the box of the row that is the nearest in time.
fn is_hidden(rows: &[TrackRow], at: usize, point_m: DVec3, time_us: i64) -> bool {
    let row = &rows[at];
    let since_us = time_us.saturating_sub(row.time_us);
    let velocity = velocity(rows, at);
    if velocity.length() <= MOVES_M_PER_S || since_us.abs() > NEAR_US {
        return false;
    }
    let moved_m = since_us as f64 / 1e6 * velocity;
    // The point is moved back instead of the box forward; the turn of the box since its row is left
    // out, because half a second turns it little.
    let box_m = row.world_from_box.inverse().transform_point(point_m - moved_m);
    let half_m = 0.5 * DVec3::from_array(row.size) + GROWN_M;
    box_m.abs().cmple(half_m).all()
}

/// The velocity that a row gives, or that between the rows around it: those of half a second to
/// both sides, because labels jitter; or else its neighbours within a second.
// Not that of the whole track: a car that drives away after an hour, or parks, would stand still.
fn velocity(rows: &[TrackRow], at: usize) -> DVec3 {
    if let Some(velocity) = rows[at].velocity {
        return DVec3::from_array(velocity);
    }
    let time_us = rows[at].time_us;
    let off_us = |row: &TrackRow| row.time_us.abs_diff(time_us);
    // Before the row, distances in time fall along the list, and behind it they rise: both ends of
    // the window can be found by bisection.
    let mut first = rows[..at].partition_point(|row| off_us(row) > NEAR_US as u64);
    let mut after = at + rows[at..].partition_point(|row| off_us(row) <= NEAR_US as u64);
    // Only the row itself is near, as in labels at 1 Hz.
    if after == first + 1 {
        let is_near = |at: usize| rows.get(at).is_some_and(|row| off_us(row) <= 2 * NEAR_US as u64);
        first -= usize::from(at > 0 && is_near(at - 1));
        after += usize::from(is_near(at + 1));
    }
    // A track of one row does not tell a speed, and counts as standing still.
    let [first, .., last] = &rows[first..after] else { return DVec3::ZERO };
    let moved_m = last.world_from_box.position_m - first.world_from_box.position_m;
    moved_m / (last.time_us.abs_diff(first.time_us) as f64 / 1e6)
}

/// A pose of a scenario's actor: its origin is on the ground under the box's middle.
fn keyframe(row: &TrackRow) -> KeyframeSection {
    let below = Pose { position_m: -0.5 * row.size[2] * DVec3::Z, ..Pose::IDENTITY };
    // Half the height down along the axes of the box, not of the world: on a slope the ground is
    // there.
    let placed = row.world_from_box * below;
    let pose =
        PoseSection { xyz: placed.position_m.to_array(), yaw_rad: None, q: Some(placed.q_wxyz()) };
    KeyframeSection { time_us: row.time_us, pose }
}

/// The name of a track that no other one has.
fn new_name(track: &str, names: &mut BTreeSet<String>) -> String {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "_-".contains(c);
    let lower = track.to_ascii_lowercase();
    let name: String = lower.chars().map(|c| if allowed(c) { c } else { '_' }).collect();
    // Room for a number.
    let short: String = name.chars().take(MAX_NAME_BYTES - 8).collect();
    let numbered = (1..).map(|number| match number {
        1 => short.clone(),
        number => format!("{short}-{number}"),
    });
    let mut free = numbered.filter(|name| is_name(name) && !names.contains(name));
    let name = free.next().unwrap_or(short.clone());
    names.insert(name.clone());
    name
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_scene::ActorClass;

    fn row(time_us: i64, track: &str, x_m: f64) -> TrackRow {
        TrackRow {
            time_us,
            track: track.to_owned(),
            class: ActorClass::Vehicle,
            size: [4.0, 2.0, 1.5],
            world_from_box: Pose { position_m: DVec3::new(x_m, 0.0, 0.75), ..Pose::IDENTITY },
            velocity: None,
        }
    }

    fn tracks(rows: Vec<TrackRow>) -> Tracks {
        let mut tracks = Tracks::default();
        rows.into_iter().for_each(|row| tracks.add(row));
        tracks
    }

    #[test]
    fn a_box_hides_points_while_it_moves() {
        let moving = tracks(vec![row(0, "a", 0.0), row(1_000_000, "a", 10.0)]);
        let at = |x_m: f64, time_us| moving.near(time_us).hides(DVec3::new(x_m, 0.0, 0.1), time_us);
        assert!(at(2.0, 0) && !at(2.3, 0) && !at(-2.3, 0));
        // At 0.3 s its middle is at 3 m, and at 0.7 s at 7 m.
        assert!(at(5.0, 300_000) && !at(0.5, 300_000) && at(9.0, 700_000));
        assert!(!at(15.0, 1_600_000), "no row is near");
        let standing = tracks(vec![row(0, "a", 0.0), row(1_000_000, "a", 0.5)]);
        assert!(!standing.near(0).hides(DVec3::new(0.0, 0.0, 0.1), 0));
    }

    #[test]
    fn a_car_that_parks_hides_points_only_while_it_drives() {
        // 10 m/s for a second, and then a minute at the same place, at 10 Hz.
        let at_m = |step: i64| step.min(10) as f64;
        let rows = (0..610).map(|step| row(100_000 * step, "a", at_m(step))).collect();
        let car = tracks(rows);
        let hides =
            |time_us: i64, x_m: f64| car.near(time_us).hides(DVec3::new(x_m, 0.0, 0.1), time_us);
        assert!(hides(0, 0.0) && hides(500_000, 5.0) && hides(1_200_000, 10.0));
        assert!(!hides(3_000_000, 10.0) && !hides(60_000_000, 10.0));
    }

    #[test]
    fn actors_stand_on_the_ground_and_have_names() {
        let ids = ["Car 1", "car_1", "..", ""].map(|track| row(5, track, 1.0)).to_vec();
        let file = tracks(ids).recorded_actors();
        file.check().unwrap();
        let mut names: Vec<&str> = file.tracks.iter().map(|track| track.id.as_str()).collect();
        names.sort_unstable();
        assert_eq!(names, ["-2", "__", "car_1", "car_1-2"]);
        assert_eq!(file.tracks[0].keyframes[0].pose.xyz, [1.0, 0.0, 0.0]);
    }
}
