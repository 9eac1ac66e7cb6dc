//! Replay: drives and renders a recorded episode again, and compares every pose and image with the
//! record.

use std::sync::Arc;

use wildcity_episode::ground_surface;
use wildcity_render::{Backend, Frame, RenderError, Target, View};
use wildcity_repair::Models;
use wildcity_scene::RenderProfile;
use wildcity_scene::rig::{RigCamera, RigLidar};
use wildcity_sim::Ground;
use wildcity_sim::map::LaneSurface;
use wildcity_twin::residency::{Cache, Resident};
use wildcity_twin::store::Catalog;

use super::actor_replay::ActorReplay;
use super::ego_replay::EgoReplay;
use super::format::{
    BUILD, FrameRecord, FrameRequest, RecordedSettings, RecordedVersion, profile_hash,
};
use super::recorded_episode::RecordedEpisode;
use super::repair_replay::{Drawing, ImageToRepair, RepairReplay};
use super::repairs::RecordedImageRepair;
use super::replay_report::{
    ImageDifference, ProvenanceChange, RepairedImages, ReplayError, ReplayReport, ReplayUntil,
    Replayed, ReplayedImage, ReplayedSweep, Sensor, WrongValue,
};
use super::sensor_replay::SensorReplay;
use super::values;
use crate::observe::point_cloud::{PointCloud, lidar_view};
use crate::repair::rendered_image::RenderedImage;
use crate::scenario::assets::FrameDetail;
use crate::viewpoint::{lidar_viewpoint, viewpoints};

/// The caller's function for each image and sweep, which runs before these are compared with the
/// record.
type Visit<'a> = dyn FnMut(&Replayed<'_>) -> Result<(), String> + 'a;

impl RecordedEpisode {
    /// Drives and renders the episode again, on the recorded versions of its twin.
    ///
    /// # Errors
    /// A version cannot be opened, a command cannot be executed, the backend refuses a frame, or
    /// `visit` fails.
    pub fn replay(
        &self,
        cache: &Cache,
        backend: &dyn Backend,
        until: ReplayUntil,
        visit: &mut Visit<'_>,
    ) -> Result<ReplayReport, ReplayError> {
        self.replay_repaired(cache, backend, &Models::default(), until, visit)
    }

    /// As [`Self::replay`], and repairs images again by the recorded model, if it is one of
    /// `models`.
    ///
    /// # Errors
    /// As [`Self::replay`], and if the model cannot be loaded or fails.
    pub fn replay_repaired(
        &self,
        cache: &Cache,
        backend: &dyn Backend,
        models: &Models,
        until: ReplayUntil,
        visit: &mut Visit<'_>,
    ) -> Result<ReplayReport, ReplayError> {
        let open = |version: u64| cache.open(&self.header.twin, Some(version));
        let actors = ActorReplay::new(self, cache)?;
        let repairs = (models, cache.catalog());
        let mut replay = Replay::new(self, open(self.header.version)?, actors, backend, repairs)?;
        let mut switches = self.versions.iter().peekable();
        for (index, frame) in self.frames.iter().enumerate() {
            // Several switches may come before one frame. Each is made, because its changes are
            // reported.
            while let Some((_, to)) = switches.next_if(|(frames_before, _)| *frames_before <= index)
            {
                replay.switch_version(open(to.version)?, to)?;
            }
            replay.actors.advance(index);
            replay.drive(frame, index)?;
            // Images from another pose would differ too; the pose is the explanation.
            if until == ReplayUntil::FirstDifference && replay.report.diverged.is_some() {
                return Ok(replay.report);
            }
            replay.check_values(frame, index);
            replay.render(frame, index, until, visit)?;
            replay.check_sweeps(frame, index, visit)?;
            if until == ReplayUntil::FirstDifference && replay.report.difference.is_some() {
                return Ok(replay.report);
            }
        }
        if let Some(end) = &self.end {
            let mut episode = replay.ego.episode().clone();
            // A replay does not compute the trust of all images, so that the record says it.
            if self.off_model_step.is_some() {
                episode.leave_model();
            }
            let wrong = values::wrong_in_end(end, &episode, self.end_line);
            // The first wrong value stays, because it may be the cause of the others.
            replay.report.wrong_value = replay.report.wrong_value.or(wrong);
        }
        Ok(replay.report)
    }
}

