//! AlpaSim's scene score, including its defects; `alpasim_plans` and `alpasim_road` have its other
//! scores.
//!
//! Source: NVlabs/alpasim 3032e0c, `src/eval/src/eval/aggregation/scene_score.py`,
//! `scorers/collision.py`, `scorers/plan_deviation.py`.

use wildcity_sim::contact::Footprint;

use super::alpasim_box::RoundedBox;
use super::alpasim_plans;
use super::alpasim_road::{Road, is_in_wrong_lane};
use super::record::DriveRecord;
use super::scored::{Missing, Score};

/// The names of the scores of the scene and the road.
pub const NAME: &str = "alpasim.scene@3032e0c";
/// 1 if the ego was off the road.
pub const OFF_ROAD: &str = "alpasim.offroad@3032e0c";
/// 1 if the ego was in a lane of another direction.
pub const WRONG_LANE: &str = "alpasim.wrong_lane@3032e0c";

/// Progress at which the score saturates.
const FULL_PROGRESS: f64 = 0.8;
/// Progress is not measured along a recording that is shorter than this, in metres.
const SHORT_RECORDING_M: f64 = 5.0;
/// The episode is cut where the ego is farther than this from the recorded drive, in metres.
const CUT_M: f64 = 4.0;

/// Which side of the ego was hit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The front line touches the other.
    Front,
    /// The rear line touches the other.
    Rear,
    /// Neither line touches the other.
    Lateral,
}

/// The contacts at one instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Collision {
    /// As published, the side of the last track in the list. A later track hides a contact with the
    /// front.
    pub published: Option<Side>,
    /// Whether any track was hit by the front or the side.
    pub any_at_fault: bool,
}

/// The side that another box touches; the front is tested first. `None` without a contact.
pub fn side(ego: &Footprint, other: &Footprint) -> Option<Side> {
    if !ego.touches(other) {
        return None;
    }
    // The order of the tests decides: a corner that touches both the front line and the side is a
    // hit of the front.
    if ego.front_line().touches(other) {
        return Some(Side::Front);
    }
    Some(if ego.rear_line().touches(other) { Side::Rear } else { Side::Lateral })
}

/// The side of the rounded ego that another box touches.
fn contact_side(ego: &RoundedBox, other: &Footprint) -> Option<Side> {
    // The rounded box decides whether there is a contact, and the sharp one which side it is on, as
    // published.
    if ego.distance_m(other) > 0.0 {
        return None;
    }
    side(ego.outline(), other)
}

impl Side {
    /// Whether a contact on this side is the ego's fault.
    pub fn is_at_fault(self) -> bool {
        self != Self::Rear
    }
}

impl Collision {
    /// The contacts by the sides of all tracks that are hit, in the order of the list.
    pub fn from_sides(sides: &[Side]) -> Self {
        let published = sides.last().copied();
        Self { published, any_at_fault: sides.iter().any(|side| side.is_at_fault()) }
    }

    /// Whether the ego is at fault, as published.
    pub fn is_at_fault(&self) -> bool {
        self.published.is_some_and(Side::is_at_fault)
    }
}

/// The input of the scene score.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rollout {
    /// Progress along the recorded drive, as a share.
    pub progress: f64,
    /// Length of the recorded drive, in metres.
    pub recorded_m: f64,
    /// Whether there was a collision at fault.
    pub collision_at_fault: bool,
    /// Whether the ego left the road.
    pub offroad: bool,
}

/// The scene score: 0 after a collision at fault or off the road; else the progress over 0.8, at
/// most 1; 1 for a recording below 5 m.
pub fn scene_score(rollout: &Rollout) -> f64 {
    if rollout.collision_at_fault || rollout.offroad {
        return 0.0;
    }
    // After the rule for faults: a standing scene still fails with a collision.
    if rollout.recorded_m < SHORT_RECORDING_M {
        return 1.0;
    }
    (rollout.progress.clamp(0.0, 1.0) / FULL_PROGRESS).min(1.0)
}

/// All of AlpaSim's scores of an episode.
pub fn scores(record: &DriveRecord) -> Vec<Score> {
    let drive = Drive::from_record(record);
    // The scores of plans need only the time of the cut; an input that is missing here is missing
    // there, too.
    let cut_us = drive.as_ref().map(|drive| drive.cut_us).map_err(Clone::clone);
    let mut scores = vec![scene(&drive), off_road(record, &drive), wrong_lane(record, &drive)];
    scores.extend(alpasim_plans::scores(record, &cut_us));
    scores
}

