//! Classes of Gaussians in the store.

use glam::{DQuat, DVec3};
use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{ActorBox, ActorClass, Chunk, Gaussians, RecordFormat, Scene, SemanticClass};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{
    Catalog, CutPlace, Labels, NewVersion, StorageOptions, StoreError, Version,
};

use crate::scene_files::gaussians;

/// The class of a place, so that every Gaussian tells which it must have.
fn class_at(mean_m: &[f64; 3]) -> SemanticClass {
    if mean_m[0] < 0.0 { SemanticClass::Building } else { SemanticClass::Vegetation }
}

fn labelled(count: usize, reach_m: f64) -> Gaussians {
    let mut scene = gaussians(count, 1, reach_m, 3);
    scene.classes = Some(scene.means_m.iter().map(class_at).collect());
    scene
}

fn commit(catalog: &Catalog, name: &str, scene: &Gaussians, record: RecordFormat) -> Version {
    let new = NewVersion {
        storage: StorageOptions { record, levels: true },
        ..NewVersion::from_gaussians(name, scene, Provenance::new("test".to_owned()))
    };
    catalog.commit(new, &mut |_, _| {}).unwrap()
}

fn all(catalog: &Catalog, version: &Version) -> Gaussians {
    let mut all = Gaussians { sh_degree: 1, ..Gaussians::default() };
    catalog.visit_full_detail(version, &|_| true, &mut |section| all.append(&section)).unwrap();
    all
}

fn assert_right(scene: &Gaussians) {
    let classes = scene.classes.as_ref().unwrap();
    assert_eq!(classes.len(), scene.len());
    for (mean_m, class) in scene.means_m.iter().zip(classes) {
        assert_eq!(*class, class_at(mean_m), "{mean_m:?}");
    }
}

#[test]
fn classes_come_back_in_every_record_and_every_edit() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    for record in RecordFormat::ALL {
        let name = format!("street-{record}");
        let version = commit(&catalog, &name, &labelled(20_000, 40.0), record);
        assert!(version.manifest.has_classes());
        let read = all(&catalog, &catalog.version(&name, None).unwrap());
        assert_eq!(read.len(), 20_000);
        // Not those within the rounding of a record from the border.
        let far = (0..read.len()).filter(|&i| read.means_m[i][0].abs() > 1e-3);
        assert_right(&read.select(far));
    }
    let base = catalog.version("street-f32", None).unwrap();
    let box_ = ActorBox { length_m: 20.0, width_m: 20.0, height_m: 9.0 };
    let cut = catalog.cut(&base, &Pose::IDENTITY, &box_).unwrap();
    assert_right(&cut.gaussians);
    assert_right(&all(&catalog, &cut.version));
    let copy = catalog.copy("street-f32", None, "copy").unwrap();
    assert_right(&all(&catalog, &copy));
    assert!(catalog.verify("copy", &mut |_, _| {}).unwrap().damaged.is_empty());
}

/// A merged Gaussian has the class of most of what it stands for. Two sheets of one class each, far
/// from each other, stay apart at every level.
#[test]
fn levels_of_detail_keep_classes() {
    let mut sheets = gaussians(40_000, 0, 6.0, 3);
    for mean_m in &mut sheets.means_m {
        mean_m[2] *= 1e-3;
        mean_m[0] += if mean_m[0] < 0.0 { -1.0 } else { 1.0 };
    }
    sheets.ln_scales.fill([-3.0; 3]);
    sheets.classes = Some(sheets.means_m.iter().map(class_at).collect());
    let mut levels = 0;
    for level in wildcity_scene::lod::levels(&Scene::single_chunk(&sheets)) {
        levels += 1;
        let merged = level.chunk.to_gaussians();
        // A limit of the error that joins both sheets is no test.
        if level.error_m < 0.5 {
            assert_right(&merged);
        }
        assert_eq!(merged.classes.map(|classes| classes.len()), Some(level.chunk.len()));
    }
    assert!(levels > 3, "{levels}");
}

#[test]
fn a_merged_gaussian_has_the_class_with_the_greatest_weight() {
    let count = 1_000;
    let is_car = |i: usize| i.is_multiple_of(3);
    // The share of cars among merged Gaussians, if a car has the opacity of this logit.
    let cars = |logit: f32| {
        let mut heap = gaussians(count, 0, 0.02, 3);
        heap.ln_scales.fill([-3.0; 3]);
        heap.sh.fill(0.2);
        for (i, opacity) in heap.logit_opacities.iter_mut().enumerate() {
            *opacity = if is_car(i) { logit } else { -3.0 };
        }
        let class = |i| if is_car(i) { SemanticClass::Car } else { SemanticClass::Road };
        heap.classes = Some((0..count).map(class).collect());
        let last = wildcity_scene::lod::levels(&Scene::single_chunk(&heap)).last().unwrap();
        assert!(last.chunk.len() < 100, "{} are left", last.chunk.len());
        let cars = last.chunk.classes().unwrap().iter().filter(|&&one| one == SemanticClass::Car);
        cars.count() as f64 / last.chunk.len() as f64
    };
    // One in three is a car, of a third of the weight, or of nearly nine tenths.
    let shares = [cars(-3.0), cars(0.0)];
    assert!(shares[0] < 0.25 && shares[1] > 0.9, "{shares:?}");
}

