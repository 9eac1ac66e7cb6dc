//! The sweeps of an observation.

use std::time::Duration;

use tokio::time::Instant;
use tracing::{Instrument, debug_span};

use wildcity_render::{Backend, RenderError};

use super::requests::SimulationState;
use super::{PinnedVersion, Session};
use crate::engine::answer_budget::BudgetShare;
use crate::engine::render_queue::{FrameCost, Scratch};
use crate::error::SessionError;
use crate::limits;
use crate::observe::layout::EffectSeed;
use crate::observe::point_cloud::{PointCloud, lidar_view};
use crate::pin::pin;
use crate::scenario::assets::FrameDetail;
use crate::viewpoint::lidar_viewpoint;

/// The sweeps of an observation, counted against the budget for answers.
pub(super) struct Sweeps {
    pub(super) clouds: Vec<PointCloud>,
    /// For each, the sections that had to be loaded, how long that took, and how long it was
    /// queued.
    pub(super) loads: Vec<(usize, Duration, Duration)>,
    _share: BudgetShare,
}

impl Session {
    /// The sweeps of all LiDARs that end now, each scheduled as a frame of as many samples as it
    /// has beams. A rig without LiDARs costs nothing.
    pub(super) async fn sweeps(
        &self,
        version: &PinnedVersion,
        simulation: SimulationState<'_>,
        deadline: Instant,
    ) -> Result<Sweeps, SessionError> {
        let SimulationState { episode, traffic } = simulation;
        let layout = &self.settings.layout;
        let beams: usize = layout.lidars().iter().map(|mounted| mounted.lidar.beams()).sum();
        // The returns, the points, and their copy on its way into the answer.
        let bytes = 3 * limits::POINT_BYTES * beams as u64;
        let share = self.engine.answer_budget().reserve(bytes)?;
        let mut sweeps = Sweeps { clouds: Vec::new(), loads: Vec::new(), _share: share };
        for (index, mounted) in layout.lidars().iter().enumerate() {
            let view = lidar_view(mounted, episode);
            let viewpoints = vec![lidar_viewpoint(&view)];
            let profile = version.profile;
            let time_us = episode.time_us();
            let placed = traffic.map(|traffic| {
                let exposures_us = &[mounted.lidar.duration_us()];
                let detail =
                    FrameDetail { viewpoints: &viewpoints, exposures_us, profile: &profile };
                traffic.placed(time_us, detail)
            });
            // Load before the job is queued, so that no render thread waits for a disk.
            let resident = version.resident.clone();
            let pinned = pin(resident, profile, deadline, viewpoints);
            let mut scene = pinned.instrument(debug_span!("load")).await?;
            let load = (scene.waited_for, scene.waited);
            scene.place(placed.unwrap_or_default());
            let samples = mounted.lidar.beams() as u64;
            let cost = FrameCost { session: self.slot.number(), samples };
            let seed = EffectSeed::from_episode(episode);
            let has_classes = layout.maps().semantics;
            let sensor = layout.lidar_sensor(index).copied();
            let mounted = mounted.clone();
            // The points and their hash, too: they would hold up the other sessions of an async
            // thread.
            let work = move |_: &mut Scratch, backend: &dyn Backend| {
                let sweep = backend.sweep(&scene, &profile, &view)?;
                let classes = has_classes.then(|| sweep.classes(&scene)).transpose()?;
                let effects = sensor.as_ref().map(|sensor| (sensor, seed));
                let sweep = (&sweep, classes.as_deref());
                Ok(PointCloud::new(index, &mounted, sweep, time_us, effects))
            };
            let (cloud, queued): (Result<_, RenderError>, _) =
                self.engine.run(cost, deadline, work).await?;
            sweeps.loads.push((load.0, load.1, queued));
            sweeps.clouds.push(cloud?);
        }
        Ok(sweeps)
    }
}
