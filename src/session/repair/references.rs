//! Chooses the recorded images that a repair model compares a view with.
//!
//! They are chosen by the rig's station on the nearest drive. For a warp these are the images at
//! five places from 8 m behind the rig to 2 m ahead, of all cameras whose images overlap with the
//! view. Most of the places are behind the rig, because the scene ahead of the rig was seen from
//! there. For the role `reference` it is the nearest image of the same camera that looks in about
//! the same direction.
//!
//! Recorded images of a twin may be at any stations. If a twin has none, the twin itself is
//! rendered every [`STEP_M`] along its drive, with the session's cameras. These images contain
//! nothing new, but the twin is accurate on its drive, and inaccurate off the trajectory.

use std::sync::Arc;

use glam::DVec3;
use parking_lot::Mutex;

use wildcity_render::View;
use wildcity_repair::reference::{Projection, ReferenceKey};
use wildcity_scene::appearance::Appearance;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::rig::RigCamera;
use wildcity_scene::views::RecordedView;
use wildcity_twin::store::Version;

/// Places along the drive, from the rig's, in metres.
const OFFSETS_M: [f64; 5] = [-8.0, -5.5, -3.0, -0.5, 2.0];

/// Largest distance between an image and a place along the drive for the image to be used there, in
/// metres.
const MAX_STATION_DIFFERENCE_M: f64 = 1.5;

/// Distance between the places where a twin without recorded images is drawn, in metres.
const STEP_M: f64 = 2.0;

/// Largest distance of a `reference` along the drive, in metres.
const REFERENCE_WITHIN_M: f64 = 30.0;

/// Largest angle between the axes of a camera and of its `reference`: 30°.
const REFERENCE_RAD: f64 = std::f64::consts::PI / 6.0;

/// The `reference` changes only if another image is nearer by at least this distance, in metres,
/// because each change is visible as flicker.
const SWITCH_HYSTERESIS_M: f64 = 0.5;

/// A recorded image counts as held out if its position is within this distance of a held-out pose,
/// in metres, and its optical axis within [`HELD_OUT_AXIS_RAD`].
const HELD_OUT_POSITION_M: f64 = 0.05;

/// Largest angle between the optical axes of a recorded image and of a held-out pose, in radians.
const HELD_OUT_AXIS_RAD: f64 = 0.02;

/// Largest number of projection tables that a version keeps, 2 MB each. A rig has a few cameras.
const PROJECTIONS: usize = 64;

/// Images that a repair model compares with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReferenceSource {
    /// Recorded images of the twin.
    Recorded,
    /// Images of the twin itself, rendered on its recorded drive, because it has no recorded
    /// images.
    Rendered,
}

/// A reference of a view, before it is read or rendered.
#[derive(Clone, Debug)]
pub(crate) struct ReferenceView {
    /// The drive, the station in metres, and the camera: `log@12.50/front`.
    pub(crate) name: String,
    pub(crate) camera: Camera,
    /// Appearance of a rendered image; without overlay.
    pub(crate) appearance: Appearance,
    pub(crate) world_from_camera: Pose,
    /// The recorded image; `None` if the image is rendered.
    pub(crate) recorded: Option<Arc<RecordedView>>,
    station_m: f64,
}

/// The references of a version of a twin.
#[derive(Debug)]
pub(crate) struct ReferenceViews {
    version: Arc<Version>,
    drives: Vec<Drive>,
    /// The cameras that the twin is rendered with if it has no recorded images.
    cameras: Vec<RigCamera>,
    source: ReferenceSource,
    /// Projection tables, each of which takes some milliseconds to compute.
    projections: Mutex<Vec<(Camera, Arc<Projection>)>>,
}

/// A drive with its recorded images.
#[derive(Debug)]
struct Drive {
    /// Index among the trajectories of the version.
    index: usize,
    length_m: f64,
    /// Name and images of each camera, in the order of the table; the images by station.
    cameras: Vec<(String, Vec<Arc<RecordedView>>)>,
}

/// A station on a drive.
struct DriveStation<'a> {
    drive: &'a Drive,
    station_m: f64,
}

