//! AlpaSim's scene score, with its faults.
//!
//! Source: NVlabs/alpasim 3032e0c, `src/eval/src/eval/aggregation/scene_score.py`, `scorers/collision.py`,
//! `scorers/plan_deviation.py`.

use wildcity_sim::contact::Footprint;

use super::record::{DriveRecord, EgoSample, EgoShape};
use super::scored::{Measured, Missing, Score};

/// The name of the score.
pub const NAME: &str = "alpasim.scene@3032e0c";

/// Progress at which the score saturates.
const FULL_PROGRESS: f64 = 0.8;
/// A recording that is shorter says nothing of progress, in metres.
const SHORT_RECORDING_M: f64 = 5.0;
/// The episode is cut where the ego is farther from the recorded drive, in metres.
const CUT_M: f64 = 4.0;
/// Share of the rig's box that is tested.
const BOX_SHARE: f64 = 0.98;
/// Radius of its corners, as a share of the lesser side.
const CORNER_SHARE: f64 = 0.25;

/// Which side of the ego was hit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The front line touches the other.
    Front,
    /// The rear line does.
    Rear,
    /// Neither does.
    Lateral,
}

/// The contacts at one instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Collision {
    /// As published: that of the last track in the list. Another track after it hides a contact of the front.
    pub published: Option<Side>,
    /// Whether any track was hit by the front or the side.
    pub any_at_fault: bool,
}

/// The side that another box touches; front is asked first. `None` without a contact.
pub fn side(ego: &Footprint, other: &Footprint) -> Option<Side> {
    if !ego.touches(other) {
        return None;
    }
    if ego.front_line().touches(other) {
        return Some(Side::Front);
    }
    Some(if ego.rear_line().touches(other) { Side::Rear } else { Side::Lateral })
}

impl Side {
    /// Whether it is the ego's fault.
    pub fn is_at_fault(self) -> bool {
        self != Self::Rear
    }
}

impl Collision {
    /// From the sides of all tracks that are hit, in the order of the list.
    pub fn of(sides: &[Side]) -> Self {
        let published = sides.last().copied();
        Self { published, any_at_fault: sides.iter().any(|side| side.is_at_fault()) }
    }

    /// Whether the ego is at fault, as published.
    pub fn is_at_fault(&self) -> bool {
        self.published.is_some_and(Side::is_at_fault)
    }
}

/// What the scene score depends on.
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

/// The scene score: 0 after a collision at fault or off the road; else the progress over 0.8, at most 1; 1 for a
/// recording below 5 m.
pub fn scene_score(rollout: &Rollout) -> f64 {
    if rollout.collision_at_fault || rollout.offroad {
        return 0.0;
    }
    if rollout.recorded_m < SHORT_RECORDING_M {
        return 1.0;
    }
    (rollout.progress.clamp(0.0, 1.0) / FULL_PROGRESS).min(1.0)
}

/// The mean of distances between successive plans, weighted by exp(-decay k); `None` of none.
pub fn plan_deviation(distances_m: &[f64], decay: f64) -> Option<f64> {
    let weight = |k: usize| (-decay * k as f64).exp();
    let sum: f64 =
        distances_m.iter().enumerate().map(|(k, distance_m)| weight(k) * distance_m).sum();
    let weights: f64 = (0..distances_m.len()).map(weight).sum();
    (weights > 0.0).then(|| sum / weights)
}

/// The scene score of an episode. Without a map off-road counts as 0, as AlpaSim fills it in.
pub fn scene(record: &DriveRecord) -> Score {
    let rollout = rollout(record);
    let value: Measured =
        rollout.as_ref().map(|(rollout, _)| scene_score(rollout)).map_err(Clone::clone);
    let part = |value: &dyn Fn(&Rollout) -> f64| rollout.as_ref().ok().map(|(r, _)| value(r));
    let parts = [
        ("progress_clipped_rel", part(&|rollout| rollout.progress)),
        ("gt_dist_traveled_m", part(&|rollout| rollout.recorded_m)),
        ("collision_at_fault", part(&|rollout| f64::from(u8::from(rollout.collision_at_fault)))),
        ("offroad", part(&|rollout| f64::from(u8::from(rollout.offroad)))),
        ("least_gap_m", rollout.as_ref().ok().and_then(|(_, least_gap_m)| *least_gap_m)),
    ];
    Score::new(NAME, value, parts)
}

fn rollout(record: &DriveRecord) -> Result<(Rollout, Option<f64>), Missing> {
    let tracks = record.tracks.as_ref().ok_or(Missing::new("needs the actors of a scenario"))?;
    let shape = record.shape.ok_or(Missing::new("needs the size of the ego"))?;
    let stations_m = record.stations_m().ok_or(Missing::new("needs the recorded drive"))?;
    let recorded_m = record.recorded_way_m().ok_or(Missing::new("needs the recorded drive"))?;
    let mut rollout =
        Rollout { progress: 0.0, recorded_m, collision_at_fault: false, offroad: false };
    let mut least_gap_m: Option<f64> = None;
    for (step, (sample, (station_m, off_m))) in record.ego.iter().zip(stations_m).enumerate() {
        let ego = RoundedBox::of(&shape, sample);
        let others = tracks.iter().filter_map(|track| track.samples.get(step).copied().flatten());
        let others: Vec<Footprint> = others.map(|other| other.footprint).collect();
        let sides: Vec<Side> = others.iter().filter_map(|other| ego.side(other)).collect();
        let gaps_m = others.iter().map(|other| ego.distance_m(other));
        least_gap_m = gaps_m.chain(least_gap_m).reduce(f64::min);
        let off_road = record
            .map
            .as_ref()
            .is_some_and(|map| map.position(&shape.footprint(sample)).off_drivable);
        rollout.progress = (station_m / recorded_m.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        rollout.collision_at_fault |= Collision::of(&sides).is_at_fault();
        rollout.offroad |= off_road;
        if !sides.is_empty() || off_road || off_m > CUT_M {
            break;
        }
    }
    Ok((rollout, least_gap_m))
}

/// The ego as AlpaSim tests it: 2 % smaller, with rounded corners.
struct RoundedBox {
    outline: Footprint,
    /// The box whose points are all within `radius_m` of the rounded one.
    core: Footprint,
    radius_m: f64,
}

impl RoundedBox {
    fn of(shape: &EgoShape, sample: &EgoSample) -> Self {
        let full = shape.footprint(sample);
        let length_m = BOX_SHARE * full.length_m;
        let width_m = BOX_SHARE * full.width_m;
        let radius_m = CORNER_SHARE * length_m.min(width_m);
        let outline = Footprint { length_m, width_m, ..full };
        let core = Footprint {
            length_m: length_m - 2.0 * radius_m,
            width_m: width_m - 2.0 * radius_m,
            ..full
        };
        Self { outline, core, radius_m }
    }

    fn distance_m(&self, other: &Footprint) -> f64 {
        (self.core.distance_m(other) - self.radius_m).max(0.0)
    }

    fn side(&self, other: &Footprint) -> Option<Side> {
        if self.distance_m(other) > 0.0 {
            return None;
        }
        side(&self.outline, other)
    }
}
