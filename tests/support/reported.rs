//! A small twin with levels of detail, whose settings are measured.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::trajectory::{Keyframe, Trajectory};
use wildcity_scene::{RecordFormat, RenderProfile, Rig};
use wildcity_twin::residency::{Cache, Resident};
use wildcity_twin::store::{Catalog, NewVersion, StorageOptions};

/// Two cameras of a twin whose levels are seen: a street of 40 m, 30,000 Gaussians.
pub(crate) fn commit(dir: &std::path::Path, trajectories: Vec<Trajectory>) -> Arc<Resident> {
    commit_reaching(dir, trajectories, None)
}

/// As [`commit`], drawn up to a distance from each camera, in metres.
pub(crate) fn commit_reaching(
    dir: &std::path::Path,
    trajectories: Vec<Trajectory>,
    reach_m: Option<f64>,
) -> Arc<Resident> {
    let catalog = Catalog::open(dir).unwrap();
    let street = wildcity_generate::canyon(30_000, &mut |_, _| {});
    let new = NewVersion {
        // Full detail, so that only other errors are measured.
        profile: RenderProfile { tau_px: 0.0, reach_m, ..RenderProfile::DEFAULT },
        rig: Some(rig()),
        trajectories,
        storage: StorageOptions { record: RecordFormat::F32, levels: true },
        ..NewVersion::from_gaussians("street", &street, Provenance::new("test".to_owned()))
    };
    catalog.commit(new, &mut |_, _| {}).unwrap();
    Cache::new(catalog).open("street", None).unwrap()
}

pub(crate) fn rig() -> Rig {
    let mut rig = Rig::preset("vehicle6").unwrap();
    rig.cameras.truncate(2);
    for RigCamera { camera, .. } in &mut rig.cameras {
        (camera.width_px, camera.height_px) = (120, 80);
        let p = &mut camera.pinhole;
        (p.fx, p.fy, p.cx, p.cy) = (110.0, 110.0, 60.0, 40.0);
    }
    rig
}

pub(crate) fn drive() -> Trajectory {
    let keyframe = |i: i64| Keyframe {
        time_us: 100_000 * i,
        world_from_rig: Pose {
            position_m: DVec3::new(i as f64 - 20.0, 0.0, 0.0),
            rotation: DQuat::IDENTITY,
        },
    };
    Trajectory { name: "log".to_owned(), keyframes: (0..40).map(keyframe).collect() }
}
