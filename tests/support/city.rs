//! A thin procedural city, with all levels of detail.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use wildcity_generate::CitySettings;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{RenderProfile, Rig, Trajectory};
use wildcity_twin::store::{Catalog, CommitKind, StorageOptions, VersionSettings};

pub(crate) struct City {
    pub(crate) dir: tempfile::TempDir,
    pub(crate) drive: Trajectory,
}

/// A twin "city" of this length.
pub(crate) fn city(length_m: f64) -> City {
    let settings = CitySettings { seed: 3, length_m, millions_per_km: 1.0, speed_m_s: 30.0 };
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let mut commit = catalog.begin("city", CommitKind::Import, StorageOptions::default()).unwrap();
    for cell in wildcity_generate::city(&settings).unwrap() {
        commit.put(&cell.gaussians, None, &mut |_, _| {}).unwrap();
    }
    let drive = wildcity_generate::city_drive(&settings).unwrap();
    let settings = VersionSettings {
        profile: RenderProfile { reach_m: Some(120.0), ..RenderProfile::DEFAULT },
        rig: Rig::preset("vehicle6"),
        trajectories: vec![drive.clone()],
        sky: None,
        geo: None,
        twin_from_capture: None,
        provenance: Provenance::new("test".into()),
    };
    commit.replace(None, settings).unwrap();
    City { dir, drive }
}
