//! The cost of each feature of a scene on a device. The base scene pays for none of them.

use std::cell::Cell;

use glam::DVec3;
use wildcity_render::gpu::{AdapterChoice, Gpu};
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_report::feature_costs::{self, DeviceCounts};
use wildcity_report::measure::Benchmark;
use wildcity_report::sample_points::{Sampling, sample_points};
use wildcity_report::settings::{SettingList, TwinFeatures, settings_to_compare};
use wildcity_scene::geometry::camera::{Fisheye, Lens};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Rays, RecordFormat, RenderProfile, Scene};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, NewVersion, StorageOptions};

use crate::gpu::gpu;
use crate::images::{cpu, render_one, view_along};
use crate::skies::sky;
use crate::streets::street;

/// Pipelines that the base scene compiles, and dispatches of a step. One more would be one that it
/// does not need.
const BASE: [u64; 2] = [28, 50];

#[test]
fn a_report_has_the_device_memory_of_each_setting() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let scene = street(20_000, 1, 5);
    let new = NewVersion {
        storage: StorageOptions { record: RecordFormat::F32, levels: false },
        ..NewVersion::from_gaussians("street", &scene, Provenance::new("test".to_owned()))
    };
    catalog.commit(new, &mut |_, _| {}).unwrap();
    let resident = Cache::new(catalog).open("street", None).unwrap();
    let manifest = &resident.version.manifest;
    let places = sample_points(manifest, &[], Sampling { stations: 2, window_px: [32, 32] });
    let open = || Gpu::new(&AdapterChoice::Best, 0).ok();
    let backends: [Box<dyn Backend>; 2] = [Box::new(cpu()), Box::new(open().unwrap())];
    let twin = TwinFeatures::new(manifest, None, &places[0].views);
    let SettingList { settings, .. } = settings_to_compare(&twin, &["cpu", "gpu"]);
    let held_bytes = |name: &str, device: &dyn Fn() -> Option<Gpu>| {
        let bench = Benchmark {
            resident: &resident,
            backends: &backends,
            sample_points: &places,
            repeat: 1,
            open_device: device,
        };
        let truth = bench.render_reference(Rays::Splats, &mut |_| {}).unwrap();
        let setting = settings.iter().find(|setting| setting.name == name).unwrap();
        bench.measure(setting, &truth).unwrap().cost.device_bytes
    };
    assert_eq!(held_bytes("as served", &open), None);
    assert_eq!(held_bytes("gpu", &|| None), None);
    // The same images take as much on a device that the test opens: the Gaussians, and buffers of
    // stages.
    let (device, scene) = (open().unwrap(), Scene::from_gaussians(&scene));
    let mut rgb8 = vec![0; 3 * 640 * 480];
    for place in &places {
        let (profile, views) = (RenderProfile::default(), &place.views[..]);
        let target = Target { rgb8: Some(&mut rgb8), ..Target::default() };
        let frame = Frame { scene: &scene, profile: &profile, views };
        device.render(&frame, &mut [target], &|_, _| {}).unwrap();
    }
    let usage = device.usage().unwrap();
    let held = held_bytes("gpu", &open).unwrap();
    assert!(held >= usage.mirror_bytes + 4 * 640 * 480, "{held} B of {usage:?}");
    let (held, own) = (held as f64, usage.allocated_bytes.unwrap() as f64);
    assert!((0.9..1.1).contains(&(held / own)), "{held} B, {own} B on the test's own");
}

