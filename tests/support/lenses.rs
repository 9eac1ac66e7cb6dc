//! A camera of every model.

use glam::DVec2;
use wildcity::geometry::Camera;
use wildcity::geometry::camera::{
    Bivariate, FTheta, Fisheye, Lens, OpenCv, Pinhole, Reference, Windshield, WindshieldReference,
};

/// A camera of each model at moderate distortion, 160 x 100 px, and one bent windshield.
pub(crate) fn lenses() -> Vec<(&'static str, Camera)> {
    let ideal = Camera::ideal(160, 100, Pinhole { fx: 90.0, fy: 92.0, cx: 79.0, cy: 51.0 });
    let with = |lens| Camera { lens, ..ideal };
    let opencv = OpenCv::new(
        [-0.12, 0.03, -0.002, 0.01, 0.002, 0.0005],
        [0.0015, -0.001],
        [0.001, -0.0005, -0.0008, 0.0004],
    );
    let ftheta = |reference, polynomial| {
        let lens = FTheta::new(reference, polynomial, [1.01, 0.002, -0.003], 1.35);
        let DVec2 { x: fx, y: fy } = lens.focal_px();
        Camera { pinhole: Pinhole { fx, fy, ..ideal.pinhole }, ..with(Lens::FTheta(lens)) }
    };
    let windshield = Windshield::new(
        WindshieldReference::Forward,
        Bivariate::new("horizontal", &[-0.0035, 1.0016, 0.00005, -0.0028, 0.0015, 0.002]).unwrap(),
        Bivariate::new("vertical", &[0.005, 0.002, 0.0018, 1.0137, -0.0001, 0.02]).unwrap(),
    );
    vec![
        ("opencv", with(Lens::opencv(opencv))),
        ("fisheye", with(Lens::Fisheye(Fisheye::new([-0.03, -0.005, -0.0008, 0.001], None)))),
        ("f-theta", ftheta(Reference::AngleToPixel, [0.0, 85.0, -1.8, 4.8, -7.7, 2.7])),
        (
            "f-theta by pixels",
            ftheta(Reference::PixelToAngle, [0.0, 1.0 / 85.0, 3e-6, -9e-8, 2e-9, -8e-12]),
        ),
        ("pinhole behind a windshield", Camera { windshield: Some(windshield), ..ideal }),
        (
            "fisheye behind a windshield",
            Camera {
                windshield: Some(windshield),
                ..with(Lens::Fisheye(Fisheye::new([0.02, 0.01, 0.005, 0.002], Some(1.3))))
            },
        ),
    ]
}
