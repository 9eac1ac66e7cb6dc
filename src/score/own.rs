//! `wildcity.verdict@3`: whether an episode passed.
//!
//! It passes if the ego had no contact at fault (`wildcity.fault@1`), with a pedestrian, or with
//! the twin (`wildcity.static@1`), stayed on the drivable area, and made enough progress. A
//! criterion whose input is missing in the record is not judged. An episode without a fault then is
//! not judged either: what was not looked for is no pass. An episode that left the trained area
//! before its first fault neither passes nor fails, because its images were not reliable.

use serde::Serialize;

use wildcity_scene::ActorClass;
use wildcity_sim::contact::{MAX_SWEPT_SPEED_MPS, Moving, STANDING_MPS, time_to_contact_s};

use super::record::{DriveRecord, EgoSample, Track};
use super::scored::{Missing, Score};

/// The name of the score: 1 passed, 0 failed.
pub const NAME: &str = "wildcity.verdict@3";

/// Default for the progress that is required to pass.
pub const LEAST_PROGRESS: f64 = 0.8;
/// Longest step within which contacts are found, in microseconds. They are looked for along the
/// cubic between the ends of a step, which leaves the driven motion by 0.1 mm in half a second and
/// by metres in several; the road is looked at at the ends only.
pub const MOST_STEP_US: i64 = 500_000;

/// Why the absence of contacts is not judged after a jump; a contact that was found counts.
const JUMPS: &str = "the ego jumped faster than 60 m/s, and what was on its way was not tested";
/// Why the absence of faults is not judged in long steps; a fault that was found counts.
const LONG_STEPS: &str = "what is on the way within a step of more than 0.5 s was not tested";

/// Progress is not measured along a recording that moves less than this, in metres.
const LEAST_WAY_M: f64 = 2.0;

/// The verdict on an episode as a whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Judgement {
    Passed,
    /// At least one fault.
    Failed,
    /// The ego left the trained area before any fault.
    OffModel,
    /// No fault, but the record lacks the input of a criterion.
    NotJudged,
}

/// Why an episode failed. Its name is the `type` of the failure in JUnit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub enum Fault {
    /// A contact with an actor that is the ego's fault.
    #[serde(rename = "contact.at_fault")]
    ContactAtFault,
    /// A contact of a moving ego with a pedestrian.
    #[serde(rename = "contact.pedestrian")]
    Pedestrian,
    /// A contact with the twin.
    #[serde(rename = "contact.static")]
    Static,
    /// A corner of the ego outside of all lanes.
    #[serde(rename = "off_road")]
    OffRoad,
    #[serde(rename = "progress")]
    Progress,
}

/// A part of the verdict, named after its fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Criterion {
    Contact,
    /// Contact with the twin.
    Static,
    /// The ego on the drivable area.
    OffRoad,
    /// Progress along the recorded drive.
    Progress,
}

impl Criterion {
    pub const ALL: [Self; 4] = [Self::Contact, Self::Static, Self::OffRoad, Self::Progress];

    /// The name in results: that of its fault, or the beginning of their names.
    pub fn name(self) -> &'static str {
        match self {
            Self::Contact => "contact",
            Self::Static => "contact.static",
            Self::OffRoad => "off_road",
            Self::Progress => "progress",
        }
    }
}

/// A criterion that was not judged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotJudged {
    pub criterion: Criterion,
    pub reason: &'static str,
}

impl std::fmt::Display for NotJudged {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.criterion.name(), self.reason)
    }
}

/// A fault and when it happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct FaultAt {
    pub fault: Fault,
    /// Its time, in microseconds.
    pub time_us: i64,
    /// The actor, for a contact with one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub actor: Option<u16>,
}

/// The verdict of an episode, with the values that it is based on.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    pub judgement: Judgement,
    /// All faults, by time.
    pub faults: Vec<FaultAt>,
    /// The criteria that were not judged.
    pub not_judged: Vec<NotJudged>,
    /// Distance along the recorded drive divided by that of the recording in the same time.
    pub progress: Option<f64>,
    /// Progress that is required to pass.
    pub least_progress: f64,
    /// The shortest time to contact with an actor, in seconds.
    pub least_ttc_s: Option<f64>,
    /// The largest impact speed, in m/s.
    pub impact_mps: Option<f64>,
    /// Largest accelerations, in m/s²: along the car, and v·ω across it. Not of a teleported ego.
    pub accelerations_mps2: Option<[f64; 2]>,
}