#[test]
fn each_feature_costs_and_the_base_scene_pays_for_none() {
    let opened = Cell::new(0);
    let open = || {
        opened.set(opened.get() + 1);
        Gpu::new(&AdapterChoice::Best, 0).ok()
    };
    let rows = feature_costs::count_features(&cpu(), &open).unwrap();
    rows.iter()
        .for_each(|row| eprintln!("| {} | {} |", row.feature, row.counts.cells().join(" | ")));
    // Each row has its own device, which renders nothing else.
    assert_eq!(opened.get(), rows.len());
    let of = |with: &str| rows.iter().find(|row| row.feature == with).unwrap().counts.device;
    let base = counted(of("nothing else"));
    assert_eq!([base[0], base[2]], BASE);
    let beyond = |with: &str| {
        let own = counted(of(with));
        [0, 1, 2, 3].map(|i| own[i] as i64 - base[i] as i64)
    };
    for (with, planes) in [
        ("SH degree 1", 0),
        ("SH degree 3", 0),
        ("antialiasing", 0),
        ("depth", 1),
        ("normals", 1),
        ("trust", 1),
        ("depth and opacity", 2),
    ] {
        assert_eq!(beyond(with), [0, 0, 0, 4 * planes], "{with}");
    }
    // Fewer Gaussians, so that a buffer may not have to grow.
    let [pipelines, buffers, dispatches, planes] = beyond("levels of detail, 1 m");
    assert!(buffers <= 0 && [pipelines, dispatches, planes] == [0; 3]);
    // Other pipelines replace the last and the first one, with more buffers.
    for with in [
        "background",
        "sky of images",
        "sky, baked",
        "sky, exact",
        "exposure",
        "hood",
        "fisheye",
        "windshield",
        "rolling shutter",
    ] {
        let [pipelines, buffers, dispatches, planes] = beyond(with);
        assert!(buffers > 0 && [pipelines, dispatches, planes] == [0; 3], "{with}");
    }
    // Culling and projecting twice: of the actors, and of the chunks of the twin with their
    // shadows. And buffers of lights and of shadows, with lenses for actors that move.
    for (with, more_buffers) in [("two actors", 2), ("two moving actors", 3)] {
        let [pipelines, buffers, dispatches, planes] = beyond(with);
        assert_eq!([pipelines, dispatches, planes], [4, 4, 0], "{with}");
        assert!(buffers >= more_buffers, "{with}: {buffers}");
    }
    let [pipelines, buffers, dispatches, planes] = beyond("instance ids");
    assert!(buffers >= 1 && [pipelines, dispatches, planes] == [0, 0, 4]);
    // A kernel and its dispatch, in place of the search among owners; two buffers at least.
    let [pipelines, buffers, dispatches, planes] = beyond("semantics");
    assert!(buffers >= 2 && [pipelines, dispatches, planes] == [1, 1, 4], "{buffers}");
    // Classes without a target for them take a byte of a Gaussian, and nothing else.
    assert_eq!(beyond("classes"), [0; 4]);
    let bytes = |with: &str| of(with).unwrap().bytes_per_gaussian;
    let of_classes = bytes("classes") - bytes("nothing else");
    assert!((0.5..1.5).contains(&of_classes), "{of_classes}");
    // SH coefficients are f16: 9 values, and 45.
    let colours = ["SH degree 1", "SH degree 3"].map(|with| bytes(with) - bytes("nothing else"));
    assert!(
        (15.0..19.0).contains(&colours[0]) && (86.0..92.0).contains(&colours[1]),
        "{colours:?}"
    );
}

/// Pipelines, buffers, dispatches, and bytes per pixel that are read back.
fn counted(counts: Option<DeviceCounts>) -> [u64; 4] {
    let counts = counts.unwrap();
    [counts.pipelines, counts.buffers, counts.dispatches, counts.read_back_bytes_per_pixel]
}

/// The base scene does not pay for features that the same device rendered before.
#[test]
fn after_other_features_the_base_scene_costs_the_same() {
    let gpu = gpu();
    let base = Scene::from_gaussians(&street(5_000, 0, 3));
    let rich = Scene { sky: Some(sky()), ..Scene::from_gaussians(&street(5_000, 1, 3)) };
    let view = view_along([64, 48], 40.0, DVec3::new(-20.0, 0.3, 1.6), DVec3::X, DVec3::NEG_Z);
    let mut bent = view;
    bent.camera.lens = Lens::Fisheye(Fisheye::new([-0.03, -0.005, 0.0, 0.0], None));
    let made = |scene: &Scene, view: View| {
        let before = gpu.usage().map(|usage| usage.totals).unwrap_or_default();
        render_one(&*gpu, scene, &RenderProfile::DEFAULT, view);
        let after = gpu.usage().unwrap().totals;
        [
            after.pipelines - before.pipelines,
            after.buffers - before.buffers,
            after.dispatches - before.dispatches,
        ]
    };
    made(&base, view);
    let alone = made(&base, view);
    assert_eq!([alone[0], alone[1]], [0, 0]);
    let with_others = [made(&rich, view), made(&rich, bent)];
    assert!(with_others[0][0] > 0 && with_others[0][1] > 0, "{with_others:?}");
    assert_eq!(made(&base, view), alone);
}
