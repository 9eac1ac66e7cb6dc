//! The gain and the cost of repair off the trajectory, with models whose images are known.

use std::sync::Arc;

use glam::DVec3;
use serde_json::{Value, json};
use wildcity_generate::Spoil;
use wildcity_render::View;
use wildcity_render::compare::flicker::flicker;
use wildcity_render::compare::images::render_images;
use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_repair::Model;
use wildcity_repair::reference::ReferenceCache;
use wildcity_report::ReportError;
use wildcity_report::repair::{
    ImageKind, RepairBenchmark, RepairReport, RepairRow, RepairSampling, measure,
};
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::views::RecordedView;
use wildcity_scene::{RecordFormat, RenderProfile};
use wildcity_session::limits::FRAME_M;
use wildcity_twin::residency::{Cache, Resident};
use wildcity_twin::store::{Catalog, CommitKind, NewVersion, StorageOptions, VersionChange};

use crate::images::cpu;
use crate::onnx_doubles as doubles;
use crate::onnx_models::Folder;
use crate::reported::{drive, rig};

const STORAGE: StorageOptions = StorageOptions { record: RecordFormat::F32, levels: false };

/// A street, a spoiled copy of it, and the same with images of the street as recorded ones.
struct Twins {
    _dir: tempfile::TempDir,
    catalog: Catalog,
    truth: Arc<Resident>,
    worn: Arc<Resident>,
    recorded: Arc<Resident>,
}

impl Twins {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let catalog = Catalog::open(dir.path()).unwrap();
        let street = wildcity_generate::canyon(30_000, &mut |_, _| {});
        let spoiled = Spoil::new(0.5, 3, &drive()).unwrap().apply(&street);
        for (name, gaussians) in [("street", &street), ("worn", &spoiled)] {
            let new = NewVersion {
                profile: RenderProfile { tau_px: 0.0, ..RenderProfile::DEFAULT },
                rig: Some(rig()),
                trajectories: vec![drive()],
                storage: STORAGE,
                ..NewVersion::from_gaussians(name, gaussians, Provenance::new("test".to_owned()))
            };
            catalog.commit(new, &mut |_, _| {}).unwrap();
        }
        let open = |name: &str, number| {
            let catalog = Catalog::open(dir.path()).unwrap();
            Cache::new(catalog).open(name, number).unwrap()
        };
        let truth = open("street", None);
        let worn = open("worn", None);
        record(&catalog, &truth);
        let recorded = open("worn", None);
        assert_ne!(recorded.version.number, worn.version.number);
        Self { _dir: dir, catalog, truth, worn, recorded }
    }

    fn measured(
        &self,
        resident: &Arc<Resident>,
        truth: Option<&Arc<Resident>>,
        models: &[Arc<Model>],
    ) -> Result<RepairReport, ReportError> {
        self.measured_at(&[1.0, 3.0], resident, truth, models)
    }

    fn measured_at(
        &self,
        offsets_m: &[f64],
        resident: &Arc<Resident>,
        truth: Option<&Arc<Resident>>,
        models: &[Arc<Model>],
    ) -> Result<RepairReport, ReportError> {
        let benchmark = RepairBenchmark {
            resident,
            catalog: &self.catalog,
            truth,
            backend: &cpu(),
            cameras: &rig().cameras,
            models,
            references: &ReferenceCache::default(),
            sampling: RepairSampling::new(4, offsets_m, 360),
        };
        measure(&benchmark, &mut |_, _| {})
    }
}