impl ReferenceView {
    /// Hash of all values on which its [`Reference`](wildcity_repair::reference::Reference)
    /// depends.
    pub(crate) fn key(&self, version_hash: &str, profile_hash: &blake3::Hash) -> ReferenceKey {
        let mut hasher = blake3::Hasher::new();
        hasher.update(version_hash.as_bytes()).update(profile_hash.as_bytes());
        let image = self.recorded.as_ref().map(|view| &view.image.object);
        let Self { name, camera, world_from_camera, .. } = self;
        let exposure = &self.appearance.exposure;
        let stops = self.recorded.as_ref().and_then(|view| view.exposure_stops);
        let mask = self.recorded.as_ref().and_then(|view| view.mask.as_ref());
        // Debug writes all digits of a float, so that values which differ have texts which differ.
        let text = format!(
            "{name} {camera:?} {world_from_camera:?} {image:?} {exposure:?} {stops:?} {mask:?}"
        );
        *hasher.update(text.as_bytes()).finalize().as_bytes()
    }

    /// Returns this image with the exposure of a camera, if its own exposure is known.
    pub(crate) fn exposed_for(mut self, camera: &RigCamera) -> Self {
        // From an unknown exposure the picture cannot be brought to another one.
        if self.recorded.as_ref().is_some_and(|view| view.exposure_stops.is_some()) {
            self.appearance.exposure = camera.appearance.exposure;
        }
        self
    }

    /// Returns this image for a view of a camera: halved until it has about as many pixels per
    /// radian as the view. From an image with more, a view would sample only some pixels, and the
    /// next view different ones. A smaller image also takes less time and memory.
    pub(crate) fn reduced_for(mut self, camera: &Camera) -> Self {
        // Pixels per radian near the axis, by the mean of both focal lengths.
        let px_per_rad = |camera: &Camera| (camera.pinhole.fx * camera.pinhole.fy).sqrt();
        let ratio = px_per_rad(&self.camera) / px_per_rad(camera);
        // The nearest power of two: the remaining ratio is between 0.7 and 1.4.
        // Never enlarged, and at most by 2⁸.
        let halvings = ratio.log2().round().clamp(0.0, 8.0) as i32;
        if halvings == 0 {
            return self;
        }
        let factor = 2.0_f64.powi(halvings);
        let side = |px: u32| ((f64::from(px) / factor).round() as u64).max(1);
        let [width_px, height_px] = [self.camera.width_px, self.camera.height_px].map(side);
        // A camera that cannot be smaller stays as it is.
        self.camera = self.camera.scaled(width_px, height_px).unwrap_or(self.camera);
        self
    }

    /// Its name, size and exposure, which identify it among the references of a version.
    pub(crate) fn id(&self) -> String {
        let Self { name, camera, appearance, .. } = self;
        format!("{name} {}x{} {:?}", camera.width_px, camera.height_px, appearance.exposure)
    }

    /// The view that it is rendered with.
    pub(crate) fn view(&self) -> View {
        View::new(self.camera, self.world_from_camera)
    }

    /// Angle between its axis and that of another camera, in radians.
    fn angle_rad(&self, world_from_camera: &Pose) -> f64 {
        let axis = |pose: &Pose| pose.rotation * DVec3::Z;
        axis(&self.world_from_camera).angle_between(axis(world_from_camera))
    }
}

impl ReferenceViews {
    /// The references of a version. `table` has the recorded images; if it is empty, the twin is
    /// rendered with `cameras`. `None` without a recorded drive.
    pub(crate) fn new(
        version: Arc<Version>,
        table: Vec<RecordedView>,
        cameras: &[RigCamera],
    ) -> Option<Self> {
        let source =
            if table.is_empty() { ReferenceSource::Rendered } else { ReferenceSource::Recorded };
        // A reference shows the scene at an instant: no part of the car, and no rolling shutter.
        let drawn_with = |camera: &RigCamera| {
            let exposure = camera.appearance.exposure;
            let appearance = Appearance { exposure, overlay: None };
            RigCamera { appearance, shutter: None, ..camera.clone() }
        };
        let trajectories = &version.manifest.trajectories;
        let mut drives: Vec<Drive> = Vec::with_capacity(trajectories.len());
        for (index, trajectory) in trajectories.iter().enumerate() {
            let length_m = trajectory.length_m();
            drives.push(Drive { index, length_m, cameras: Vec::new() });
        }
        for view in table {
            let of = trajectories.iter().position(|drive| drive.name == view.trajectory);
            // Images along a drive that the version does not have cannot be placed.
            let Some(drive) = of.and_then(|index| drives.get_mut(index)) else { continue };
            let known = drive.cameras.iter().position(|(name, _)| *name == view.camera_name);
            let at = known.unwrap_or_else(|| {
                drive.cameras.push((view.camera_name.clone(), Vec::new()));
                drive.cameras.len() - 1
            });
            drive.cameras[at].1.push(Arc::new(view));
        }
        // By station, so that the first of two at the same distance is the lower one.
        for (_, views) in drives.iter_mut().flat_map(|drive| &mut drive.cameras) {
            views.sort_by(|a, b| a.station_m.total_cmp(&b.station_m));
        }
        // A drive without images must not be the nearest one: nothing could be taken from it.
        if source == ReferenceSource::Recorded {
            drives.retain(|drive| !drive.cameras.is_empty());
        }
        let cameras = cameras.iter().map(drawn_with).collect();
        let projections = Mutex::default();
        (!drives.is_empty()).then_some(Self { version, drives, cameras, source, projections })
    }

