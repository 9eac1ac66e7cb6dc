//! Gradients: `reference` against vectors that others computed and against its own differences, and
//! the fast backends against `reference`.

use std::ops::Range;

use glam::{DMat3, DQuat, DVec3};
use safetensors::SafeTensors;
use wildcity_render::gradient::{Differentiate, GaussianImages, Gradients};
use wildcity_render::reference::gradient::{Images, Source, SourceGradient, Sources};
use wildcity_render::reference::{Gaussian, Reference};
use wildcity_render::{Frame, View};
use wildcity_scene::chunk::{column, columns};
use wildcity_scene::geometry::camera::{Fisheye, Lens, Pinhole};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{RenderProfile, Scene};

use crate::data::real;
use crate::images::cpu;
use crate::streets::{street, turning_views};

const SIZE_PX: [u32; 2] = [64, 48];

/// The tensors of `gradients/vectors.safetensors`.
struct Vectors(Vec<u8>);

impl Vectors {
    fn read() -> Option<Self> {
        let path = real("gradients/vectors.safetensors")?;
        Some(Self(std::fs::read(path).expect("the vectors")))
    }

    fn values(&self, name: &str) -> Vec<f64> {
        let tensors = SafeTensors::deserialize(&self.0).expect("safetensors");
        let tensor = tensors.tensor(name).unwrap_or_else(|_| panic!("no tensor {name}"));
        match tensor.dtype() {
            safetensors::Dtype::F64 => {
                let bytes = tensor.data().as_chunks().0.iter();
                bytes.map(|&bytes| f64::from_le_bytes(bytes)).collect()
            }
            safetensors::Dtype::F32 => {
                let bytes = tensor.data().as_chunks().0.iter();
                bytes.map(|&bytes| f64::from(f32::from_le_bytes(bytes))).collect()
            }
            other => panic!("{name} is {other:?}"),
        }
    }

    fn points(&self, name: &str) -> Vec<DVec3> {
        self.values(name).as_chunks().0.iter().map(|&values| DVec3::from_array(values)).collect()
    }

    fn gaussians(&self) -> Vec<Source> {
        let quats = self.values("in.quats");
        let scales = self.points("in.log_scales");
        let logits = self.values("in.logits");
        let sh = self.points("in.sh");
        let gaussian = |(i, &mean_m): (usize, &DVec3)| {
            let [w, x, y, z] = [0, 1, 2, 3].map(|k| quats[4 * i + k]);
            let gaussian = Gaussian {
                mean_m,
                rotation: DQuat::from_xyzw(x, y, z, w),
                scale_m: scales[i].exp(),
                log2_opacity: -(1.0 + (-logits[i]).exp()).log2(),
                sh: std::array::from_fn(|k| sh[16 * i + k]),
            };
            Source { gaussian, view: 0, tint: DVec3::ONE }
        };
        self.points("in.means").iter().enumerate().map(gaussian).collect()
    }

    fn pose(&self, name: &str) -> Pose {
        let rows = self.values(name);
        let rotation =
            DMat3::from_cols_slice(&[0, 1, 2, 4, 5, 6, 8, 9, 10].map(|k| rows[k])).transpose();
        let position_m = DVec3::new(rows[3], rows[7], rows[11]);
        Pose { position_m, rotation: DQuat::from_mat3(&rotation).normalize() }
    }

