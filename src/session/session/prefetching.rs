//! Prefetching: loads the sections that the next steps need while the agent computes.

use tokio::time::Instant;

use wildcity_scene::geometry::Pose;
use wildcity_twin::residency::Urgency;

use super::Session;
use crate::error::SessionError;
use crate::limits;
use crate::prefetch::forecast::{EgoForecast, remaining_hint};

impl Session {
    /// Accepts the path that the agent announces: from 1 to [`limits::PREFETCH_POSES`] poses
    /// (`world_from_rig`), in order. Loads what is visible from these poses and from points between
    /// them, as far as memory allows. Does not wait for the loads.
    ///
    /// # Errors
    /// The number of poses is out of range.
    pub fn prefetch(&mut self, poses: Vec<Pose>) -> Result<(), SessionError> {
        if !(1..=limits::PREFETCH_POSES).contains(&poses.len()) {
            let must = format!("{}; 1 to {} are accepted", poses.len(), limits::PREFETCH_POSES);
            return Err(SessionError::OutOfRange { field: "poses", must });
        }
        self.hint = poses;
        self.prefetch_at(self.forecast().places());
        Ok(())
    }

    /// After a step: measures the agent's pace and prefetches for the next steps.
    pub(super) fn look_ahead(&mut self) {
        // Real time, with what the agent needs to decide: that is the time there is for loading.
        self.frame_interval = self.last_frame_at.elapsed();
        self.last_frame_at = Instant::now();
        self.hint = remaining_hint(&self.hint, self.state.episode.world_from_rig()).to_vec();
        self.prefetch_at(self.forecast().places());
    }

    /// Forecast of where the ego may go in the time that loading takes.
    pub(super) fn forecast(&self) -> EgoForecast<'_> {
        let (shortest, longest) = limits::PREFETCH_AHEAD;
        let ahead = (3 * self.resident().load_p99()).clamp(shortest, longest);
        // Less than 1 ms counts as 1 ms, so that this never divides by 0.
        let steps = ahead.as_secs_f64() / self.frame_interval.as_secs_f64().max(1e-3);
        EgoForecast {
            world_from_rig: self.state.episode.world_from_rig(),
            // The displacement of a step, if the velocity stays.
            last_step_m: self.state.episode.ego().velocity_m_s()
                * (self.settings.dt_us as f64 * 1e-6),
            steps: (steps.ceil() as usize).min(limits::STEPS_AHEAD),
            drive: self.settings.drive.as_deref(),
            hint: &self.hint,
        }
    }

    /// Loads in the background the sections that are visible from some poses, in place of an
    /// earlier prefetch.
    pub(super) fn prefetch_at(&self, places: Vec<(Urgency, Pose)>) {
        // Copies of all that the task needs: it may run while later steps change the session.
        let prefetcher = self.reservation.prefetcher().clone();
        let layout = self.settings.layout.clone();
        let profile = self.version.profile;
        let solids = self.version.solids.clone();
        let here = self.state.episode.world_from_rig();
        let here_m = here.position_m;
        // What the ego would meet in the next two seconds: a step that reads a section waits for
        // the disk.
        let velocity_mps = self.state.episode.ego().velocity_m_s();
        let onwards = [1.0, 2.0].map(|s| Pose { position_m: here_m + s * velocity_mps, ..here });
        self.prefetch_task.submit(move |is_wanted| {
            // Poses of both lists, before `places` becomes viewpoints.
            let is_near = |pose: &&Pose| pose.position_m.distance(here_m) < limits::SOLIDS_AHEAD_M;
            let near: Vec<Pose> = places
                .iter()
                .map(|(_, pose)| pose)
                .chain(&onwards)
                .filter(is_near)
                .copied()
                .collect();
            let places: Vec<_> = places
                .into_iter()
                .map(|(urgency, pose)| (urgency, layout.viewpoints(pose)))
                .collect();
            prefetcher.prefetch(&places, &profile);
            if let Some(solids) = solids {
                for pose in near {
                    // A fault of the store is an error of the step that needs it.
                    let _unread = solids.read_around(&pose, is_wanted);
                }
            }
        });
    }
}