    /// Where the images come from.
    pub(crate) fn source(&self) -> ReferenceSource {
        self.source
    }

    /// Whether there is an image of a camera.
    pub(crate) fn has_camera(&self, name: &str) -> bool {
        match self.source {
            ReferenceSource::Recorded => {
                self.drives.iter().flat_map(|drive| &drive.cameras).any(|(own, _)| own == name)
            }
            ReferenceSource::Rendered => self.cameras.iter().any(|camera| camera.name == name),
        }
    }

    /// The images to warp into a view of a rig, by place and camera.
    pub(crate) fn around(&self, world_from_rig: &Pose) -> Vec<ReferenceView> {
        let Some(place) = self.place(world_from_rig.position_m) else { return Vec::new() };
        let mut around: Vec<ReferenceView> = Vec::new();
        for offset_m in OFFSETS_M {
            let wanted_m = place.station_m + offset_m;
            let is_near = |view: &ReferenceView| {
                (view.station_m - wanted_m).abs() <= MAX_STATION_DIFFERENCE_M
            };
            for view in self.at(&place, wanted_m).into_iter().filter(is_near) {
                // Two places may share their nearest image.
                if around.iter().all(|other| other.name != view.name) {
                    around.push(view);
                }
            }
        }
        around
    }

    /// The image for the role `reference`: of the same camera, nearest along the drive among those
    /// that look in the same direction within 30°. The previous image, whose name is `kept`, stays
    /// until another is 0.5 m nearer.
    pub(crate) fn nearest(
        &self,
        camera: &RigCamera,
        world_from_camera: &Pose,
        world_from_rig: &Pose,
        kept: Option<&str>,
    ) -> Option<ReferenceView> {
        let place = self.place(world_from_rig.position_m)?;
        let distance_m = |view: &ReferenceView| (view.station_m - place.station_m).abs();
        let fits = |view: &ReferenceView| {
            distance_m(view) <= REFERENCE_WITHIN_M
                && view.angle_rad(world_from_camera) <= REFERENCE_RAD
        };
        let all: Vec<ReferenceView> =
            self.camera_views(&place, &camera.name).into_iter().filter(fits).collect();
        let nearest = all.iter().min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)))?;
        // The image of before is only kept while it fits.
        let kept = all
            .iter()
            .find(|view| Some(&*view.name) == kept)
            .filter(|kept| distance_m(kept) - distance_m(nearest) < SWITCH_HYSTERESIS_M);
        Some(kept.unwrap_or(nearest).clone().exposed_for(camera))
    }

    /// The projection of a camera.
    pub(crate) fn projection(&self, camera: &Camera) -> Arc<Projection> {
        let find = |all: &[(Camera, Arc<Projection>)]| {
            all.iter().find(|(own, _)| own == camera).map(|(_, projection)| projection.clone())
        };
        if let Some(known) = find(&self.projections.lock()) {
            return known;
        }
        // Without the lock, since it takes milliseconds. Two threads may add the same table, which
        // only takes memory.
        let projection = Arc::new(Projection::from_camera(camera));
        let mut all = self.projections.lock();
        // Beyond the limit a table is used once and not kept, so that the memory is bounded.
        if all.len() < PROJECTIONS {
            all.push((*camera, projection.clone()));
        }
        projection
    }

    /// The nearest drive to a point, and the point's station on it.
    fn place(&self, point_m: DVec3) -> Option<DriveStation<'_>> {
        let trajectories = &self.version.manifest.trajectories;
        let places =
            self.drives.iter().map(|drive| (trajectories[drive.index].nearest(point_m), drive));
        let nearest = places.min_by(|(a, _), (b, _)| a.distance_m.total_cmp(&b.distance_m));
        nearest.map(|(place, drive)| DriveStation { drive, station_m: place.station_m })
    }

    /// For each camera the image nearest to a station, in metres.
    fn at(&self, place: &DriveStation<'_>, station_m: f64) -> Vec<ReferenceView> {
        match self.source {
            ReferenceSource::Recorded => {
                let nearest = |(_, views): &(String, Vec<Arc<RecordedView>>)| {
                    let distance_m = |view: &&Arc<RecordedView>| (view.station_m - station_m).abs();
                    // The first of equals: the lower station.
                    let nearest =
                        views.iter().min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)));
                    nearest.map(recorded)
                };
                place.drive.cameras.iter().filter_map(nearest).collect()
            }
            ReferenceSource::Rendered => {
                let step = self.step(place.drive, station_m);
                let drawn = |camera| self.drawn(place.drive, step, camera);
                self.cameras.iter().map(drawn).collect()
            }
        }
    }

    /// The images of a camera around a station.
    fn camera_views(&self, place: &DriveStation<'_>, camera: &str) -> Vec<ReferenceView> {
        match self.source {
            ReferenceSource::Recorded => {
                let of = place.drive.cameras.iter().filter(|(name, _)| name == camera);
                of.flat_map(|(_, views)| views).map(recorded).collect()
            }
            ReferenceSource::Rendered => {
                // 15 steps in either direction.
                let around = (REFERENCE_WITHIN_M / STEP_M) as usize;
                let middle = self.step(place.drive, place.station_m);
                let of: Vec<&RigCamera> =
                    self.cameras.iter().filter(|own| own.name == camera).collect();
                // Infinity is clamped to the last step.
                let most = self.step(place.drive, f64::INFINITY);
                (middle.saturating_sub(around)..=(middle + around).min(most))
                    .flat_map(|step| of.iter().map(move |camera| (step, *camera)))
                    .map(|(step, camera)| self.drawn(place.drive, step, camera))
                    .collect()
            }
        }
    }

    /// The nearest step of a drive at which the twin is rendered; the lower one of two at the same
    /// distance.
    fn step(&self, drive: &Drive, station_m: f64) -> usize {
        // Whole steps within the length: the rest at the end has none.
        let last = (drive.length_m / STEP_M).floor();
        // x - 1/2 rounded up is the nearest integer, and the lower one of two.
        (station_m / STEP_M - 0.5).ceil().clamp(0.0, last) as usize
    }

    fn drawn(&self, drive: &Drive, step: usize, camera: &RigCamera) -> ReferenceView {
        let station_m = step as f64 * STEP_M;
        let trajectory = &self.version.manifest.trajectories[drive.index];
        let world_from_rig = trajectory.at_station(station_m);
        ReferenceView {
            name: name(&trajectory.name, station_m, &camera.name),
            camera: camera.camera,
            appearance: camera.appearance.clone(),
            world_from_camera: world_from_rig * camera.rig_from_camera,
            recorded: None,
            station_m,
        }
    }
}

