//! A sparse demo street of 600 m, of which a frame draws 120 m, so that a drive needs different
//! parts over time.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::path::Path;
use std::sync::OnceLock;
use std::time::Duration;

use glam::DVec3;
use wildcity_generate::StreetSettings;
use wildcity_render::View;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Gaussians, RenderProfile, Scene, Trajectory};
use wildcity_twin::residency::{Cache, Resident, SectionRef, Viewpoint};
use wildcity_twin::store::{Catalog, NewVersion, Version};

use crate::images::{cpu, render, view_along};

/// How long a test waits for anything before it fails.
pub(crate) const TEST_TIMEOUT: Duration = Duration::from_secs(20);

/// The profile: a frame draws sections within 120 m, so that a drive needs different parts over
/// time.
pub(crate) const PROFILE: RenderProfile =
    RenderProfile { reach_m: Some(120.0), ..RenderProfile::DEFAULT };

/// The demo street, sparser and longer: 600 m, all levels of detail.
pub(crate) struct Demo {
    pub(crate) dir: tempfile::TempDir,
    pub(crate) trajectory: Trajectory,
}

pub(crate) fn demo() -> &'static Demo {
    static DEMO: OnceLock<Demo> = OnceLock::new();
    DEMO.get_or_init(|| {
        let settings =
            StreetSettings { length_m: 600.0, density: 0.2, ..StreetSettings::default() };
        let street = wildcity_generate::street(&settings).unwrap();
        let dir = tempfile::tempdir().unwrap();
        commit(dir.path(), "demo", &street.gaussians);
        Demo { dir, trajectory: street.trajectory }
    })
}

impl Demo {
    pub(crate) fn catalog(&self) -> Catalog {
        Catalog::open(self.dir.path()).unwrap()
    }

    /// The pose of the car at a distance along the street, in metres.
    pub(crate) fn at(&self, station_m: f64) -> Pose {
        self.trajectory.at_station(station_m)
    }
}

pub(crate) fn commit(dir: &Path, name: &str, gaussians: &Gaussians) -> Version {
    let provenance = Provenance::new("test".into());
    let new =
        NewVersion { profile: PROFILE, ..NewVersion::from_gaussians(name, gaussians, provenance) };
    Catalog::open(dir).unwrap().commit(new, &mut |_, _| {}).unwrap()
}

/// Two small cameras of a car: ahead and to its left.
pub(crate) fn views(world_from_rig: Pose) -> [View; 2] {
    let at = world_from_rig.position_m + DVec3::Z * 1.6;
    let forward = world_from_rig.rotation * DVec3::X;
    let left = world_from_rig.rotation * DVec3::Y;
    [
        view_along([96, 64], 70.0, at, forward, -DVec3::Z),
        view_along([64, 64], 40.0, at, left, -DVec3::Z),
    ]
}

pub(crate) fn eyes(views: &[View]) -> Vec<Viewpoint> {
    let eye = |view: &View| Viewpoint {
        position_m: view.world_from_camera.position_m,
        focal_px: view.camera.pinhole.fx.max(view.camera.pinhole.fy),
    };
    views.iter().map(eye).collect()
}

/// The pixels of a scene as two cameras at a pose see it.
pub(crate) fn pixels(scene: &Scene, world_from_rig: Pose) -> Vec<Vec<u8>> {
    let views = views(world_from_rig);
    render(&cpu(), scene, &PROFILE, &views).into_iter().map(|image| image.rgb8).collect()
}

/// Bytes of memory that sections take.
pub(crate) fn bytes(resident: &Resident, needed: &[SectionRef]) -> u64 {
    let manifest = &resident.version.manifest;
    let of = |n: &SectionRef| {
        let chunk = &manifest.chunks[n.chunk];
        chunk.needed_bytes(manifest.sh_degree, &chunk.sections[n.section])
    };
    needed.iter().map(of).sum()
}

/// Memory that a frame of the demo street needs at a pose, in bytes.
pub(crate) fn need_bytes(resident: &Resident, world_from_rig: Pose) -> u64 {
    bytes(resident, &resident.demand(&eyes(&views(world_from_rig)), &PROFILE))
}

/// A cache without a memory limit.
pub(crate) fn unlimited() -> Cache {
    Cache::new(demo().catalog())
}