impl Fault {
    /// The name in results.
    pub fn name(self) -> &'static str {
        match self {
            Self::ContactAtFault => "contact.at_fault",
            Self::Pedestrian => "contact.pedestrian",
            Self::Static => "contact.static",
            Self::OffRoad => "off_road",
            Self::Progress => "progress",
        }
    }
}

/// Judges an episode by WildCity's own criteria.
pub fn verdict(record: &DriveRecord) -> Verdict {
    let mut not_judged = Vec::new();
    // Criteria without their input are collected, not returned early: a fault of another one still
    // decides.
    let mut lacks = |criterion, reason| not_judged.push(NotJudged { criterion, reason });
    let mut faults = contact_faults(record);
    if record.tracks.is_none() {
        lacks(Criterion::Contact, "the record has no scenario");
    } else if let Some(reason) = untested(record) {
        lacks(Criterion::Contact, reason);
    }
    match &record.static_contacts {
        None => lacks(Criterion::Static, "contact with the twin was not looked for"),
        Some(contacts) => {
            faults.extend(contacts.iter().map(|contact| FaultAt {
                fault: Fault::Static,
                time_us: contact.time_us,
                actor: None,
            }));
            if let Some(reason) = untested(record) {
                lacks(Criterion::Static, reason);
            }
        }
    }
    match (&record.map, &record.shape) {
        (Some(map), Some(shape)) => {
            let off = |sample| map.position(&shape.footprint(sample)).off_drivable;
            // Only the first sample off the road: one fault for one excursion or many.
            let first = record.ego.iter().position(off);
            faults.extend(first.map(|step| FaultAt {
                fault: Fault::OffRoad,
                time_us: step as i64 * record.dt_us,
                actor: None,
            }));
            if record.dt_us > MOST_STEP_US {
                lacks(Criterion::OffRoad, LONG_STEPS);
            }
        }
        (Some(_), None) => lacks(Criterion::OffRoad, "the record has no size of the ego"),
        (None, _) => lacks(Criterion::OffRoad, record.no_map),
    }
    // Judged at the end: progress has no earlier time.
    let progress = progress(record);
    match progress {
        None => lacks(Criterion::Progress, record.no_reference),
        Some(progress) if progress < record.least_progress => {
            faults.push(FaultAt { fault: Fault::Progress, time_us: record.end_us(), actor: None });
        }
        Some(_) => {}
    }
    // Stable: faults of one time keep the order contact, twin, road, progress.
    faults.sort_by_key(|fault| fault.time_us);
    let impacts = record.contacts.iter().filter(|contact| !contact.at_start);
    Verdict {
        judgement: judgement(record, &faults, &not_judged),
        faults,
        not_judged,
        progress,
        least_progress: record.least_progress,
        least_ttc_s: least_ttc_s(record),
        impact_mps: impacts.map(|contact| contact.impact_mps).reduce(f64::max),
        accelerations_mps2: accelerations_mps2(record),
    }
}

fn judgement(record: &DriveRecord, faults: &[FaultAt], not_judged: &[NotJudged]) -> Judgement {
    let first_us = faults.first().map(|fault| fault.time_us);
    let off_model =
        // Strictly before: a fault at the same time still counts as seen on the trained area.
        record.off_model_us.is_some_and(|off_us| first_us.is_none_or(|fault_us| off_us < fault_us));
    if off_model {
        Judgement::OffModel
    } else if !faults.is_empty() {
        // Any fault decides, whatever was not judged; only a pass needs all criteria.
        Judgement::Failed
    } else if !not_judged.is_empty() {
        Judgement::NotJudged
    } else {
        Judgement::Passed
    }
}

