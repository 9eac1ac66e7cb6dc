//! What an import accepts, every edit of it accepts: at the ends of all bounds, in every record
//! format.

use std::f32::consts::PI;

use glam::{DQuat, DVec3};
use proptest::prelude::*;
use proptest::test_runner::TestRunner;

use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::validate::{self, Field};
use wildcity_scene::{ActorBox, Gaussians, RecordFormat, sh};
use wildcity_twin::ingest;
use wildcity_twin::store::{Catalog, Edit, NewVersion, StorageOptions, StoreError, Version};

use crate::scene_files::{inria_columns, ply};

/// Numbers of a Gaussian as a file may have them: values at the ends of their bounds are as likely
/// as others.
fn gaussian() -> impl Strategy<Value = Gaussians> {
    let mean = prop_oneof![-40.0..40.0, Just(0.0), Just(5.5e7), Just(-5.5e7), -5e7..5e7];
    let quat = prop_oneof![-1.0_f32..1.0, Just(1e-3_f32), Just(9e4_f32)];
    let smallest = prop_oneof![Just(f32::NEG_INFINITY), Just(-1e30_f32), Just(-46.0), Just(-30.0)];
    let scale = prop_oneof![-8.0_f32..2.0, smallest, Just(9.9_f32)];
    let full = prop_oneof![Just(f32::INFINITY), Just(f32::NEG_INFINITY), Just(1e4), Just(-1e4)];
    let logit = prop_oneof![-6.0_f32..9.0, full];
    let coefficient = prop_oneof![-1.0_f32..1.0, Just(1e3_f32), Just(-1e3_f32)];
    let colour = prop::collection::vec(coefficient, 3 * sh::coefficients(1));
    let arrays = (prop::array::uniform3(mean), prop::array::uniform4(quat));
    (arrays, prop::array::uniform3(scale), logit, colour).prop_map(
        |((mean_m, mut quat), ln_scale, logit, sh)| {
            quat[0] += PI;
            Gaussians {
                sh_degree: 1,
                means_m: vec![mean_m],
                quats_wxyz: vec![quat],
                ln_scales: vec![ln_scale],
                logit_opacities: vec![logit],
                sh,
                ..Gaussians::default()
            }
        },
    )
}

fn scene() -> impl Strategy<Value = Gaussians> {
    prop::collection::vec(gaussian(), 1..12).prop_map(|parts| {
        let mut all = Gaussians::default();
        parts.iter().for_each(|part| all.append(part));
        all
    })
}

/// All Gaussians of a version, at full detail.
fn exported(catalog: &Catalog, version: &Version) -> Gaussians {
    let sh_degree = version.manifest.sh_degree;
    let mut all = Gaussians { sh_degree, ..Gaussians::default() };
    catalog.visit_full_detail(version, &|_| true, &mut |section| all.append(&section)).unwrap();
    all
}

fn commit(
    catalog: &Catalog,
    gaussians: &Gaussians,
    record: RecordFormat,
) -> Result<Version, StoreError> {
    let storage = StorageOptions { record, levels: false };
    let new = NewVersion::from_gaussians("street", gaussians, Provenance::new("test".into()));
    catalog.commit(NewVersion { storage, ..new }, &mut |_, _| {})
}

fn check(scene: &Gaussians, record: RecordFormat, metres_per_unit: f64) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.ply");
    std::fs::write(&path, ply(scene, &inria_columns(1, false))).unwrap();
    let read = ingest::read(&path, &mut |_, _| {}).unwrap();
    let catalog = Catalog::open(&dir.path().join("twins")).unwrap();
    let first = match commit(&catalog, &read, record) {
        // A record format that cannot hold the scene refuses the import.
        Err(StoreError::Clamped { .. }) => return,
        first => first.unwrap(),
    };
    let turn = Pose { rotation: DQuat::from_rotation_z(0.7), ..Pose::IDENTITY };
    let tilt = Pose { rotation: DQuat::from_axis_angle(DVec3::Y, 0.4), ..Pose::IDENTITY };
    let mut version = first;
    for new_from_old in [turn, tilt] {
        let alignment = Alignment { new_from_old, metres_per_unit };
        let edit = Edit { alignment, trajectories: Vec::new(), rig: None };
        version = match catalog.edit(&version, edit, &mut |_, _| {}) {
            Err(StoreError::Clamped { .. }) => return,
            edited => edited.unwrap_or_else(|error| panic!("{record}: {error}: {scene:?}")),
        };
        let edited = exported(&catalog, &version);
        validate::check(&edited, &Field::twin_name).unwrap_or_else(|bad| panic!("{record}: {bad}"));
        let again = Catalog::open(&dir.path().join("again")).unwrap();
        let pushed = commit(&again, &edited, record);
        assert!(matches!(pushed, Ok(_) | Err(StoreError::Clamped { .. })), "{record}: {pushed:?}");
    }
    // As an asset of an actor and out of it: the whole scene, far away or near, in one chunk.
    let asset = wildcity_scene::Scene::single_chunk(&read).to_gaussians();
    validate::check(&asset, &Field::twin_name).unwrap_or_else(|bad| panic!("asset: {bad}"));
    let box_ = ActorBox { length_m: 5.0, width_m: 5.0, height_m: 5.0 };
    let cut = catalog.cut(&version, &Pose::IDENTITY, &box_);
    assert!(matches!(cut, Ok(_) | Err(StoreError::NothingToCut { .. })), "{record}: {cut:?}");
}

#[test]
fn whatever_an_import_accepts_every_edit_of_it_accepts() {
    let config =
        ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() };
    let record = prop_oneof![
        Just(RecordFormat::F32),
        Just(RecordFormat::H52),
        Just(RecordFormat::Q32),
        Just(RecordFormat::Q24)
    ];
    let units = prop_oneof![Just(1.0), Just(0.01), Just(0.003)];
    TestRunner::new(config)
        .run(&(scene(), record, units), |(scene, record, metres_per_unit)| {
            check(&scene, record, metres_per_unit);
            Ok(())
        })
        .unwrap();
}
