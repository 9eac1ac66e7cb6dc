//! The actors of a recorded episode, as its frames show them.

use std::iter::Peekable;
use std::slice::Iter;

use wildcity_episode::{ActorStateLine, ActorsLine};
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::geometry::Pose;
use wildcity_sim::traffic::ActorState;
use wildcity_twin::residency::{Cache, ResidencyError};

use super::recorded_episode::RecordedEpisode;
use crate::scenario::assets::{ActorAssets, FrameDetail, exposure_start_us};
use crate::scenario::past::ActorPast;
use crate::viewpoint::longest_exposure_us;

/// Where the actors were up to a frame of a record.
pub(super) struct ActorReplay<'a> {
    assets: ActorAssets,
    count: usize,
    /// The longest exposure of a camera, in microseconds.
    exposure_us: i64,
    /// Actors of later frames, each with the number of frames before it.
    later: Peekable<Iter<'a, (usize, ActorsLine)>>,
    past: ActorPast,
}

impl<'a> ActorReplay<'a> {
    /// The actors before the first frame. Brings their assets into memory.
    ///
    /// # Errors
    /// An asset cannot be read, or there is no room for it.
    pub(super) fn new(episode: &'a RecordedEpisode, cache: &Cache) -> Result<Self, ResidencyError> {
        let rig = &episode.header.rig;
        let actors = episode.scenario.as_ref().map_or(&[][..], |scenario| &scenario.actors);
        Ok(Self {
            assets: ActorAssets::load(cache, actors.iter().map(|actor| actor.asset.as_deref()))?,
            count: actors.len(),
            exposure_us: longest_exposure_us(&rig.cameras, &rig.lidars),
            later: episode.actors.iter().peekable(),
            past: ActorPast::default(),
        })
    }

    /// Goes on to a frame, by its index.
    pub(super) fn advance(&mut self, frame: usize) {
        // A line belongs to the frame that follows it, so that it has the frame's index before it.
        while let Some((_, line)) = self.later.next_if(|(before, _)| *before <= frame) {
            // No frame of a later request looks farther back, and its exposure not before this.
            self.past.drop_before(line.time_us - self.exposure_us - LONGEST_REQUEST_US);
            self.past.push(line.time_us, &states(line, self.count));
        }
    }

    /// The actors that a frame of a time shows.
    pub(super) fn placed(&self, taken_us: i64, frame: FrameDetail<'_>) -> Vec<PlacedChunk> {
        if self.assets.is_empty() {
            return Vec::new();
        }
        // A rolling shutter shows an actor from one pose to the other.
        let before = |exposure_us| self.past.poses_at(exposure_start_us(taken_us, exposure_us));
        self.assets.placed(&self.past.poses_at(taken_us), &before, frame)
    }
}

/// No request shows frames from longer ago than this, in microseconds.
const LONGEST_REQUEST_US: i64 = crate::limits::PLAN_US + crate::limits::DT_MAX_US;

/// All actors of a line, by their index; those that it leaves out are absent.
fn states(line: &ActorsLine, count: usize) -> Vec<ActorState> {
    let absent = |index: usize| ActorState {
        // Lines have indices as u16, so that a scenario has no more actors.
        index: index as u16,
        world_from_actor: Pose::IDENTITY,
        velocity_mps: glam::DVec3::ZERO,
        yaw_rate_radps: 0.0,
        present: false,
    };
    let mut states: Vec<ActorState> = (0..count).map(absent).collect();
    for state in line.actors.iter().filter_map(ActorStateLine::state) {
        // `RecordedEpisode::read` has checked the indices.
        if let Some(place) = states.get_mut(usize::from(state.index)) {
            *place = state;
        }
    }
    states
}
