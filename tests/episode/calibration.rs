//! Calibrations in MCAP files: how far they are off the lenses, by the numbers that the file gives.

use std::io::Cursor;

use glam::{DVec2, DVec3};
use prost::Message as _;
use serde_json::Value;

use wildcity_episode::export;
use wildcity_scene::Rig;
use wildcity_scene::geometry::camera::{Fisheye, Lens, OpenCv, Pinhole};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::rig::RigCamera;

use crate::written::Made;

#[derive(Clone, PartialEq, prost::Message)]
struct Calibration {
    #[prost(string, tag = "4")]
    distortion_model: String,
    #[prost(double, repeated, tag = "5")]
    d: Vec<f64>,
    #[prost(double, repeated, tag = "6")]
    k: Vec<f64>,
}

/// The calibrations of a rig in an exported file, and how far the file says that each is off.
fn calibrations(rig: &Rig) -> Vec<(Calibration, f64)> {
    let episode = Made { steps: 1, ..Made::default() }.read();
    let mut bytes = Cursor::new(Vec::new());
    let exported = export(&episode, Some(rig), &mut bytes).unwrap();
    let bytes = bytes.into_inner();
    let messages: Vec<_> =
        mcap::MessageStream::new(&bytes).unwrap().map(|message| message.unwrap()).collect();
    let of = |topic: &str| {
        let found = messages.iter().find(|message| message.channel.topic == topic);
        found.unwrap_or_else(|| panic!("no {topic}")).data.to_vec()
    };
    let about: Value = serde_json::from_slice(&of("/wildcity/episode")).unwrap();
    let errors_px: Vec<f64> = about["calibrations"]
        .as_array()
        .unwrap()
        .iter()
        .map(|calibration| calibration["error_px"].as_f64().unwrap())
        .collect();
    assert_eq!(errors_px.iter().copied().fold(0.0, f64::max), exported.calibration_error_px);
    let read = |k: usize| Calibration::decode(&*of(&format!("/camera/{k}/calibration"))).unwrap();
    (0..rig.cameras.len()).map(|k| (read(k), errors_px[k])).collect()
}

fn camera(lens: Lens) -> RigCamera {
    let pinhole = Pinhole { fx: 410.0, fy: 400.0, cx: 322.0, cy: 239.0 };
    let camera = Camera { lens, ..Camera::from_pinhole(640, 480, pinhole) };
    RigCamera::new("one", camera, Pose::IDENTITY)
}

fn alone(lens: Lens) -> (Calibration, f64) {
    let rig = Rig::new("one", vec![camera(lens)]);
    calibrations(&rig).remove(0)
}

#[test]
fn opencvs_lenses_are_exact() {
    let (pinhole, error_px) = alone(Lens::Pinhole);
    assert_eq!((pinhole.distortion_model.as_str(), pinhole.d), ("plumb_bob", vec![0.0; 5]));
    assert!(error_px < 1e-9, "{error_px}");
    // OpenCV counts from the middle of the first pixel.
    assert_eq!(pinhole.k, [410.0, 0.0, 321.5, 0.0, 400.0, 238.5, 0.0, 0.0, 1.0]);

    let k = [-0.11, 0.02, -0.001, 0.01, 0.003, 0.0002];
    let (opencv, error_px) = alone(Lens::OpenCv(OpenCv::new(k, [1e-3, -2e-3], [0.0; 4])));
    assert_eq!(opencv.distortion_model, "rational_polynomial");
    assert_eq!(opencv.d, [-0.11, 0.02, 1e-3, -2e-3, -0.001, 0.01, 0.003, 0.0002]);
    assert!(error_px < 1e-6, "{error_px}");

    let k = [-0.02, 0.003, -0.0004, 0.00001];
    let (fisheye, error_px) = alone(Lens::Fisheye(Fisheye::new(k, None)));
    assert_eq!((fisheye.distortion_model.as_str(), &fisheye.d[..]), ("kannala_brandt", &k[..]));
    assert!(error_px < 1e-6, "{error_px}");

    // A thin prism is no part of the models that Foxglove knows.
    let prism = OpenCv::new([0.0; 6], [0.0; 2], [0.01, 0.0, 0.0, 0.0]);
    let (_, error_px) = alone(Lens::OpenCv(prism));
    assert!(error_px > 0.5, "{error_px}");
}

/// The f-theta lenses of a real vehicle, at 1920x1080, as OpenCV's fisheye.
#[test]
fn an_f_theta_lens_is_described_to_a_fraction_of_a_pixel() {
    let path = crate::root::root().join("scenes/rigs/alpamayo1.json");
    let rig: Rig = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    let found = calibrations(&rig);
    assert_eq!(found.len(), 4);
    for (camera, (calibration, error_px)) in rig.cameras.iter().zip(found) {
        assert_eq!(calibration.distortion_model, "kannala_brandt");
        if camera.camera.windshield.is_some() {
            // Foxglove has no windshields, and the file says what that costs.
            assert!((10.0..40.0).contains(&error_px), "{}: {error_px}", camera.name);
            continue;
        }
        assert!(error_px < 0.3, "{}: {error_px}", camera.name);
        // The numbers of the message, by the formula of OpenCV's documentation.
        let [k1, k2, k3, k4] = calibration.d[..] else { panic!("{calibration:?}") };
        for direction in [DVec3::new(0.3, -0.1, 1.0), DVec3::new(-1.2, 0.4, 1.0)] {
            let Some(at_px) = camera.camera.project(direction) else { continue };
            let radius = direction.truncate().length();
            let angle = radius.atan();
            let [a2, a4] = [angle.powi(2), angle.powi(4)];
            let distorted = angle * (1.0 + k1 * a2 + k2 * a4 + k3 * a2 * a4 + k4 * a4 * a4);
            let plane = direction.truncate() * (distorted / radius);
            let k = &calibration.k;
            let projected_px = DVec2::new(k[0] * plane.x + k[2], k[4] * plane.y + k[5]) + 0.5;
            assert!(projected_px.distance(at_px) < 0.3, "{}: {projected_px} {at_px}", camera.name);
        }
    }
}