/// A table of recorded images without those at some poses.
pub(crate) fn without(mut table: Vec<RecordedView>, held_out: &[Pose]) -> Vec<RecordedView> {
    table.retain(|view| !is_held_out(view, held_out));
    table
}

fn is_held_out(view: &RecordedView, held_out: &[Pose]) -> bool {
    let axis = |pose: &Pose| pose.rotation * DVec3::Z;
    let own = &view.world_from_camera;
    held_out.iter().any(|pose| {
        own.position_m.distance(pose.position_m) <= HELD_OUT_POSITION_M
            && axis(own).angle_between(axis(pose)) <= HELD_OUT_AXIS_RAD
    })
}

fn recorded(view: &Arc<RecordedView>) -> ReferenceView {
    ReferenceView {
        name: name(&view.trajectory, view.station_m, &view.camera_name),
        camera: view.camera,
        appearance: Appearance::default(),
        world_from_camera: view.world_from_camera,
        recorded: Some(view.clone()),
        station_m: view.station_m,
    }
}

fn name(trajectory: &str, station_m: f64, camera: &str) -> String {
    format!("{trajectory}@{station_m:.2}/{camera}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use wildcity_scene::appearance::Exposure;
    use wildcity_scene::geometry::camera::Pinhole;
    use wildcity_scene::manifest::ObjectRef;

    fn image(width_px: u32, focal_px: f64, exposure_stops: Option<f64>) -> RecordedView {
        let middle = 0.5 * f64::from(width_px);
        let pinhole = Pinhole { fx: focal_px, fy: focal_px, cx: middle, cy: middle };
        RecordedView {
            trajectory: "log".into(),
            station_m: 2.0,
            camera_name: "front".into(),
            camera: Camera::from_pinhole(width_px, width_px, pinhole),
            world_from_camera: Pose::IDENTITY,
            exposure_stops,
            image: ObjectRef { object: "0".repeat(64), bytes: 3 },
            mask: None,
        }
    }

    #[test]
    fn only_an_image_of_the_same_place_and_direction_is_left_out() {
        let world_from_camera = Pose { position_m: DVec3::X, ..Pose::IDENTITY };
        let view = RecordedView { world_from_camera, ..image(10, 10.0, None) };
        let at = |x_m: f64, turn_rad: f64| Pose {
            position_m: DVec3::X * x_m,
            rotation: DQuat::from_rotation_y(turn_rad),
        };
        // Within and beyond 5 cm and 0.02 rad; 3.1 rad is nearly the opposite direction.
        for (x_m, turn_rad, is_same) in [
            (1.0, 0.0, true),
            (1.04, 0.01, true),
            (1.06, 0.0, false),
            (0.5, 0.0, false),
            (1.0, 0.03, false),
            (1.0, 3.1, false),
        ] {
            assert_eq!(is_held_out(&view, &[at(9.0, 0.0), at(x_m, turn_rad)]), is_same, "{x_m}");
        }
        assert!(!is_held_out(&view, &[]));
    }

    fn reference(width_px: u32, focal_px: f64, exposure_stops: Option<f64>) -> ReferenceView {
        recorded(&Arc::new(image(width_px, focal_px, exposure_stops)))
    }

    #[test]
    fn a_reference_is_halved_until_it_has_the_resolution_of_the_view() {
        let view = reference(100, 80.0, None).camera;
        // Ratios of the focal lengths: 1, 0.5, then 1.4 and 1.44, below and above √2, then 2, 2 and
        // 4.
        for (width_px, focal_px, wanted_px) in [
            (100, 80.0, 100),
            (50, 40.0, 50),
            (140, 112.0, 140),
            (143, 115.0, 72),
            (200, 160.0, 100),
            (400, 160.0, 200),
            (403, 320.0, 101),
        ] {
            let reduced = reference(width_px, focal_px, None).reduced_for(&view);
            assert_eq!(reduced.camera.width_px, wanted_px, "{width_px} px, {focal_px}");
            let factor = f64::from(wanted_px) / f64::from(width_px);
            assert!((reduced.camera.pinhole.fx - factor * focal_px).abs() < 1e-9);
            assert_eq!(reduced.name, "log@2.00/front");
        }
        let large = reference(200, 160.0, None);
        // The size is part of the identity: both may be in memory.
        assert_ne!(large.id(), large.clone().reduced_for(&view).id());
    }

    #[test]
    fn only_a_known_exposure_is_changed_for_a_camera() {
        let mut camera = RigCamera::new("front", reference(100, 80.0, None).camera, Pose::IDENTITY);
        camera.appearance.exposure = Exposure::new(None, Some([0.5; 3]), [0.0; 3]).ok();
        let known = reference(100, 80.0, Some(-1.0)).exposed_for(&camera);
        assert_eq!(known.appearance.exposure, camera.appearance.exposure);
        let unknown = reference(100, 80.0, None).exposed_for(&camera);
        assert_eq!(unknown.appearance.exposure, None);
        assert_ne!(known.id(), unknown.id());
        let hash = blake3::hash(b"");
        assert_ne!(known.key("v", &hash), unknown.key("v", &hash));
    }
}