/// An episode up to where it is cut: after a collision, off the road, or too far off the recorded
/// drive.
struct Drive {
    rollout: Rollout,
    least_gap_m: Option<f64>,
    /// Whether the ego was in a lane of another direction; `None` if the lanes have none.
    wrong_lane: Option<bool>,
    /// The time of the last sample that counts, in microseconds.
    cut_us: i64,
}

impl Drive {
    fn from_record(record: &DriveRecord) -> Result<Self, Missing> {
        let tracks =
            record.tracks.as_ref().ok_or(Missing::new("needs the actors of a scenario"))?;
        let shape = record.shape.ok_or(Missing::new("needs the size of the ego"))?;
        // Both need the drive, and give one reason.
        let no_drive = Missing::new("needs the recorded drive");
        let stations_m = record.stations_m().ok_or(no_drive.clone())?;
        let recorded_m = record.recorded_way_m().ok_or(no_drive)?;
        let rollout =
            Rollout { progress: 0.0, recorded_m, collision_at_fault: false, offroad: false };
        let map = record.map.as_ref();
        let road = map.map(Road::from_map);
        let mut drive = Self { rollout, least_gap_m: None, wrong_lane: None, cut_us: 0 };
        for (step, (sample, (station_m, off_m))) in record.ego.iter().zip(stations_m).enumerate() {
            let ego = RoundedBox::new(&shape, sample);
            let others =
                tracks.iter().filter_map(|track| track.samples.get(step).copied().flatten());
            let others: Vec<Footprint> = others.map(|other| other.footprint).collect();
            let sides: Vec<Side> =
                others.iter().filter_map(|other| contact_side(&ego, other)).collect();
            // The least gap so far is one more candidate, so that the fold goes over the whole
            // episode.
            let gaps_m = others.iter().map(|other| ego.distance_m(other));
            drive.least_gap_m = gaps_m.chain(drive.least_gap_m).reduce(f64::min);
            let off_road = road.as_ref().is_some_and(|road| road.is_off(&ego));
            let wrong = map.and_then(|map| is_in_wrong_lane(map, ego.center_m(), sample.yaw_rad));
            // Once wrong, wrong for the rest. It stays `None` as long as lanes have no direction.
            drive.wrong_lane = wrong.map(|wrong| wrong || drive.wrong_lane == Some(true));
            let rollout = &mut drive.rollout;
            // Progress is that of the last sample and not the largest one. The bound replaces a
            // division by 0; then any station above 0 is full progress.
            rollout.progress = (station_m / recorded_m.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
            rollout.collision_at_fault |= Collision::from_sides(&sides).is_at_fault();
            rollout.offroad |= off_road;
            drive.cut_us = record.dt_us * step as i64;
            // The sample of the cut still counts: its contact is the reason for the cut.
            if !sides.is_empty() || off_road || off_m > CUT_M {
                break;
            }
        }
        Ok(drive)
    }
}

/// Without a map off-road counts as 0, as AlpaSim fills it in.
fn scene(drive: &Result<Drive, Missing>) -> Score {
    let value = drive.as_ref().map(|drive| scene_score(&drive.rollout)).map_err(Clone::clone);
    let part = |value: &dyn Fn(&Rollout) -> f64| Some(value(&drive.as_ref().ok()?.rollout));
    let parts = [
        ("progress_clipped_rel", part(&|rollout| rollout.progress)),
        ("gt_dist_traveled_m", part(&|rollout| rollout.recorded_m)),
        ("collision_at_fault", part(&|rollout| f64::from(u8::from(rollout.collision_at_fault)))),
        ("offroad", part(&|rollout| f64::from(u8::from(rollout.offroad)))),
        ("least_gap_m", drive.as_ref().ok().and_then(|drive| drive.least_gap_m)),
    ];
    Score::new(NAME, value, parts)
}

fn off_road(record: &DriveRecord, drive: &Result<Drive, Missing>) -> Score {
    let map = record.map.as_ref().ok_or(Missing::new("needs a map of the lanes"));
    let value = map.and_then(|_| Ok(drive.as_ref().map_err(Clone::clone)?.rollout.offroad));
    Score::new(OFF_ROAD, value.map(|off| f64::from(u8::from(off))), [])
}

fn wrong_lane(record: &DriveRecord, drive: &Result<Drive, Missing>) -> Score {
    let map = record.map.as_ref().ok_or(Missing::new("needs a map of the lanes"));
    let value = map.and_then(|_| {
        let wrong = drive.as_ref().map_err(Clone::clone)?.wrong_lane;
        wrong.ok_or(Missing::new("needs the middles of the lanes, which this record lacks"))
    });
    Score::new(WRONG_LANE, value.map(|wrong| f64::from(u8::from(wrong))), [])
}