#[test]
fn a_twin_without_classes_has_no_trace_of_them() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let with = labelled(20_000, 40.0);
    let without = Gaussians { classes: None, ..with.clone() };
    let [labelled, plain] = [("with", &with), ("without", &without)]
        .map(|(name, scene)| commit(&catalog, name, scene, RecordFormat::Q32));
    let json = serde_json::to_string(&plain.manifest).unwrap();
    assert!(!json.contains("classes") && !plain.manifest.has_classes(), "{json}");
    // In memory: a byte for each Gaussian, and none without classes.
    let cache = Cache::limited(catalog, None);
    let [labelled, plain] = [labelled, plain].map(|version| {
        let name = version.manifest.twin.clone();
        let levels: u64 = (version.manifest.chunks.iter())
            .flat_map(|chunk| &chunk.sections)
            .map(|section| u64::from(section.count))
            .sum();
        (cache.open(&name, None).unwrap().total_bytes(), levels)
    });
    assert_eq!(labelled.0 - plain.0, labelled.1);
    let chunk = Scene::single_chunk(&without);
    assert_eq!(chunk.bytes() as u64, Chunk::needed_bytes(1, 20_000));
    assert_eq!(Scene::single_chunk(&with).bytes(), chunk.bytes() + 20_000);
}

#[test]
fn an_asset_keeps_classes() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let description = AssetDescription {
        name: "tree".to_owned(),
        class: ActorClass::Object,
        box_: ActorBox::PEDESTRIAN,
        provenance: Provenance::new("test".to_owned()),
    };
    let asset = ActorAsset::new(&labelled(2_000, 2.0), description).unwrap();
    let stored = catalog.put_actor(&asset, RecordFormat::F32).unwrap();
    let read = catalog.actor(&stored.hash).unwrap();
    assert_eq!(read.levels.len(), asset.levels.len());
    for (read, own) in read.levels.iter().zip(&asset.levels) {
        assert_eq!(read.chunk.classes(), own.chunk.classes());
    }
    assert_right(&read.levels[0].chunk.to_gaussians());
}

#[test]
fn boxes_and_the_ground_give_classes() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let scene = gaussians(20_000, 1, 40.0, 3);
    let base = commit(&catalog, "street", &scene, RecordFormat::F32);
    let pose =
        Pose { position_m: DVec3::new(3.0, -2.0, -5.0), rotation: DQuat::from_rotation_z(0.6) };
    let box_ = ActorBox { length_m: 12.0, width_m: 8.0, height_m: 9.0 };
    let is_ground = |at_m: DVec3| at_m.z < -30.0;
    let is_car = |at_m: DVec3| {
        let at_m = pose.inverse().transform_point(at_m);
        at_m.x.abs() <= 6.0 && at_m.y.abs() <= 4.0 && (0.05..=9.0).contains(&at_m.z)
    };
    let place = CutPlace { world_from_box: pose, box_ };
    let cars = Labels { ground: None, places: &[(place, SemanticClass::Car)] };
    let first = catalog.label(&base, cars, "label=a box".to_owned()).unwrap();
    // Only the cells of the box were written.
    let touched = first.version.manifest.chunks.iter().filter(|chunk| chunk.classes).count();
    assert!(touched < first.version.manifest.chunks.len(), "{touched}");
    let ground = Labels { ground: Some((SemanticClass::Road, &is_ground)), places: &[] };
    let second = catalog.label(&first.version, ground, "label=ground".to_owned()).unwrap();
    let read = all(&catalog, &second.version);
    assert_eq!(read.len(), 20_000);
    let mut counts = [0; 3];
    for (mean_m, class) in read.means_m.iter().zip(read.classes.as_ref().unwrap()) {
        let at_m = DVec3::from_array(*mean_m);
        let (index, wanted) = match (is_car(at_m), is_ground(at_m)) {
            (_, true) => (0, SemanticClass::Road),
            (true, false) => (1, SemanticClass::Car),
            (false, false) => (2, SemanticClass::Unlabelled),
        };
        assert_eq!(*class, wanted, "{mean_m:?}");
        counts[index] += 1;
    }
    assert_eq!([first.gaussians, second.gaussians], [counts[1], counts[0]]);
    assert!(counts.iter().all(|&count| count > 20), "{counts:?}");
    let nothing = Labels { ground: Some((SemanticClass::Road, &|_| false)), places: &[] };
    let refused = catalog.label(&base, nothing, String::new()).unwrap_err();
    assert!(matches!(refused, StoreError::NothingToLabel), "{refused}");
}
