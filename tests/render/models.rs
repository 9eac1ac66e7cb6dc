//! Camera models by themselves: projection and its inverse, comparison with formulas written
//! independently, and rejected coefficients.

use glam::{DVec2, DVec3};
use wildcity_render::compare::gaussians::{GaussianSpec, scene_from_specs};
use wildcity_render::compare::reprojection::centroid;
use wildcity_render::reference;
use wildcity_render::{Backend, View};
use wildcity_scene::geometry::camera::{
    Bivariate, FTheta, FThetaReference, FieldMask, Fisheye, Lens, OpenCv, Pinhole, Windshield,
    WindshieldReference,
};
use wildcity_scene::geometry::{Camera, CameraError, Pose};
use wildcity_scene::{Rays, RenderProfile, Rig};

use crate::images::{cpu, psnr, render_one};
use crate::lenses::{lenses, street_scene};
use crate::scene_files::Random;

#[test]
fn projection_inverts_unprojection_at_every_pixel() {
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
                let beyond_px = camera.project_extrapolated(direction);
                assert!(beyond_px.distance(at_px) < 1e-8, "{name} at {at_px}, continued");
                seen += 1;
            }
        }
        assert!(seen > 15_000, "{name} sees {seen} pixels");
    }
}

#[test]
fn each_model_matches_its_formula() {
    let point = DVec3::new(0.7, -0.4, 2.0);
    for (name, camera) in lenses() {
        let Pinhole { fx, fy, cx, cy } = camera.pinhole;
        let x = point.x / point.z;
        let y = point.y / point.z;
        let r2 = x * x + y * y;
        let theta = x.hypot(y).atan();
        let at_px = match camera.lens {
            _ if camera.windshield.is_some() => continue,
            Lens::OpenCv(lens) => {
                let [k1, k2, k3, k4, k5, k6] = lens.k();
                let [p1, p2] = lens.p();
                let [s1, s2, s3, s4] = lens.s();
                let icd = (1.0 + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3))
                    / (1.0 + k4 * r2 + k5 * r2.powi(2) + k6 * r2.powi(3));
                let u = x * icd + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
                let v = y * icd + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
                let prism_u = s1 * r2 + s2 * r2 * r2;
                let prism_v = s3 * r2 + s4 * r2 * r2;
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
                    FThetaReference::AngleToPixel => polynomial(theta),
                    FThetaReference::PixelToAngle => {
                        let mut low = 0.0;
                        let mut high = 200.0;
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
                let u = radius_px * x / r2.sqrt();
                let v = radius_px * y / r2.sqrt();
                DVec2::new(c * u + d * v + cx, e * u + v + cy)
            }
            Lens::Pinhole => DVec2::new(fx * x + cx, fy * y + cy),
        };
        let projected_px = camera.project(point).expect(name);
        assert!(projected_px.distance(at_px) < 1e-9, "{name}: {projected_px}, not {at_px}");
    }
}

#[test]
fn a_windshield_refracts_by_its_polynomials_and_back() {
    let camera = lenses()[4].1;
    let windshield = camera.windshield.unwrap();
    let point = DVec3::new(0.7, -0.4, 2.0).normalize();
    let phi = point.x.asin();
    let theta = point.y.asin();
    let [h, v] = [windshield.horizontal(), windshield.vertical()].map(|polynomial| {
        let c = polynomial.coefficients();
        c[0] + c[1] * phi + c[2] * phi * phi + (c[3] + c[4] * phi) * theta + c[5] * theta * theta
    });
    let x = h.sin();
    let y = v.sin();
    let inside = DVec3::new(x, y, (1.0 - x * x - y * y).sqrt());
    let without = Camera { windshield: None, ..camera };
    let off_px = camera.project(point).unwrap().distance(without.project(inside).unwrap());
    assert!(off_px < 1e-9, "{off_px:e} px");
    assert!(camera.project(point).unwrap().distance(without.project(point).unwrap()) > 0.1);

    // The same polynomials in the other direction undo the refraction.
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
fn zero_distortion_is_a_pinhole() {
    assert_eq!(Lens::opencv(OpenCv::new([0.0; 6], [0.0; 2], [0.0; 4])), Lens::Pinhole);
}

#[test]
fn a_lens_ends_before_it_folds_back() {
    let wide = Pinhole { fx: 40.0, fy: 40.0, cx: 80.0, cy: 50.0 };
    let ideal = Camera::from_pinhole(160, 100, wide);
    // θ - θ³/6 begins to fall at √2 rad. x (1 - 0.3 r²) begins to fall at r = 1.05; its field ends
    // at 0.82, where the factor is 0.8.
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
        let field = FieldMask::from_camera(&camera).expect("a part of the image");
        for (row, [first, end]) in field.columns.iter().enumerate() {
            for column in 0..camera.width_px {
                let at_px = DVec2::new(f64::from(column) + 0.5, row as f64 + 0.5);
                let seen = (*first..*end).contains(&column);
                assert_eq!(seen, camera.unproject(at_px).is_some(), "{at_px}");
            }
        }
        let share = field.visible_share(&camera);
        assert!((0.1..0.8).contains(&share), "{share}");
    }
    assert_eq!(FieldMask::from_camera(&ideal), None);
}

