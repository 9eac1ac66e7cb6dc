//! Camera models on their own: there and back, by formulas written another way, and what is refused.

use glam::{DVec2, DVec3};
use wildcity::geometry::camera::{
    Bivariate, FTheta, Field, Fisheye, Lens, OpenCv, Pinhole, Reference, Windshield,
    WindshieldReference,
};
use wildcity::geometry::{Camera, CameraError};

use crate::lenses::lenses;

#[test]
fn every_pixel_comes_back_to_where_it_was() {
    for (name, camera) in lenses() {
        assert_eq!(camera.check(), Ok(()), "{name}");
        let mut seen = 0;
        for row in 0..camera.height_px {
            for column in 0..camera.width_px {
                let at_px = DVec2::new(f64::from(column), f64::from(row)) + 0.5;
                let Some(direction) = camera.unproject(at_px) else { continue };
                assert!((direction.length() - 1.0).abs() < 1e-12, "{name}: {direction}");
                for distance_m in [0.01, 1.0, 1e5] {
                    let back_px = camera.project(distance_m * direction).expect(name);
                    let off_px = back_px.distance(at_px);
                    assert!(off_px < 1e-8, "{name} at {at_px}: {off_px:e} px off");
                }
                let beyond_px = camera.project_beyond(direction);
                assert!(beyond_px.distance(at_px) < 1e-8, "{name} at {at_px}, continued");
                seen += 1;
            }
        }
        assert!(seen > 15_000, "{name} sees {seen} pixels");
    }
}

#[test]
fn each_model_is_its_formula() {
    let point = DVec3::new(0.7, -0.4, 2.0);
    for (name, camera) in lenses() {
        let Pinhole { fx, fy, cx, cy } = camera.pinhole;
        let (x, y) = (point.x / point.z, point.y / point.z);
        let (r2, theta) = (x * x + y * y, x.hypot(y).atan());
        let at_px = match camera.lens {
            _ if camera.windshield.is_some() => continue,
            Lens::OpenCv(lens) => {
                let ([k1, k2, k3, k4, k5, k6], [p1, p2], [s1, s2, s3, s4]) =
                    (lens.k(), lens.p(), lens.s());
                let icd = (1.0 + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3))
                    / (1.0 + k4 * r2 + k5 * r2.powi(2) + k6 * r2.powi(3));
                let u = x * icd + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
                let v = y * icd + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
                let (prism_u, prism_v) = (s1 * r2 + s2 * r2 * r2, s3 * r2 + s4 * r2 * r2);
                DVec2::new(fx * (u + prism_u) + cx, fy * (v + prism_v) + cy)
            }
            Lens::Fisheye(lens) => {
                let [k1, k2, k3, k4] = lens.k();
                let r = theta
                    + k1 * theta.powi(3)
                    + k2 * theta.powi(5)
                    + k3 * theta.powi(7)
                    + k4 * theta.powi(9);
                DVec2::new(fx * r * x / r2.sqrt() + cx, fy * r * y / r2.sqrt() + cy)
            }
            Lens::FTheta(lens) => {
                let polynomial =
                    |t: f64| (0..6).map(|i| lens.polynomial()[i] * t.powi(i as i32)).sum::<f64>();
                let radius_px = match lens.reference() {
                    Reference::AngleToPixel => polynomial(theta),
                    Reference::PixelToAngle => {
                        let (mut low, mut high) = (0.0, 200.0);
                        for _ in 0..100 {
                            let middle = 0.5 * (low + high);
                            let ends =
                                if polynomial(middle) < theta { &mut low } else { &mut high };
                            *ends = middle;
                        }
                        low
                    }
                };
                let [c, d, e] = lens.linear_cde();
                let (u, v) = (radius_px * x / r2.sqrt(), radius_px * y / r2.sqrt());
                DVec2::new(c * u + d * v + cx, e * u + v + cy)
            }
            Lens::Pinhole => DVec2::new(fx * x + cx, fy * y + cy),
        };
        let projected_px = camera.project(point).expect(name);
        assert!(projected_px.distance(at_px) < 1e-9, "{name}: {projected_px}, not {at_px}");
    }
}