/// Gives the worn twin what the cameras of the street saw on its drive, every 2 m.
fn record(catalog: &Catalog, truth: &Arc<Resident>) {
    let base = catalog.version("worn", None).unwrap();
    let mut commit = catalog.begin("worn", CommitKind::Import, STORAGE).unwrap();
    let mut views = Vec::new();
    for step in 0..20 {
        let station_m = 2.0 * f64::from(step);
        let world_from_rig = drive().at_station(station_m);
        let seen = View::from_rig(&rig().cameras, world_from_rig);
        for (view, (camera, rgb8)) in seen.iter().zip(rig().cameras.iter().zip(drawn(truth, &seen)))
        {
            let jpeg = wildcity_session::jpeg(&rgb8, 120, 80, 98).unwrap();
            views.push(RecordedView {
                trajectory: "log".to_owned(),
                station_m,
                camera_name: camera.name.clone(),
                camera: view.camera,
                world_from_camera: view.world_from_camera,
                exposure_stops: None,
                image: commit.put_image(&jpeg).unwrap(),
                mask: None,
            });
        }
    }
    let views = commit.put_views(&views).unwrap();
    commit.set_views(Some(views));
    let change = VersionChange::edit();
    commit.change(base.number, change).unwrap();
}

fn drawn(resident: &Arc<Resident>, views: &[View]) -> Vec<Vec<u8>> {
    let profile = &resident.version.manifest.profile;
    let scene = resident.scene(&wildcity_session::viewpoints(views), profile).unwrap();
    let images = render_images(&cpu(), &scene, profile, views).unwrap();
    images.into_iter().map(|image| image.rgb8).collect()
}

/// A model that a test wrote, and its folder.
fn model(name: &str, onnx: &[u8], changes: Value) -> (Folder, Arc<Model>) {
    let mut folder = Folder::new(onnx, changes);
    folder.manifest["name"] = json!(name);
    let model = Arc::new(folder.load().unwrap());
    (folder, model)
}

fn warping() -> (Folder, Arc<Model>) {
    let inputs = json!([
        {"name": "image", "role": "rgb"},
        {"name": "warped", "role": "reference_warped"},
        {"name": "valid", "role": "reference_valid"},
    ]);
    model("warping", &doubles::warped_where_valid(), json!({"inputs": inputs}))
}

fn rows<'a>(report: &'a RepairReport, name: &str) -> Vec<&'a RepairRow> {
    report.rows.iter().filter(|row| row.name == name).collect()
}

/// The JSON without times, and what is computed from them.
fn timeless(report: &RepairReport) -> Value {
    fn strip(value: &mut Value) {
        match value {
            Value::Object(fields) => {
                fields.retain(|name, _| !name.ends_with("_ms"));
                fields.values_mut().for_each(strip);
            }
            Value::Array(values) => values.iter_mut().for_each(strip),
            _ => {}
        }
    }
    let mut value = serde_json::to_value(report).unwrap();
    strip(&mut value);
    value
}

