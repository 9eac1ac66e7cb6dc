//! NAVSIM's extended predictive driver model score (EPDMS), including its defects.
//!
//! Source: autonomousvision/navsim 0a380a9, `pdm_scorer.py`, `pdm_score.py`, `run_pdm_score.py`;
//! comfort is nuPlan's. A score is of 4 s: 41 states 0.1 s apart.
//!
//! | file | what it computes |
//! |---|---|
//! | `rules.rs` | collisions, drivable area, direction, lights, progress, time to collision, lane keeping |
//! | `comfort.rs` | history comfort and extended comfort |

mod comfort;
mod rules;

use wildcity_scene::ActorClass;
use wildcity_sim::contact::CollisionType;

use super::map::LaneMap;
use super::record::{DriveRecord, EgoSample, EgoShape, Track};
use super::scored::{Missing, Score};

pub use comfort::bounds;
pub use comfort::{ComfortSignals, ExtendedComfort, comfort_signals, extended_comfort, is_within};
pub use rules::rules;

/// The name of the score.
pub const NAME: &str = "navsim.epdms@0a380a9";

/// nuPlan's ego, a Chrysler Pacifica.
pub const PACIFICA: EgoShape = EgoShape { length_m: 5.176, width_m: 2.297, center_x_m: 1.461 };

/// Time between two states, in seconds.
pub const STEP_S: f64 = 0.1;

/// States of a score.
pub const STATES: usize = 41;

/// The input of the rules.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    pub shape: EgoShape,
    /// The ego, [`STATES`] samples 0.1 s apart.
    pub ego: &'a [EgoSample],
    /// The actors, over the same samples.
    pub tracks: &'a [Track],
    pub map: &'a LaneMap,
    /// Progress of the reference (PDM-Closed) along the centre line, in metres.
    pub reference_progress_m: f64,
}

/// Results of the rules.
#[derive(Clone, Debug, PartialEq)]
pub struct Rules {
    /// NC: 1; 0 after a contact at fault with an agent, 0.5 with an object.
    pub no_at_fault_collisions: f64,
    /// DAC: 0 if a corner was ever outside of all lanes.
    pub drivable_area_compliance: f64,
    /// DDC: 1, 0.5 or 0 by the way driven against the traffic within a second.
    pub driving_direction_compliance: f64,
    /// TLC: 0 if the ego touched a red connector.
    pub traffic_light_compliance: f64,
    /// EP: its progress divided by the reference's.
    pub ego_progress: f64,
    /// TTC: 0 if it would have touched a track within 0.9 s.
    pub time_to_collision_within_bound: f64,
    /// LK: 0 if it was 20 samples in a row more than 0.5 m off the centre line.
    pub lane_keeping: f64,
    /// The sample of the first contact at fault.
    pub first_at_fault_step: Option<usize>,
    /// The sample of the first violation of the time to collision.
    pub first_ttc_step: Option<usize>,
    /// The kind of the first contact with each track.
    pub collision_types: Vec<Option<CollisionType>>,
}

/// All sub-scores, 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Submetrics {
    pub nc: f64,
    pub dac: f64,
    pub ddc: f64,
    pub tlc: f64,
    pub ep: f64,
    /// Time to collision within bound.
    pub ttc: f64,
    pub lk: f64,
    pub hc: f64,
    pub ec: f64,
}

impl Submetrics {
    pub const PERFECT: Self = Self {
        nc: 1.0,
        dac: 1.0,
        ddc: 1.0,
        tlc: 1.0,
        ep: 1.0,
        ttc: 1.0,
        lk: 1.0,
        hc: 1.0,
        ec: 1.0,
    };
}