    fn pinhole(&self) -> Camera {
        let k = self.values("K");
        let pinhole = Pinhole { fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
        Camera::from_pinhole(SIZE_PX[0], SIZE_PX[1], pinhole)
    }

    fn fisheye(&self) -> Camera {
        let c = self.values("fisheye.camera");
        let pinhole = Pinhole { fx: c[0], fy: c[1], cx: c[2], cy: c[3] };
        let lens = Lens::Fisheye(Fisheye::new([c[4], c[5], c[6], c[7]], None));
        Camera { lens, ..Camera::from_pinhole(SIZE_PX[0], SIZE_PX[1], pinhole) }
    }

    fn view(&self, camera: Camera) -> View {
        View::new(camera, self.pose("viewmat").inverse())
    }

    /// The derivatives of `v.rgb · rgb + v.alpha · alpha + v.depth · depth` by the Gaussians' images,
    /// where the colours are over the background.
    fn linear_loss(&self) -> Images {
        let background = DVec3::from_slice(&self.values("background"));
        let rgb = self.points("v.rgb");
        let opacity =
            self.values("v.alpha").into_iter().zip(&rgb).map(|(v, rgb)| v - rgb.dot(background));
        Images { opacity: opacity.collect(), depth_sum_m: self.values("v.depth"), rgb }
    }
}

/// The largest difference of some derivatives as a share of the largest one.
fn error(ours: &[f64], theirs: &[f64]) -> f64 {
    assert_eq!(ours.len(), theirs.len());
    let most = theirs.iter().fold(0.0, |most: f64, value| most.max(value.abs()));
    let off = ours.iter().zip(theirs).fold(0.0, |off: f64, (a, b)| off.max((a - b).abs()));
    off / most
}

/// Our derivatives in the parameters of the vectors, by their names.
fn by_name(sources: &[Source], gradients: &[SourceGradient]) -> Vec<(&'static str, Vec<f64>)> {
    let all = |values: &dyn Fn(&Source, &SourceGradient) -> Vec<f64>| {
        sources
            .iter()
            .zip(gradients)
            .flat_map(|(source, gradient)| values(source, gradient))
            .collect()
    };
    vec![
        ("means", all(&|_, by| by.geometry.mean_m.to_vec())),
        (
            "quats",
            all(&|source, by| {
                let length = source.gaussian.rotation.length();
                by.geometry.quat_wxyz.map(|value| value / length).to_vec()
            }),
        ),
        ("log_scales", all(&|_, by| by.geometry.ln_scale.to_vec())),
        (
            "logits",
            all(&|source, by| {
                let opacity = source.gaussian.log2_opacity.exp2();
                vec![by.geometry.log2_opacity * (1.0 - opacity) / std::f64::consts::LN_2]
            }),
        ),
        ("sh", all(&|_, by| by.sh.iter().flat_map(|c| c.to_array()).collect())),
    ]
}

/// Compares the derivatives of a linear loss with those of a case.
fn check_case(
    vectors: &Vectors,
    case: &str,
    view: View,
    profile: &RenderProfile,
    depth_is_z: bool,
) {
    let gaussians = vectors.gaussians();
    let sources = Sources { profile, gaussians, views: vec![view], depth_is_z };
    let decisions = sources.decisions();
    let loss = vectors.linear_loss();
    let (gradients, twist) = sources.gradients(&sources.splat_gradients(&decisions, &loss));
    let mut ours = by_name(&sources.gaussians, &gradients);
    ours.push(("twist", twist.to_array().to_vec()));
    let images = sources.images(&decisions);
    let background = images.opacity.iter().zip(vectors.points("v.rgb"));
    let background: DVec3 = background.map(|(opacity, by)| (1.0 - opacity) * by).sum();
    ours.push(("background", background.to_array().to_vec()));
    for (name, ours) in ours {
        let theirs = vectors.values(&format!("{case}.d.{name}"));
        let error = error(&ours, &theirs);
        eprintln!("{case:20} {name:12} {error:.1e}");
        assert!(error < 1e-6, "{case}: {name} is off by {error:e}");
    }
}

#[test]
fn reference_has_the_gradients_of_others() {
    let Some(vectors) = Vectors::read() else { return };
    let pinhole = vectors.view(vectors.pinhole());
    let classic = RenderProfile::DEFAULT;
    check_case(&vectors, "classic", pinhole, &classic, true);
    let antialiased = RenderProfile { antialiased: true, ..classic };
    check_case(&vectors, "antialiased", pinhole, &antialiased, true);
    check_case(&vectors, "fisheye_unscented", vectors.view(vectors.fisheye()), &classic, true);
}

/// Groups of the columns of a lane group.
fn column_groups(sh_degree: u8) -> [(&'static str, Range<usize>); 5] {
    [
        ("mean", column::MEAN..column::SCALE),
        ("ln scale", column::SCALE..column::QUAT),
        ("quat", column::QUAT..column::LOG2_OPACITY),
        ("opacity", column::LOG2_OPACITY..column::SH),
        ("sh", column::SH..columns(sh_degree)),
    ]
}

/// The derivatives by all Gaussians, group by group of columns, and those by all twists.
fn all_values(gradients: &Gradients) -> Vec<(&'static str, Vec<f64>)> {
    let degree = gradients.chunks.first().map_or(0, |chunk| chunk.sh_degree());
    let mut groups: Vec<(&'static str, Vec<f64>)> = Vec::new();
    for (name, range) in column_groups(degree) {
        let mut values = Vec::new();
        for chunk in &gradients.chunks {
            for index in 0..chunk.len() {
                values.extend(range.clone().map(|column| f64::from(chunk.value(index, column))));
            }
        }
        groups.push((name, values));
    }
    let twists = gradients.twists.iter().flat_map(|twist| twist.to_array()).collect();
    groups.push(("twist", twists));
    groups
}

/// Derivatives of a smooth loss by random images: waves of several lengths.
fn waves(images: &[GaussianImages]) -> Vec<GaussianImages> {
    let wave = |len: usize, phase: f32| {
        (0..len).map(|i| (0.37 * i as f32 + phase).sin() + 0.3 * (0.011 * i as f32).cos()).collect()
    };
    images
        .iter()
        .map(|images| GaussianImages {
            rgb: wave(images.rgb.len(), 0.1),
            opacity: wave(images.opacity.len(), 1.3),
            depth_sum_m: wave(images.depth_sum_m.len(), 2.1),
        })
        .collect()
}

fn differentiate(
    backend: &dyn Differentiate,
    scene: &Scene,
    profile: &RenderProfile,
    views: &[View],
) -> (Vec<GaussianImages>, Gradients) {
    let mut gradients = Gradients::default();
    let mut seen = Vec::new();
    let frame = Frame { scene, profile, views };
    backend
        .differentiate(
            &frame,
            true,
            &mut |images| {
                seen = images.to_vec();
                waves(images)
            },
            &mut gradients,
        )
        .expect("gradients");
    (seen, gradients)
}

/// The gradients of a backend against those of `reference`: within 1e-4 of the largest entry of each
/// group of parameters, and with a cosine above 0.99999.
fn check_against_reference(
    case: &str,
    backend: &dyn Differentiate,
    scene: &Scene,
    profile: &RenderProfile,
    views: &[View],
) {
    let (_, ours) = differentiate(backend, scene, profile, views);
    let (_, theirs) = differentiate(&Reference, scene, profile, views);
    for ((name, ours), (_, theirs)) in all_values(&ours).iter().zip(all_values(&theirs)) {
        let error = error(ours, &theirs);
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let cosine = dot(ours, &theirs) / (dot(ours, ours) * dot(&theirs, &theirs)).sqrt();
        eprintln!("{case:20} {name:10} {error:.1e} {:.1e}", 1.0 - cosine);
        assert!(error < 1e-4 && cosine > 0.99999, "{case}: {name} is off by {error:e}, {cosine}");
    }
}

#[test]
fn cpu_has_the_gradients_of_the_reference() {
    let backend = cpu();
    let scene = Scene::from_gaussians(&street(3_000, 3, 5));
    let small = |view: &View| View { camera: view.camera.scaled(120, 80).unwrap(), ..*view };
    let views: Vec<View> = turning_views().iter().map(small).collect();
    let native = |view: &View| {
        let camera = Camera { native_size_px: None, ..view.camera };
        View { camera, ..*view }
    };
    let native: Vec<View> = views.iter().map(native).collect();
    let classic = RenderProfile::default();
    let antialiased = RenderProfile { antialiased: true, ..classic };
    check_against_reference("classic", &backend, &scene, &classic, &native);
    check_against_reference("antialiased", &backend, &scene, &antialiased, &native);
    check_against_reference("shrunk", &backend, &scene, &antialiased, &views);
}
