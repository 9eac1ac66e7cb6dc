//! Records and levels of detail: how much is lost, that nothing else is, and that it is always the
//! same.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/images.rs"]
mod images;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/scene_files.rs"]
mod scene_files;
#[path = "../support/streets.rs"]
mod streets;

mod demand;
mod levels;
mod records;
mod views;

use std::path::Path;
use std::sync::Arc;

use wildcity_render::View;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Gaussians, RecordFormat, RenderProfile, Scene};
use wildcity_twin::residency::{Cache, PinnedScene, Resident, Viewpoint};
use wildcity_twin::store::{Catalog, NewVersion, StorageOptions, StoreError, Version};

use images::{cpu, psnr, render};

/// Stores a scene as the next version of twin "street".
fn commit(
    dir: &Path,
    gaussians: &Gaussians,
    storage: StorageOptions,
) -> Result<Version, StoreError> {
    let provenance = Provenance::new("test".into());
    let new = NewVersion { storage, ..NewVersion::from_gaussians("street", gaussians, provenance) };
    Catalog::open(dir)?.commit(new, &mut |_, _| {})
}

/// A scene that was stored.
struct Stored {
    resident: Arc<Resident>,
    _dir: tempfile::TempDir,
}

fn stored(gaussians: &Gaussians, record: RecordFormat, levels: bool) -> Stored {
    let dir = tempfile::tempdir().unwrap();
    commit(dir.path(), gaussians, StorageOptions { record, levels }).unwrap();
    let resident = Cache::new(Catalog::open(dir.path()).unwrap()).open("street", None).unwrap();
    Stored { resident, _dir: dir }
}

impl Stored {
    /// The data that is read again for a frame.
    fn scene(&self, eyes: &[Viewpoint], profile: &RenderProfile) -> PinnedScene {
        self.resident.scene(eyes, profile).unwrap()
    }
}

fn eyes(views: &[View]) -> Vec<Viewpoint> {
    let eye = |view: &View| Viewpoint {
        position_m: view.world_from_camera.position_m,
        focal_px: view.camera.pinhole.fx.max(view.camera.pinhole.fy),
    };
    views.iter().map(eye).collect()
}

/// The default profile with another tau.
fn tau(tau_px: f64) -> RenderProfile {
    RenderProfile { tau_px, ..RenderProfile::default() }
}

/// Signal-to-noise ratio of all views of a scene, in dB; infinite if they are the same.
fn decibels(scene: &Scene, truth: &Scene, views: &[View]) -> f64 {
    let rgb = |scene: &Scene| -> Vec<f32> {
        let images = render(&cpu(), scene, &RenderProfile::default(), views);
        images.into_iter().flat_map(|image| image.rgba).collect()
    };
    psnr(&rgb(scene), &rgb(truth))
}