/// The score: the product of the rules that must hold, times the weighted mean of the others.
///
/// A sub-score in which the human driver scored exactly 0 counts as 1, except for the extended
/// comfort.
pub fn epdms(agent: &Submetrics, human: Option<&Submetrics>) -> f64 {
    let human = human.unwrap_or(&Submetrics::PERFECT);
    let filtered = |agent: f64, human: f64| if human == 0.0 { 1.0 } else { agent };
    let rules = filtered(agent.nc, human.nc)
        * filtered(agent.dac, human.dac)
        * filtered(agent.ddc, human.ddc)
        * filtered(agent.tlc, human.tlc);
    // Weights 5 + 5 + 2 + 2 + 2 = 16.
    let weighted = 5.0 * filtered(agent.ep, human.ep)
        + 5.0 * filtered(agent.ttc, human.ttc)
        + 2.0 * filtered(agent.lk, human.lk)
        + 2.0 * filtered(agent.hc, human.hc)
        + 2.0 * agent.ec;
    rules * weighted / 16.0
}

/// Whether a track is one of NAVSIM's agents; the others are objects.
fn is_agent(class: ActorClass) -> bool {
    class != ActorClass::Object
}

/// The score of an episode. It has no value: the published score divides by the progress of the
/// planner PDM-Closed, which this project does not have, and compares successive plans, which a
/// driven episode does not have. Its parts are the sub-metrics that need neither, for the driven
/// path: the minimum over all whole 4 s. A record has no traffic lights.
pub fn pdm(record: &DriveRecord) -> Score {
    let map = match record.map {
        None => "a map of the lanes, ",
        Some(_) => "",
    };
    let tracks = match record.tracks {
        None => "the actors of a scenario, ",
        Some(_) => "",
    };
    let missing = format!("needs {map}{tracks}the planner PDM-Closed and successive plans");
    let comfort = history_comfort(record).map(|comfort| f64::from(u8::from(comfort)));
    let rules = rules_as_driven(record);
    // `None` without a whole window: the part has no value, not 1.
    let least = |value: &dyn Fn(&Rules) -> f64| rules.iter().map(value).reduce(f64::min);
    let parts = [
        ("no_at_fault_collisions", least(&|rules| rules.no_at_fault_collisions)),
        ("drivable_area_compliance", least(&|rules| rules.drivable_area_compliance)),
        ("driving_direction_compliance", least(&|rules| rules.driving_direction_compliance)),
        ("traffic_light_compliance", None),
        ("ego_progress", None),
        ("time_to_collision_within_bound", least(&|rules| rules.time_to_collision_within_bound)),
        ("lane_keeping", least(&|rules| rules.lane_keeping)),
        ("history_comfort", comfort),
        ("extended_comfort", None),
    ];
    Score::new(NAME, Err(Missing::new(missing)), parts)
}

/// The rules over each whole 4 s; none without a map, actors, and samples 0.1 s apart.
fn rules_as_driven(record: &DriveRecord) -> Vec<Rules> {
    let Some(map) = &record.map else { return Vec::new() };
    let Some(tracks) = &record.tracks else { return Vec::new() };
    let Some(shape) = record.shape else { return Vec::new() };
    if !record.is_driven || record.dt_us != 100_000 {
        return Vec::new();
    }
    // Windows share their end state: 40 intervals of 0.1 s each. A rest of less than 4 s is left
    // out.
    let firsts = (0..record.ego.len()).step_by(STATES - 1);
    let windows = firsts.filter_map(|first| Some((first, record.ego.get(first..first + STATES)?)));
    windows
        .map(|(first, ego)| {
            let of_window = |track: &Track| Track {
                name: track.name.clone(),
                class: track.class,
                samples: track.samples.iter().copied().skip(first).take(STATES).collect(),
            };
            let tracks: Vec<Track> = tracks.iter().map(of_window).collect();
            // Progress is not used, and a reference of 0 keeps it from being measured.
            rules(&Scene { shape, ego, tracks: &tracks, map, reference_progress_m: 0.0 })
        })
        .collect()
}

/// HC over the whole episode, if it has samples 0.1 s apart.
fn history_comfort(record: &DriveRecord) -> Option<bool> {
    if !record.is_driven || record.dt_us != 100_000 {
        return None;
    }
    let shape = record.shape.unwrap_or(PACIFICA);
    let signals = comfort_signals(&record.ego, STEP_S, shape.center_x_m)?;
    Some(is_within(&signals).into_iter().all(|within| within))
}