#[test]
fn absurd_coefficients_are_refused_with_the_reason() {
    let ideal = Camera::from_pinhole(160, 100, Pinhole { fx: 90.0, fy: 90.0, cx: 80.0, cy: 50.0 });
    let refused = |lens| {
        let error = Camera { lens, ..ideal }.check().unwrap_err();
        assert!(error.to_string().contains(error.field()), "{error}");
        (error.field(), error.to_string())
    };
    let opencv = |k| Lens::opencv(OpenCv::new(k, [0.0; 2], [0.0; 4]));
    let skewed = |p, s| Lens::opencv(OpenCv::new([0.0; 6], p, s));
    let fisheye = |k, most| Lens::Fisheye(Fisheye::new(k, most));
    let ftheta = |polynomial, cde| {
        Lens::FTheta(FTheta::new(FThetaReference::AngleToPixel, polynomial, cde, 1.2))
    };
    for (lens, field, reason) in [
        (opencv([f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0]), "lens.k", "finite"),
        (opencv([1e12, 0.0, 0.0, 0.0, 0.0, 0.0]), "lens.k", "1e9"),
        (opencv([-1e8, 0.0, 0.0, 0.0, 0.0, 0.0]), "lens", "folds back"),
        (opencv([-50.0, 0.0, 0.0, 0.0, 0.0, 0.0]), "lens", "an eighth"),
        (skewed([f64::NAN, 0.0], [0.0; 4]), "lens.p", "finite"),
        (skewed([3.0, 0.0], [0.0; 4]), "lens.p", "an eighth"),
        (skewed([0.0, 1e8], [0.0; 4]), "lens.p", "folds back"),
        (skewed([0.001, 0.0], [0.0, 0.0, -9.0, 0.0]), "lens.s", "an eighth"),
        (skewed([0.0; 2], [0.0, 1e9, 0.0, 0.0]), "lens.s", "folds back"),
        (fisheye([-1e9, 0.0, 0.0, 0.0], None), "lens", "folds back"),
        (fisheye([0.0; 4], Some(3.1)), "lens.max_angle", "2.8"),
        (fisheye([0.0; 4], Some(f64::NAN)), "lens.max_angle", "2.8"),
        (ftheta([1.0, 90.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), "lens.polynomial[0]", "is 0"),
        (ftheta([0.0, -90.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), "lens", "folds back"),
        (ftheta([0.0, 90.0, 0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0]), "lens.linear_cde", "0.001"),
        (ftheta([0.0, 80.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), "fx", "omit fx and fy"),
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

/// An OpenCV lens with its axis in the middle of an image.
fn distorted([width, height]: [u32; 2], f: f64, lens: OpenCv) -> Camera {
    let pinhole = Pinhole { fx: f, fy: f, cx: f64::from(width) / 2.0, cy: f64::from(height) / 2.0 };
    Camera { lens: Lens::opencv(lens), ..Camera::from_pinhole(width, height, pinhole) }
}

/// A direction, by its components across and along the axis, and its azimuth.
fn ray([off_axis, along]: [f64; 2], azimuth_rad: f64) -> DVec3 {
    DVec3::new(off_axis * azimuth_rad.cos(), off_axis * azimuth_rad.sin(), along)
}

#[test]
fn opencv_lenses_neither_fold_nor_lose_what_they_see() {
    let mut random = Random(5);
    let mut within = |most: f64| most * (2.0 * random.unit() - 1.0);
    let mut accepted = 0;
    for set in 0..600 {
        let size = |of: usize, sizes: [f64; 4]| sizes[set / of % 4];
        let radial = size(1, [0.01, 0.1, 1.0, 10.0]);
        let tangential = size(4, [0.0, 1e-3, 0.02, 0.3]);
        let prism = size(16, [0.0, 1e-3, 0.02, 0.3]);
        let k = [0; 6].map(|_| within(radial));
        let rational = if set % 3 == 0 { 0.0 } else { 1.0 };
        let k = [k[0], k[1], k[2], rational * k[3], rational * k[4], rational * k[5]];
        let lens =
            OpenCv::new(k, [0; 2].map(|_| within(tangential)), [0; 4].map(|_| within(prism)));
        let camera = distorted([300, 300], 100.0, lens);
        let limit = lens.limit_slope();
        if limit < 1e-3 {
            continue;
        }
        accepted += 1;
        let mut before: Option<(DVec3, DVec2)> = None;
        for i in 0..100 {
            // At the limit, close to it, and anywhere within it.
            let share = [1.0 - 1e-9, 1.0 - 1e-3 * within(1.0).abs(), within(1.0).abs()][i % 3];
            let slope = ray([share * limit, 1.0], within(3.2));
            let at_px = camera.project(slope).unwrap();
            let back = camera.unproject(at_px).unwrap_or_else(|| panic!("{lens:?} lost {slope}"));
            let off = back.distance(slope.normalize());
            assert!(off < 1e-9, "{lens:?}: {slope} came back off by {off:e}");
            // The difference of two images has a positive component along the difference of the
            // directions.
            if let Some((other, other_px)) = before {
                let apart = (slope - other).truncate();
                assert!(apart.dot(at_px - other_px) > 0.0, "{lens:?} mirrors {slope}, {other}");
            }
            let h = 1e-6 * limit;
            let [x, y] = [DVec3::X, DVec3::Y].map(|axis| {
                let inwards = slope - 2.0 * h * slope.truncate().normalize().extend(0.0);
                camera.project(inwards + h * axis).unwrap() - camera.project(inwards).unwrap()
            });
            assert!(x.perp_dot(y) > 0.0, "{lens:?} mirrors around {slope}");
            before = Some((slope, at_px));
        }
    }
    assert!(accepted > 500, "{accepted} of 600");
}

/// The lower PSNR of the two backends against exact rays.
fn least_db(camera: Camera) -> f64 {
    assert_eq!(camera.check(), Ok(()));
    let (street, pose) = street_scene();
    let view = View::new(camera, pose);
    let exact = RenderProfile { rays: Rays::Exact, ..RenderProfile::default() };
    let truth = render_one(&reference::Reference, &street, &exact, view);
    let backends = [&reference::Reference as &dyn Backend, &cpu()];
    let db = backends.map(|backend| {
        let drawn = render_one(backend, &street, &RenderProfile::default(), view);
        psnr(&drawn.rgba, &truth.rgba)
    });
    db[0].min(db[1])
}

#[test]
fn a_pole_beyond_the_image_does_not_disturb_it() {
    // 1 + k4 r² + k5 r⁴ + k6 r⁶ is 0 at 1.22; the image's corner is at 0.83.
    let pole = OpenCv::new([-4.9, 17.6, -9.5, -5.0, 17.7, -9.9], [0.0; 2], [0.0; 4]);
    let db = least_db(distorted([160, 90], 110.0, pole));
    eprintln!("a pole beyond the image: {db:.1} dB against every pixel's ray");
    assert!(db >= 45.0, "{db:.1} dB");
    // Coefficients like those of an Azure Kinect: without a pole the lens keeps its field.
    let k = [0.462, -2.41, 1.42, 0.341, -2.24, 1.35];
    let kinect = OpenCv::new(k, [5e-4, -2e-4], [0.0; 4]);
    assert!(kinect.limit_slope() > 7.9, "{}", kinect.limit_slope());
    let db = least_db(distorted([160, 90], 75.0, kinect));
    eprintln!("a rational lens: {db:.1} dB against every pixel's ray");
    assert!(db >= 45.0, "{db:.1} dB");
}

#[test]
fn tangential_distortion_mirrors_nothing_into_the_image() {
    let lens = OpenCv::new([0.0; 6], [0.3, 0.0], [0.0; 4]);
    let camera = distorted([160, 100], 50.0, lens);
    assert_eq!(camera.check(), Ok(()));
    let fine = RenderProfile { alpha_cut: 1e-5, ..RenderProfile::default() };
    for backend in [&reference::Reference as &dyn Backend, &cpu()] {
        let row_of = |slope: f64| {
            let ball = GaussianSpec {
                mean_m: DVec3::new(0.0, 2.0 * slope, 2.0),
                sigma_m: DVec3::splat(0.003),
                ..GaussianSpec::default()
            };
            let view = View::new(camera, Pose::IDENTITY);
            let image = render_one(backend, &scene_from_specs(&[ball]), &fine, view);
            let middle_px = camera.size_px() / 2.0;
            centroid(&image.opacity, [160, 100], middle_px, f64::INFINITY).map(|at_px| at_px.y)
        };
        let within = row_of(-0.3).expect("within the field");
        let expected = 50.0 + 50.0 * (-0.3 + 0.3 * 3.0 * 0.09);
        assert!((within - expected).abs() < 0.1, "{within}, not {expected}");
        for beyond in [-0.6, -0.8, -1.0, -2.0] {
            let row = row_of(beyond).unwrap_or(0.0);
            assert!(row < within - 1.0, "{}: {beyond} at row {row}", backend.name());
        }
    }
}

#[test]
fn an_image_covers_all_of_the_field() {
    for (f, k) in [(100.0, [0.75, -0.27, -0.096]), (40.0, [0.2, 0.05, -0.01])] {
        let lens = OpenCv::new([k[0], k[1], k[2], 0.0, 0.0, 0.0], [0.0; 2], [0.0; 4]);
        let camera = distorted([300, 300], f, lens);
        assert_eq!(camera.check(), Ok(()));
        let edge_px = f * {
            let r2 = lens.limit_slope().powi(2);
            lens.limit_slope() * (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2])))
        };
        let view = View::new(camera, Pose::IDENTITY);
        for backend in [&reference::Reference as &dyn Backend, &cpu()] {
            let wall = GaussianSpec {
                sigma_m: DVec3::splat(50.0),
                mean_m: DVec3::Z,
                ..GaussianSpec::default()
            };
            let image =
                render_one(backend, &scene_from_specs(&[wall]), &RenderProfile::default(), view);
            for (pixel, &opacity) in image.opacity.iter().enumerate() {
                let from_axis = DVec2::new((pixel % 300) as f64, (pixel / 300) as f64) - 149.5;
                let seen = from_axis.length() < edge_px;
                assert_eq!(opacity > 0.0, seen, "{} at {from_axis}", backend.name());
            }
        }
    }
}

/// A fisheye behind a windshield, with a largest angle off its axis.
fn behind_windshield(windshield: Windshield, max_angle_rad: f64) -> Camera {
    let lens = Lens::Fisheye(Fisheye::new([0.0; 4], Some(max_angle_rad)));
    let pinhole = Pinhole { fx: 55.0, fy: 55.0, cx: 100.0, cy: 100.0 };
    Camera { lens, windshield: Some(windshield), ..Camera::from_pinhole(200, 200, pinhole) }
}

#[test]
fn a_windshield_that_folds_where_it_fades_is_refused() {
    let straight = Bivariate::new("vertical", &[0.0, 0.0, 1.0]).unwrap();
    let turned = Bivariate::new("horizontal", &[0.15, 1.0, 0.0]).unwrap();
    let windshield = Windshield::new(WindshieldReference::Forward, turned, straight);
    let refused = behind_windshield(windshield, 1.7).check().unwrap_err();
    assert_eq!(refused.field(), "windshield");
    assert!(refused.to_string().contains("87 degrees"), "{refused}");
    // In front of a lens with a smaller field the same windshield is accepted.
    assert_eq!(behind_windshield(windshield, 0.9).check(), Ok(()));
    for name in Rig::preset_names() {
        assert_eq!(Rig::preset(name).unwrap().check(), Ok(()), "{name}");
    }
}

#[test]
fn windshields_neither_fold_nor_lose_rays() {
    let mut random = Random(9);
    let mut within = |most: f64| most * (2.0 * random.unit() - 1.0);
    let mut accepted = 0;
    let mut fading = 0;
    for set in 0..240 {
        let most = [1e-3, 0.01, 0.05, 0.1][set % 4];
        let limit_rad = [1.0, 1.3, 1.5, 1.7][set / 4 % 4];
        let [h, v] = [1, 3].map(|own| {
            let mut c = [0; 6].map(|_| within(most));
            c[own] += 1.0;
            Bivariate::new("windshield", &c).unwrap()
        });
        let way = [WindshieldReference::Forward, WindshieldReference::Backward][set / 16 % 2];
        let camera = behind_windshield(Windshield::new(way, h, v), limit_rad);
        if camera.check().is_err() {
            continue;
        }
        accepted += 1;
        fading += u32::from(limit_rad > 1.4);
        let bare = Camera { windshield: None, ..camera };
        for _ in 0..200 {
            let off_axis_rad = limit_rad * (1.0 - 1e-9) * within(1.0).abs();
            let (sin, cos) = off_axis_rad.sin_cos();
            let at_px = bare.project(ray([sin, cos], within(3.2))).unwrap();
            if (at_px - 100.0).abs().max_element() > 100.0 {
                continue;
            }
            let outside = camera.unproject(at_px).unwrap();
            let back_px = camera.project(outside).unwrap_or(DVec2::INFINITY);
            assert!(back_px.distance(at_px) < 1e-9, "{camera:?}: {at_px} came back {back_px}");
            let (right, down) = outside.any_orthonormal_pair();
            let [x, y] = [right, down].map(|across| {
                let beside = 1e-5 * across;
                camera.project_extrapolated(outside + beside)
                    - camera.project_extrapolated(outside - beside)
            });
            assert!(x.perp_dot(y) * outside.dot(right.cross(down)) > 0.0, "{camera:?}: {at_px}");
        }
    }
    assert!(accepted > 80 && fading > 20, "{accepted} accepted, {fading} with fading");
}