/// The state of a replay.
struct Replay<'a> {
    cameras: &'a [RigCamera],
    lidars: &'a [RigLidar],
    settings: Option<&'a RecordedSettings>,
    /// Whether observations had classes.
    has_classes: bool,
    backend: &'a dyn Backend,
    resident: Arc<Resident>,
    profile: &'a RenderProfile,
    ego: EgoReplay,
    /// The road of the scenario's map, if it has one.
    lanes: Option<LaneSurface>,
    actors: ActorReplay<'a>,
    /// Lines of the file, from 1, at which the frames are.
    frame_lines: &'a [usize],
    /// Set if images were repaired.
    repair: Option<RepairReplay<'a>>,
    /// Set if sensors have effects.
    sensors: Option<SensorReplay>,
    /// The buffers of each camera.
    images: Vec<RenderedImage>,
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
        repairs: (&'a Models, &'a Catalog),
    ) -> Result<Self, ReplayError> {
        let header = &episode.header;
        let mut changes = Vec::new();
        add_change(&mut changes, "build", &header.build, BUILD);
        add_change(&mut changes, "backend", &header.backend, backend.name());
        add_change(&mut changes, "backend detail", &header.backend_detail, &backend.detail());
        let recorded =
            RecordedHashes { version: &header.version_hash, profile: &header.profile_hash };
        add_scene_changes(&mut changes, &recorded, &resident, &header.profile);

        let repair = RepairReplay::new(header, &resident, repairs, &mut changes)?;
        let cameras = &header.rig.cameras;
        // With repair, the buffers have what decisions and the model need besides.
        let buffers = |camera: &RigCamera| match &repair {
            Some(repair) => repair.buffers(camera),
            None => RenderedImage {
                rgb8: vec![0; 3 * camera.camera.pixels()],
                ..RenderedImage::default()
            },
        };
        let images = cameras.iter().map(buffers).collect();
        Ok(Self {
            cameras,
            lidars: &header.rig.lidars,
            settings: header.settings.as_ref(),
            has_classes: header.outputs.semantics,
            backend,
            resident,
            profile: &header.profile,
            ego: EgoReplay::new(header),
            lanes: episode.scenario.as_ref().and_then(|line| ground_surface(line)),
            actors,
            frame_lines: &episode.frame_lines,
            repair,
            sensors: SensorReplay::new(header)?,
            images,
            report: ReplayReport {
                images: 0,
                sweeps: 0,
                changes,
                diverged: None,
                difference: None,
                wrong_value: None,
                repaired: RepairedImages::default(),
            },
        })
    }

    fn switch_version(
        &mut self,
        resident: Arc<Resident>,
        to: &'a RecordedVersion,
    ) -> Result<(), ReplayError> {
        if let Some(repair) = &mut self.repair {
            repair.switch_version(&resident, self.cameras)?;
        }
        self.resident = resident;
        self.profile = &to.profile;
        let recorded = RecordedHashes { version: &to.version_hash, profile: &to.profile_hash };
        let changes = &mut self.report.changes;
        add_scene_changes(changes, &recorded, &self.resident, self.profile);
        Ok(())
    }

    /// If a frame is a step, executes it.
    fn drive(&mut self, frame: &FrameRecord, index: usize) -> Result<(), ReplayError> {
        let ground = Ground::from_drives(&self.resident.version.manifest.trajectories)
            .and_lanes(self.lanes.as_ref());
        let diverged = self
            .ego
            .drive(frame, self.frame_lines[index], &ground)
            .map_err(|cause| ReplayError::Ego { step: frame.step, cause: Box::new(cause) })?;
        // Later poses differ because of the first.
        if self.report.diverged.is_none() {
            self.report.diverged = diverged;
        }
        Ok(())
    }

    /// Compares the values of a frame other than poses and images.
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
        visit: &mut Visit<'_>,
    ) -> Result<(), ReplayError> {
        let mut next_image = 0;
        for pose in 0..frame.poses.len() {
            let selected = frame.due_cameras(pose, self.cameras.len());
            // At the time between two frames of all cameras, nothing is due at the last pose.
            if selected.is_empty() {
                continue;
            }
            let views = self.render_pose(frame, pose, &selected)?;
            // The selection depends on the trusts of all images of the pose, so that it follows
            // their rendering.
            self.check_decision(frame, index, &selected, &views, [pose, next_image]);
            self.check_delivery(frame, index, &selected, pose);
            for (view, &camera) in views.iter().zip(&selected) {
                let recorded = &frame.images[next_image];
                let repair = frame.repairs.get(next_image).and_then(Option::as_ref);
                next_image += 1;
                let mounted = &self.cameras[camera];
                let rendered = &self.images[camera];

                // The rendered pixels, and those that the model makes of them.
                // A repaired image has two hashes: as sent, in `images`, and as rendered, in
                // `repairs`.
                let recorded_rendered = match repair {
                    Some(RecordedImageRepair::Repaired(rendered)) => rendered,
                    Some(RecordedImageRepair::Failed(_)) | None => recorded,
                };
                let is_repaired = matches!(repair, Some(RecordedImageRepair::Repaired(_)));
                // Effects come after the repair. The hash of a repaired image before it is
                // therefore one without effects, and that of any other image one with them.
                let mut sensed = None;
                if let (Some(sensors), false) = (&self.sensors, is_repaired) {
                    let pixels = sensed.insert(rendered.rgb8.clone());
                    sensors.apply(frame, pose, camera, pixels);
                }
                let rendered_pixels = sensed.as_deref().unwrap_or(&rendered.rgb8);
                let mut pairs = vec![(recorded_rendered, hash_pixels(rendered_pixels))];
                let mut repaired = None;
                if let (true, Some(repair)) = (is_repaired, &mut self.repair) {
                    let image = ImageToRepair {
                        camera,
                        mounted,
                        rendered,
                        view,
                        world_from_rig: &frame.poses[pose],
                        is_observe: frame.request == FrameRequest::Observe,
                    };
                    let drawing = Drawing {
                        resident: &self.resident,
                        profile: self.profile,
                        backend: self.backend,
                    };
                    repaired = repair.repaired(&image, drawing).map_err(|cause| {
                        let camera = mounted.name.clone();
                        ReplayError::Repair { step: frame.step, camera, cause: Box::new(cause) }
                    })?;
                    // Without the recorded model, the repaired pixels are not known: the caller
                    // sees the rendered ones.
                    match &mut repaired {
                        Some(pixels) => {
                            if let Some(sensors) = &self.sensors {
                                sensors.apply(frame, pose, camera, pixels);
                            }
                            self.report.repaired.compared += 1;
                            pairs.push((recorded, hash_pixels(pixels)));
                        }
                        None => self.report.repaired.not_compared += 1,
                    }
                }
                let image = ReplayedImage {
                    frame: index,
                    request: frame.request,
                    step: frame.step,
                    pose,
                    camera: mounted,
                    // What was sent, as far as it can be computed again.
                    rgb8: repaired.as_deref().unwrap_or(rendered_pixels),
                };
                visit(&Replayed::Image(image)).map_err(|reason| {
                    let sensor = Sensor::Camera(image.camera.name.clone());
                    ReplayError::Visit { step: frame.step, sensor, reason }
                })?;
                self.report.images += 1;
                // The first of a pair that differs: with other rendered pixels, other repaired ones
                // explain nothing.
                let different = pairs.into_iter().find(|(recorded, now)| *recorded != now);
                if let (Some((recorded, now)), None) = (different, &self.report.difference) {
                    self.report.difference = Some(ImageDifference {
                        line: self.frame_lines[index],
                        request: frame.request,
                        step: frame.step,
                        pose,
                        sensor: Sensor::Camera(image.camera.name.clone()),
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

    /// Casts the sweeps of a frame again, shows each to `visit` and compares its points.
    fn check_sweeps(
        &mut self,
        frame: &FrameRecord,
        index: usize,
        visit: &mut Visit<'_>,
    ) -> Result<(), ReplayError> {
        let step = frame.step;
        // As for a session: none of poses that the ego is not at, and none between two decisions.
        let schedule = self.settings.map(|settings| &settings.schedule);
        let is_decision = schedule.is_none_or(|schedule| schedule.is_decision(frame.time_us));
        let is_shown = frame.request != FrameRequest::Observe && is_decision;
        let expected = if is_shown { self.lidars.len() } else { 0 };
        // `zip` below compares only as many sweeps as both have.
        if frame.sweeps.len() != expected && self.report.wrong_value.is_none() {
            self.report.wrong_value = Some(WrongValue {
                line: self.frame_lines[index],
                field: "sweeps",
                recorded: frame.sweeps.len().to_string(),
                now: expected.to_string(),
            });
        }
        for ((lidar, mounted), recorded) in self.lidars.iter().enumerate().zip(&frame.sweeps) {
            let view = lidar_view(mounted, self.ego.episode());
            let viewpoints = [lidar_viewpoint(&view)];
            let residency = |cause| ReplayError::Residency { step, cause };
            let mut scene = self.resident.scene(&viewpoints, self.profile).map_err(residency)?;
            let exposures_us = &[mounted.lidar.duration_us()];
            let detail =
                FrameDetail { viewpoints: &viewpoints, exposures_us, profile: self.profile };
            scene.place(self.actors.placed(frame.time_us, detail));
            let cast = || {
                let sweep = self.backend.sweep(&scene, self.profile, &view)?;
                let classes = self.has_classes.then(|| sweep.classes(&scene)).transpose()?;
                Ok((sweep, classes))
            };
            let (sweep, classes) = cast().map_err(|cause| ReplayError::Render { step, cause })?;
            let effects = self.sensors.as_ref().and_then(|sensors| sensors.lidar_effects(lidar));
            let cloud = PointCloud::new(
                lidar,
                mounted,
                (&sweep, classes.as_deref()),
                frame.time_us,
                effects,
            );
            let time_us = frame.time_us;
            let replayed = ReplayedSweep { lidar, time_us, mounted, view: &view, cloud: &cloud };
            visit(&Replayed::Sweep(replayed)).map_err(|reason| {
                let sensor = Sensor::Lidar(mounted.name.clone());
                ReplayError::Visit { step, sensor, reason }
            })?;
            self.report.sweeps += 1;
            let now = cloud.hash.to_hex().to_string();
            if now != *recorded && self.report.difference.is_none() {
                self.report.difference = Some(ImageDifference {
                    line: self.frame_lines[index],
                    request: frame.request,
                    step,
                    pose: 0,
                    sensor: Sensor::Lidar(mounted.name.clone()),
                    recorded: recorded.clone(),
                    now,
                });
            }
        }
        Ok(())
    }

    /// Decides which images of a pose are repaired, and compares that with the record. `at` has the
    /// index of the pose, and that of its first image.
    fn check_decision(
        &mut self,
        frame: &FrameRecord,
        index: usize,
        selected: &[usize],
        views: &[View],
        [pose, first_image]: [usize; 2],
    ) {
        let Some(repair) = &mut self.repair else { return };
        let is_observe = frame.request == FrameRequest::Observe;
        let world_from_rig = &frame.poses[pose];
        let chosen = repair.decide(is_observe, world_from_rig, selected, views, &mut self.images);
        // Images of the pose are in the order of its cameras.
        for (view, is_chosen) in chosen.into_iter().enumerate() {
            let recorded = frame.repairs.get(first_image + view).is_some_and(Option::is_some);
            if recorded != is_chosen && self.report.wrong_value.is_none() {
                let camera = &self.cameras[selected[view]].name;
                let text = |is_chosen| {
                    format!("{camera} {}", if is_chosen { "selected" } else { "not selected" })
                };
                self.report.wrong_value = Some(WrongValue {
                    line: self.frame_lines[index],
                    field: "repairs",
                    recorded: text(recorded),
                    now: text(is_chosen),
                });
            }
        }
    }

    /// Decides which picture each camera of a pose shows, and compares that with the record.
    fn check_delivery(
        &mut self,
        frame: &FrameRecord,
        index: usize,
        selected: &[usize],
        pose: usize,
    ) {
        let Some(sensors) = &self.sensors else { return };
        let wrong = sensors.wrong_delivery(frame, pose, selected, self.ego.episode());
        if let (Some([recorded, now]), None) = (wrong, &self.report.wrong_value) {
            let line = self.frame_lines[index];
            self.report.wrong_value = Some(WrongValue { line, field: "sensors", recorded, now });
        }
    }

    /// Renders the selected cameras (indices, rising) at a pose of a frame into `images`. Returns
    /// their views.
    fn render_pose(
        &mut self,
        frame: &FrameRecord,
        pose: usize,
        selected: &[usize],
    ) -> Result<Vec<View>, ReplayError> {
        let step = frame.step;
        let taken_us = frame.taken_us(pose);
        let episode = self.ego.episode();
        let views = episode.views(self.cameras, selected, frame.poses[pose], taken_us);
        let viewpoints = viewpoints(&views);
        let mut scene = self
            .resident
            .scene(&viewpoints, self.profile)
            .map_err(|cause| ReplayError::Residency { step, cause })?;
        let exposure_us = |&camera: &usize| View::exposure_us(&self.cameras[camera]);
        let exposures_us: Vec<i64> = selected.iter().map(exposure_us).collect();
        let detail = FrameDetail {
            viewpoints: &viewpoints,
            exposures_us: &exposures_us,
            profile: self.profile,
        };
        scene.place(self.actors.placed(taken_us, detail));

        // `selected` rises, so that the targets are in the order of the views.
        let all = self.images.iter_mut().zip(self.cameras).enumerate();
        let mut targets: Vec<Target<'_>> = all
            .filter(|(camera, _)| selected.contains(camera))
            .map(|(_, (image, camera))| Target {
                rgb8: Some(&mut image.rgb8),
                depth_m: used(&mut image.depth_m),
                opacity: used(&mut image.opacity),
                normals: used(&mut image.normals),
                appearance: Some(&camera.appearance),
                ..Target::default()
            })
            .collect();
        let to_render = Frame { scene: &scene, profile: self.profile, views: &views };
        let rendered: Result<_, RenderError> =
            self.backend.render(&to_render, &mut targets, &|_, _| {});
        rendered.map_err(|cause| ReplayError::Render { step, cause })?;
        drop(targets);
        Ok(views)
    }
}

fn hash_pixels(rgb8: &[u8]) -> String {
    blake3::hash(rgb8).to_hex().to_string()
}

/// A buffer that is not empty.
fn used(map: &mut [f32]) -> Option<&mut [f32]> {
    (!map.is_empty()).then_some(map)
}

/// Adds the changes of a version since it was recorded. The profile's hash changes with a build
/// that has more fields, even for the same profile.
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