#[test]
fn a_windshield_turns_rays_as_its_polynomials_say_and_back() {
    let camera = lenses()[4].1;
    let windshield = camera.windshield.unwrap();
    let point = DVec3::new(0.7, -0.4, 2.0).normalize();
    let (phi, theta) = (point.x.asin(), point.y.asin());
    let [h, v] = [windshield.horizontal(), windshield.vertical()].map(|polynomial| {
        let c = polynomial.coefficients();
        c[0] + c[1] * phi + c[2] * phi * phi + (c[3] + c[4] * phi) * theta + c[5] * theta * theta
    });
    let (x, y) = (h.sin(), v.sin());
    let inside = DVec3::new(x, y, (1.0 - x * x - y * y).sqrt());
    let without = Camera { windshield: None, ..camera };
    let off_px = camera.project(point).unwrap().distance(without.project(inside).unwrap());
    assert!(off_px < 1e-9, "{off_px:e} px");
    assert!(camera.project(point).unwrap().distance(without.project(point).unwrap()) > 0.1);

    // The same polynomials the other way undo what these do.
    let backward = Windshield::new(
        WindshieldReference::Backward,
        *windshield.horizontal(),
        *windshield.vertical(),
    );
    let other = Camera { windshield: Some(backward), ..camera };
    let at_px = without.project(point).unwrap();
    let off_px = without.project(other.unproject(at_px).unwrap()).unwrap();
    assert!(off_px.distance(camera.project(point).unwrap()) < 1e-9);
}

#[test]
fn another_size_or_a_part_shows_the_same_directions() {
    for (name, camera) in lenses() {
        let point = DVec3::new(-0.3, 0.2, 1.4);
        let at_px = camera.project(point).unwrap();
        let half = camera.scaled(80, 25).unwrap();
        let scaled_px = half.project(point).unwrap();
        assert!(scaled_px.distance(at_px * DVec2::new(0.5, 0.25)) < 1e-9, "{name}: {scaled_px}");
        let part = camera.cropped([20, 10], [100, 60]).unwrap();
        let part_px = part.project(point).unwrap();
        assert!(part_px.distance(at_px - DVec2::new(20.0, 10.0)) < 1e-9, "{name}: {part_px}");
        assert!(matches!(camera.cropped([100, 10], [100, 60]), Err(CameraError::Crop { .. })));
        assert!(matches!(camera.scaled(0, 10), Err(CameraError::Size { .. })));
    }
}

#[test]
fn zero_distortion_is_a_pinhole_by_another_name() {
    assert_eq!(Lens::opencv(OpenCv::new([0.0; 6], [0.0; 2], [0.0; 4])), Lens::Pinhole);
}

