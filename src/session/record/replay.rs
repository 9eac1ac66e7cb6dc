//! Replay: drives and renders a recorded episode again, and compares every pose and image with the record.

use std::sync::Arc;

use wildcity_render::{Backend, Frame, RenderError, Target};
use wildcity_scene::RenderProfile;
use wildcity_scene::rig::RigCamera;
use wildcity_sim::Ground;
use wildcity_twin::residency::{Cache, Resident};

use super::actor_replay::ActorReplay;
use super::ego_replay::EgoReplay;
use super::format::{BUILD, FrameRecord, RecordedVersion, profile_hash};
use super::recorded_episode::RecordedEpisode;
use super::replay_report::{
    ImageDifference, ProvenanceChange, ReplayError, ReplayReport, ReplayUntil, ReplayedImage,
};
use super::values;
use crate::scenario::assets::FrameDetail;
use crate::viewpoint::viewpoints;

/// What the caller does with each image, before it is compared with the record.
type VisitImage<'a> = dyn FnMut(&ReplayedImage<'_>) -> Result<(), String> + 'a;

impl RecordedEpisode {
    /// Drives and renders the episode again, on the recorded versions of its twin.
    ///
    /// # Errors
    /// A version cannot be opened, a command cannot be executed, the backend refuses a frame, or `visit`
    /// fails.
    pub fn replay(
        &self,
        cache: &Cache,
        backend: &dyn Backend,
        until: ReplayUntil,
        visit: &mut VisitImage<'_>,
    ) -> Result<ReplayReport, ReplayError> {
        let open = |version: u64| cache.open(&self.header.twin, Some(version));
        let actors = ActorReplay::new(self, cache)?;
        let mut replay = Replay::new(self, open(self.header.version)?, actors, backend);
        let mut switches = self.versions.iter().peekable();
        for (index, frame) in self.frames.iter().enumerate() {
            while let Some((_, to)) = switches.next_if(|(frames_before, _)| *frames_before <= index)
            {
                replay.switch_version(open(to.version)?, to);
            }
            replay.actors.advance(index);
            replay.drive(frame, index)?;
            if until == ReplayUntil::FirstDifference && replay.report.diverged.is_some() {
                return Ok(replay.report);
            }
            replay.check_values(frame, index);
            replay.render(frame, index, until, visit)?;
            if until == ReplayUntil::FirstDifference && replay.report.difference.is_some() {
                return Ok(replay.report);
            }
        }
        if let Some(end) = &self.end {
            let wrong = values::wrong_in_end(end, replay.ego.episode(), self.end_line);
            replay.report.wrong_value = replay.report.wrong_value.or(wrong);
        }
        Ok(replay.report)
    }
}

/// The state of a replay.
struct Replay<'a> {
    cameras: &'a [RigCamera],
    backend: &'a dyn Backend,
    resident: Arc<Resident>,
    profile: &'a RenderProfile,
    ego: EgoReplay,
    actors: ActorReplay<'a>,
    /// Lines of the file, from 1, at which the frames are.
    frame_lines: &'a [usize],
    /// The RGB buffer of each camera.
    pixels: Vec<Vec<u8>>,
    report: ReplayReport,
}

/// Hashes of what a frame was rendered from, in hex.
struct RecordedHashes<'a> {
    version: &'a str,
    profile: &'a str,
}

impl<'a> Replay<'a> {
    fn new(
        episode: &'a RecordedEpisode,
        resident: Arc<Resident>,
        actors: ActorReplay<'a>,
        backend: &'a dyn Backend,
    ) -> Self {
        let header = &episode.header;
        let mut changes = Vec::new();
        add_change(&mut changes, "build", &header.build, BUILD);
        add_change(&mut changes, "backend", &header.backend, backend.name());
        add_change(&mut changes, "backend detail", &header.backend_detail, &backend.detail());
        let recorded =
            RecordedHashes { version: &header.version_hash, profile: &header.profile_hash };
        add_scene_changes(&mut changes, &recorded, &resident, &header.profile);

        let cameras = &header.rig.cameras;
        Self {
            cameras,
            backend,
            resident,
            profile: &header.profile,
            ego: EgoReplay::new(header),
            actors,
            frame_lines: &episode.frame_lines,
            pixels: cameras.iter().map(|camera| vec![0; 3 * camera.camera.pixels()]).collect(),
            report: ReplayReport {
                images: 0,
                changes,
                diverged: None,
                difference: None,
                wrong_value: None,
            },
        }
    }

    fn switch_version(&mut self, resident: Arc<Resident>, to: &'a RecordedVersion) {
        self.resident = resident;
        self.profile = &to.profile;
        let recorded = RecordedHashes { version: &to.version_hash, profile: &to.profile_hash };
        let changes = &mut self.report.changes;
        add_scene_changes(changes, &recorded, &self.resident, self.profile);
    }