#[test]
fn models_with_known_images_have_known_rows_and_losses_are_told() {
    let twins = Twins::new();
    let (_a, same) = model("same", &doubles::identity(), json!({}));
    let (_b, brighter) = model("brighter", &doubles::arithmetic("Add", 0.1), json!({}));
    let (_c, warping) = warping();
    let models = [same, warping, brighter];
    let report = twins.measured(&twins.recorded, Some(&twins.truth), &models).unwrap();
    for row in &report.rows {
        eprintln!(
            "{} m {}: trust {:.3}, covered {:.2}, {:?} dB, {:?} more, {:?} worse, FLIP {:?}, flicker {:.4} x {:.2}, true {:?}, {:?}",
            row.offset_m,
            row.name,
            row.trust,
            row.covered,
            row.psnr_db,
            row.gain_db,
            row.worse,
            row.flip,
            row.flicker,
            row.flicker_ratio,
            row.true_flicker,
            row.repair_parts_ms
        );
    }
    assert_eq!(report.subject.references, "recorded");
    assert!(report.subject.read > 10, "{}", report.subject.read);
    assert_eq!(report.rows.len(), 3 * 5);
    let kinds: Vec<ImageKind> = report.rows[..5].iter().map(|row| row.kind).collect();
    use ImageKind::{Model as Net, Rendered, Warped};
    assert_eq!(kinds, [Rendered, Warped, Net, Net, Net]);

    let rendered = rows(&report, "rendered");
    let offsets_m: Vec<f64> = rendered.iter().map(|row| row.offset_m).collect();
    assert_eq!(offsets_m, [0.0, 1.0, 3.0]);
    assert!(rendered.iter().all(|row| row.images == 4 * 2 && row.gain_db == Some(0.0)));
    assert!(rendered.iter().all(|row| row.flicker_ratio == 1.0 && row.repair_ms == 0.0));
    assert!(rendered[0].trust > 0.9 && rendered[1].trust < 0.83 && rendered[2].trust < 0.56);
    for (same, rendered) in rows(&report, "same").iter().zip(&rendered) {
        assert_eq!((same.psnr_db, same.flip), (rendered.psnr_db, rendered.flip));
        assert_eq!((same.gain_db, same.worse, same.flicker_ratio), (Some(0.0), Some(0), 1.0));
        assert!(same.repair_parts_ms.model > 0.0 && same.repair_parts_ms.warp == 0.0);
    }
    for (net, warped) in rows(&report, "warping").iter().zip(rows(&report, "warped")) {
        assert_eq!((net.psnr_db, net.flip), (warped.psnr_db, warped.flip));
        assert_eq!((net.flicker, net.worse), (warped.flicker, warped.worse));
        assert!(net.covered > 0.2 && net.repair_ms > warped.repair_ms && warped.repair_ms > 0.0);
        let parts = net.repair_parts_ms;
        assert!(parts.warp > 0.0 && parts.model > 0.0 && parts.merge > 0.0, "{parts:?}");
    }
    let [_, near, _] = rows(&report, "warped")[..] else { panic!("{:?}", report.rows) };
    assert!(near.gain_db > Some(0.3), "recorded images help 1 m beside the drive: {near:?}");

    let page = report_page(&report);
    for row in rows(&report, "brighter") {
        assert!(row.gain_db < Some(-1.0) && row.worse == Some(row.images), "{row:?}");
        let told = format!("class=\"miss\">{:+.2}<", row.gain_db.unwrap());
        assert!(page.contains(&told), "{told} is missing");
    }
    let [same, warping, brighter] = &report.below[..] else { panic!("{:?}", report.below) };
    assert_eq!((same.below, brighter.below), (None, None));
    assert!(page.contains("brighter: no trust is recommended: no threshold gains"));
    let below = warping.below.expect("it gains 1 m beside the drive");
    assert!((0.55..=1.0).contains(&below), "{warping:?}");
    let [chosen, verified] =
        [&warping.selection, &warping.verification].map(|at| at.as_ref().unwrap());
    assert_eq!((chosen.images, verified.images), (12, 12));
    assert!(verified.gain_db > Some(0.0));
    assert!(page.contains(&warping.text()));
}

fn report_page(report: &RepairReport) -> String {
    wildcity_report::repair::section(report).into_string()
}