#[test]
fn a_lens_ends_before_it_folds_back() {
    let wide = Pinhole { fx: 40.0, fy: 40.0, cx: 80.0, cy: 50.0 };
    let ideal = Camera::ideal(160, 100, wide);
    // θ - θ³/6 turns at √2 rad; x (1 - 0.3 r²) at r = 1.05, and is 0.8 at 0.82.
    let fisheye = Fisheye::new([-1.0 / 6.0, 0.0, 0.0, 0.0], None);
    let fisheye = Camera { lens: Lens::Fisheye(fisheye), ..ideal };
    assert!((fisheye.limit_rad() - 1.4).abs() < 1e-12, "{}", fisheye.limit_rad());
    let opencv = OpenCv::new([-0.3, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2], [0.0; 4]);
    let opencv = Camera { lens: Lens::opencv(opencv), ..ideal };
    assert!((opencv.limit_rad().tan() - (2.0_f64 / 3.0).sqrt()).abs() < 1e-9);
    for camera in [fisheye, opencv] {
        assert_eq!(camera.check(), Ok(()));
        let (sin, cos) = (camera.limit_rad() + 1e-3).sin_cos();
        assert_eq!(camera.project(DVec3::new(sin, 0.0, cos)), None, "beyond");
        let (sin, cos) = (camera.limit_rad() - 1e-3).sin_cos();
        assert!(camera.project(DVec3::new(sin, 0.0, cos)).is_some(), "within");
        assert_eq!(camera.project(DVec3::NEG_Z), None, "behind");
        assert_eq!(camera.unproject(DVec2::new(1.0, 1.0)), None, "the corner");
        let field = Field::of(&camera).expect("a part of the image");
        for (row, [first, end]) in field.columns.iter().enumerate() {
            for column in 0..camera.width_px {
                let at_px = DVec2::new(f64::from(column) + 0.5, row as f64 + 0.5);
                let seen = (*first..*end).contains(&column);
                assert_eq!(seen, camera.unproject(at_px).is_some(), "{at_px}");
            }
        }
        let share = field.share(&camera);
        assert!((0.1..0.8).contains(&share), "{share}");
    }
    assert_eq!(Field::of(&ideal), None);
}

#[test]
fn absurd_coefficients_are_refused_with_the_reason() {
    let ideal = Camera::ideal(160, 100, Pinhole { fx: 90.0, fy: 90.0, cx: 80.0, cy: 50.0 });
    let refused = |lens| {
        let error = Camera { lens, ..ideal }.check().unwrap_err();
        assert!(error.to_string().contains(error.field()), "{error}");
        (error.field(), error.to_string())
    };
    let opencv = |k| Lens::opencv(OpenCv::new(k, [0.0; 2], [0.0; 4]));
    let fisheye = |k, most| Lens::Fisheye(Fisheye::new(k, most));
    let ftheta =
        |polynomial, cde| Lens::FTheta(FTheta::new(Reference::AngleToPixel, polynomial, cde, 1.2));
    for (lens, field, reason) in [
        (opencv([f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0]), "lens.k", "finite"),
        (opencv([1e12, 0.0, 0.0, 0.0, 0.0, 0.0]), "lens.k", "1e9"),
        (opencv([-1e8, 0.0, 0.0, 0.0, 0.0, 0.0]), "lens", "folds back"),
        (opencv([-50.0, 0.0, 0.0, 0.0, 0.0, 0.0]), "lens", "an eighth"),
        (fisheye([-1e9, 0.0, 0.0, 0.0], None), "lens", "folds back"),
        (fisheye([0.0; 4], Some(3.1)), "lens.max_angle", "2.8"),
        (fisheye([0.0; 4], Some(f64::NAN)), "lens.max_angle", "2.8"),
        (ftheta([1.0, 90.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), "lens.polynomial[0]", "is 0"),
        (ftheta([0.0, -90.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), "lens", "folds back"),
        (ftheta([0.0, 90.0, 0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0]), "lens.linear_cde", "0.001"),
        (ftheta([0.0, 80.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), "fx", "leave fx and fy out"),
    ] {
        let (named, why) = refused(lens);
        assert_eq!(named, field, "{why}");
        assert!(why.contains(reason), "{why}");
    }
    let bends = |c: &[f64]| {
        let straight = Bivariate::new("vertical", &[0.0, 0.0, 1.0]).unwrap();
        let bent = Bivariate::new("horizontal", c).unwrap();
        let windshield = Windshield::new(WindshieldReference::Forward, bent, straight);
        Camera { windshield: Some(windshield), ..ideal }.check()
    };
    assert_eq!(bends(&[0.0, 1.0, 0.0]), Ok(()));
    assert!(bends(&[0.5, 1.0, 0.0]).unwrap_err().to_string().contains("0.2 rad"));
    assert!(bends(&[0.0, 1.3, 1.0]).is_err());
    assert!(bends(&[f64::INFINITY, 1.0, 0.0]).is_err());
    assert!(Bivariate::new("horizontal", &[0.0; 4]).is_err());
}