    /// Drives the step of a frame, if it is one.
    fn drive(&mut self, frame: &FrameRecord, index: usize) -> Result<(), ReplayError> {
        let ground = Ground::from_drives(&self.resident.version.manifest.trajectories);
        let diverged = self
            .ego
            .drive(frame, self.frame_lines[index], &ground)
            .map_err(|cause| ReplayError::Ego { step: frame.step, cause: Box::new(cause) })?;
        if self.report.diverged.is_none() {
            self.report.diverged = diverged;
        }
        Ok(())
    }

    /// Compares what a frame says beside poses and images.
    fn check_values(&mut self, frame: &FrameRecord, index: usize) {
        let line = self.frame_lines[index];
        let wrong = values::wrong_in_frame(frame, self.ego.episode(), self.cameras.len(), line);
        if self.report.wrong_value.is_none() {
            self.report.wrong_value = wrong;
        }
    }

    /// Renders the poses of a frame, shows each image to `visit` and compares it.
    fn render(
        &mut self,
        frame: &FrameRecord,
        index: usize,
        until: ReplayUntil,
        visit: &mut VisitImage<'_>,
    ) -> Result<(), ReplayError> {
        let mut recorded_hashes = frame.images.iter();
        for pose in 0..frame.poses.len() {
            let selected = frame.cameras_of(pose, self.cameras.len());
            if selected.is_empty() {
                continue;
            }
            self.render_pose(frame, pose, &selected)?;
            for (&camera, recorded) in selected.iter().zip(&mut recorded_hashes) {
                let image = ReplayedImage {
                    frame: index,
                    request: frame.request,
                    step: frame.step,
                    pose,
                    camera: &self.cameras[camera],
                    rgb8: &self.pixels[camera],
                };
                visit(&image).map_err(|reason| {
                    let camera = image.camera.name.clone();
                    ReplayError::Visit { step: frame.step, camera, reason }
                })?;
                self.report.images += 1;
                let now = blake3::hash(image.rgb8).to_hex().to_string();
                if now != *recorded && self.report.difference.is_none() {
                    self.report.difference = Some(ImageDifference {
                        line: self.frame_lines[index],
                        request: frame.request,
                        step: frame.step,
                        pose,
                        camera: image.camera.name.clone(),
                        recorded: recorded.clone(),
                        now,
                    });
                    if until == ReplayUntil::FirstDifference {
                        return Ok(());
                    }
                }
            }
        }
        Ok(())
    }

    /// Renders the colour of the selected cameras (indices, rising) at a pose of a frame into `pixels`.
    fn render_pose(
        &mut self,
        frame: &FrameRecord,
        pose: usize,
        selected: &[usize],
    ) -> Result<(), ReplayError> {
        let step = frame.step;
        let taken_us = frame.taken_us(pose);
        let views = self.ego.episode().views(self.cameras, selected, frame.poses[pose], taken_us);
        let viewpoints = viewpoints(&views);
        let mut scene = self
            .resident
            .scene(&viewpoints, self.profile)
            .map_err(|cause| ReplayError::Residency { step, cause })?;
        let detail = FrameDetail { viewpoints: &viewpoints, profile: self.profile };
        scene.place(self.actors.placed(taken_us, detail));

        let all = self.pixels.iter_mut().zip(self.cameras).enumerate();
        let mut targets: Vec<Target<'_>> = all
            .filter(|(camera, _)| selected.contains(camera))
            .map(|(_, (rgb8, camera))| Target {
                rgb8: Some(rgb8),
                appearance: Some(&camera.appearance),
                ..Target::default()
            })
            .collect();
        let to_render = Frame { scene: &scene, profile: self.profile, views: &views };
        let rendered: Result<_, RenderError> =
            self.backend.render(&to_render, &mut targets, &|_, _| {});
        rendered.map(|_| ()).map_err(|cause| ReplayError::Render { step, cause })
    }
}

/// Adds the changes of a version since it was recorded. The profile's hash changes with a build that knows
/// more fields, even for the same profile.
fn add_scene_changes(
    changes: &mut Vec<ProvenanceChange>,
    recorded: &RecordedHashes<'_>,
    resident: &Resident,
    profile: &RenderProfile,
) {
    add_change(changes, "version hash", recorded.version, &resident.version.hash);
    add_change(changes, "profile hash", recorded.profile, &profile_hash(profile).to_hex());
}

fn add_change(changes: &mut Vec<ProvenanceChange>, what: &'static str, recorded: &str, now: &str) {
    if recorded != now {
        let recorded = recorded.to_owned();
        changes.push(ProvenanceChange { what, recorded, now: now.to_owned() });
    }
}