#[test]
fn psnr_and_flicker_are_those_of_the_poses_beside_the_drive() {
    let twins = Twins::new();
    let report = twins.measured(&twins.worn, Some(&twins.truth), &[]).unwrap();
    assert_eq!(report.subject.references, "rendered");
    let mut sums_db = [0.0; 3];
    for station in 0..4 {
        let station_m = drive().length_m() * (f64::from(station) + 0.5) / 4.0;
        for (sum_db, offset_m) in sums_db.iter_mut().zip([0.0, 1.0, 3.0]) {
            let y_m = if station < 2 { offset_m } else { -offset_m };
            let beside = Pose { position_m: DVec3::new(0.0, y_m, 0.0), ..Pose::IDENTITY };
            let views = View::from_rig(&rig().cameras, drive().at_station(station_m) * beside);
            let [own, truth] = [&twins.worn, &twins.truth].map(|twin| drawn(twin, &views));
            for (own, truth) in own.iter().zip(&truth) {
                *sum_db += psnr_db_u8(own.iter().zip(truth));
            }
        }
    }
    // Without bringing the earlier image into the view, the difference is that of other places.
    let mut unmoved = 0.0;
    for station in 0..4 {
        let station_m = drive().length_m() * (f64::from(station) + 0.5) / 4.0;
        let [now, before] = [0.0, FRAME_M].map(|back_m| {
            let pose = drive().at_station(station_m - back_m);
            drawn(&twins.truth, &View::from_rig(&rig().cameras, pose))
        });
        for (now, before) in now.iter().zip(&before) {
            unmoved += flicker(now, before, &vec![1.0; 120 * 80]).unwrap() / 8.0;
        }
    }
    let true_flicker = rows(&report, "rendered")[0].true_flicker.unwrap();
    assert!(true_flicker < 0.6 * unmoved, "{true_flicker} of {unmoved}");
    for (row, sum_db) in rows(&report, "rendered").iter().zip(sums_db) {
        let psnr_db = row.psnr_db.unwrap();
        assert!((psnr_db - sum_db / 8.0).abs() < 1e-9, "{psnr_db} dB, not {}", sum_db / 8.0);
        // A step of 0.8 m changes shading and rounding, but little else: the views are brought
        // together.
        assert!((0.0005..0.08).contains(&row.flicker), "{row:?}");
        assert!((0.0005..0.08).contains(&row.true_flicker.unwrap()), "{row:?}");
    }
}

#[test]
fn without_a_true_twin_times_and_flicker_remain_and_the_page_says_so() {
    let twins = Twins::new();
    let (_a, brighter) = model("brighter", &doubles::arithmetic("Add", 0.1), json!({}));
    let report = twins.measured(&twins.worn, None, &[brighter]).unwrap();
    assert!(report.subject.truth.is_none() && report.below.is_empty());
    for row in &report.rows {
        assert_eq!((row.psnr_db, row.gain_db, row.worse), (None, None, None), "{row:?}");
        assert_eq!((row.flip, row.db_per_100_ms, row.true_flicker), (None, None, None), "{row:?}");
        assert!(row.flicker > 0.0 && row.render_ms > 0.0, "{row:?}");
    }
    let page = report_page(&report);
    assert!(page.contains("how these views truly look is unknown"), "{page}");
    assert!(!page.contains("PSNR, dB") && !page.contains("worse images"), "{page}");
    assert!(page.contains("flicker"));
}

#[test]
fn a_second_run_gives_the_same_but_for_its_times() {
    let twins = Twins::new();
    let (_a, warping) = warping();
    let models = [warping];
    let once = twins.measured(&twins.recorded, Some(&twins.truth), &models).unwrap();
    let again = twins.measured(&twins.recorded, Some(&twins.truth), &models).unwrap();
    assert_eq!(timeless(&once), timeless(&again));
    assert_eq!(once.below, again.below);
}

#[test]
fn a_model_that_fails_or_does_not_fit_is_named() {
    let twins = Twins::new();
    let inputs = json!([{"name": "image", "role": "rgb"}, {"name": "trust", "role": "trust"}]);
    let (_a, broken) = model("broken", &doubles::nan_if_doubtful(), json!({"inputs": inputs}));
    let models = [broken];
    twins.measured_at(&[1.0], &twins.worn, None, &models).unwrap();
    let refused = twins.measured_at(&[1.0, 5.0], &twins.worn, None, &models).unwrap_err();
    assert!(matches!(refused, ReportError::Repair { .. }), "{refused}");
    assert!(refused.to_string().contains("\"broken\" failed on an image of the camera"));
    let fixed = json!({"size": {"fixed": [64, 64], "fit": "pad"}});
    let (_b, small) = model("small", &doubles::identity(), fixed);
    let refused = twins.measured(&twins.worn, None, &[small]).unwrap_err();
    assert!(refused.to_string().contains("\"small\" cannot be used: camera"), "{refused}");
}