/// Why contacts may have been missed: within long steps, or by a teleported ego that was put
/// farther away within a step than the way is swept, and may have passed through an actor or a
/// wall.
fn untested(record: &DriveRecord) -> Option<&'static str> {
    let most_m = MAX_SWEPT_SPEED_MPS * record.dt_us as f64 * 1e-6;
    let is_far = |pair: &[EgoSample]| pair[0].origin_m.distance(pair[1].origin_m) > most_m;
    if record.dt_us > MOST_STEP_US {
        Some(LONG_STEPS)
    } else if !record.is_driven && record.ego.windows(2).any(is_far) {
        Some(JUMPS)
    } else {
        None
    }
}

/// Contacts at fault, and those of a moving ego with a pedestrian. Boxes that overlapped at the
/// start are not judged.
fn contact_faults(record: &DriveRecord) -> Vec<FaultAt> {
    let tracks = record.tracks.as_deref().unwrap_or_default();
    let judged = record.contacts.iter().filter(|contact| !contact.at_start);
    judged
        .filter_map(|contact| {
            let class = tracks.get(usize::from(contact.actor)).map(|track| track.class);
            // A standing ego is not charged with a pedestrian that walks into it, unless the rules
            // of fault say so.
            let moves = contact.ego_velocity_mps.length() > STANDING_MPS;
            let fault = match (class, contact.ego_at_fault) {
                (Some(ActorClass::Pedestrian), _) if moves => Fault::Pedestrian,
                (_, true) => Fault::ContactAtFault,
                (_, false) => return None,
            };
            Some(FaultAt { fault, time_us: contact.time_us, actor: Some(contact.actor) })
        })
        .collect()
}

/// The distance along the recorded drive divided by that of the recording, 0 to 1; 1 if the
/// recording stands (below 2 m, as in nuPlan).
fn progress(record: &DriveRecord) -> Option<f64> {
    let stations_m = record.stations_m()?;
    let recorded_m = record.recorded_way_m()?;
    if recorded_m < LEAST_WAY_M {
        return Some(1.0);
    }
    // The difference, because the first sample need not be at station 0.
    let way_m = stations_m.last()?.0 - stations_m.first()?.0;
    Some((way_m / recorded_m).clamp(0.0, 1.0))
}

fn least_ttc_s(record: &DriveRecord) -> Option<f64> {
    let shape = record.shape?;
    let tracks = record.tracks.as_deref()?;
    let at = |step: usize| {
        let ego = record.ego[step];
        let own =
            Moving { footprint: shape.footprint(&ego), velocity_mps: ego.world_velocity_mps() };
        tracks.iter().filter_map(move |track: &Track| {
            let sample = track.samples.get(step).copied().flatten()?;
            let other = Moving { footprint: sample.footprint, velocity_mps: sample.velocity_mps };
            time_to_contact_s(&own, &other)
        })
    };
    (0..record.ego.len()).flat_map(at).reduce(f64::min)
}

fn accelerations_mps2(record: &DriveRecord) -> Option<[f64; 2]> {
    if !record.is_driven {
        return None;
    }
    let most = |value: &dyn Fn(&EgoSample) -> f64| {
        record.ego.iter().map(|ego| value(ego).abs()).fold(0.0, f64::max)
    };
    let along = most(&|ego| ego.acceleration_mps2.x);
    // v ω is the centripetal acceleration of the rear axle.
    let across = most(&|ego| ego.velocity_mps.x * ego.yaw_rate_radps);
    Some([along, across])
}

impl Verdict {
    /// The verdict as a score.
    pub fn score(&self) -> Score {
        let value = match self.judgement {
            Judgement::Passed => Ok(1.0),
            Judgement::Failed => Ok(0.0),
            Judgement::OffModel => {
                Err(Missing::new("left the trained area of the twin before any fault"))
            }
            Judgement::NotJudged => {
                let reasons: Vec<String> =
                    self.not_judged.iter().map(NotJudged::to_string).collect();
                Err(Missing::new(reasons.join("; ")))
            }
        };
        let [along, across] = match self.accelerations_mps2 {
            Some(accelerations) => accelerations.map(Some),
            None => [None, None],
        };
        let parts = [
            ("progress", self.progress),
            ("least_progress", Some(self.least_progress)),
            ("least_ttc_s", self.least_ttc_s),
            ("impact_mps", self.impact_mps),
            ("longitudinal_acceleration_mps2", along),
            ("lateral_acceleration_mps2", across),
        ];
        Score::new(NAME, value, parts)
    }
}
