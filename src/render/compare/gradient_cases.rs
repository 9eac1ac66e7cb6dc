//! Scenes whose gradients are compared with those of `reference`: streets by every kind of camera,
//! and extremes.

use std::f64::consts::TAU;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::geometry::camera::{Fisheye, Lens, OpenCv, ShutterDirection};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::random::Random;
use wildcity_scene::{Gaussians, RenderProfile, Scene, sh};

use super::gaussians::{GaussianSpec, forward_view, scene_from_specs};
use super::gradients::waves;
use crate::gradient::{Differentiate, GaussianImages, GradientError, Gradients};
use crate::reference::Reference;
use crate::{Frame, RollingShutter, View};

/// Largest difference of a derivative as a share of the largest one of its group.
pub const MOST_ERROR: f64 = 1e-4;

/// A scene whose gradients are compared.
#[derive(Debug)]
pub struct Case {
    pub name: &'static str,
    pub scene: Scene,
    pub views: Vec<View>,
    pub profile: RenderProfile,
    /// Largest error of a group: [`MOST_ERROR`] unless the case says why not.
    pub most_error: f64,
}

impl Case {
    /// The gradients of the reference, then those with its cut and its stop nudged up and down: a
    /// pixel whose alpha lies within the rounding of a backend of a step may take either.
    ///
    /// # Errors
    /// Those of [`Differentiate::differentiate`].
    pub fn truths(&self) -> Result<Vec<Gradients>, GradientError> {
        // What f32 loses of the exponent of a thin splat, of which u changes by 10 per pixel, three
        // deviations from a centre that is rounded to 1e-6 px. Of 300,000 pairs of a splat and a
        // pixel five are as near to the cut.
        const NUDGE: f64 = 1e-4;
        let profile = self.profile;
        let cuts = [0.0, NUDGE, -NUDGE]
            .map(|nudge| RenderProfile { alpha_cut: profile.alpha_cut * (1.0 + nudge), ..profile });
        let stops = [NUDGE, -NUDGE]
            .map(|nudge| RenderProfile { stop: profile.stop * (1.0 + nudge), ..profile });
        let truth = |profile| self.gradients_with(&Reference, &profile);
        cuts.into_iter().chain(stops).map(truth).collect()
    }

    /// The gradients of a backend for a loss of [`waves`].
    ///
    /// # Errors
    /// Those of [`Differentiate::differentiate`].
    pub fn gradients(&self, backend: &dyn Differentiate) -> Result<Gradients, GradientError> {
        self.gradients_with(backend, &self.profile)
    }

    fn gradients_with(
        &self,
        backend: &dyn Differentiate,
        profile: &RenderProfile,
    ) -> Result<Gradients, GradientError> {
        let mut gradients = Gradients::default();
        let frame = Frame { scene: &self.scene, profile, views: &self.views };
        let mut loss = |images: &[GaussianImages]| waves(images);
        backend.differentiate(&frame, true, &mut loss, &mut gradients)?;
        Ok(gradients)
    }
}

/// All cases: streets, then extremes.
pub fn cases() -> Vec<Case> {
    [streets(), extremes()].into_iter().flatten().collect()
}

/// Of needles 50,000 times longer than wide: the factor of their inverse covariance times their
/// length loses three digits of f32, in their images (stress case T1), too. On a GPU their rotation
/// is rounded to 7e-7, 4 % of their width at their ends.
const NEEDLES: f64 = 1e-2;

/// Of Gaussians that cover each other with one colour: their opacities hardly matter, so that the
/// largest derivative is 1e-4 of the terms that cancel in it.
const COVERED: f64 = 1e-3;

/// Size of all images, in pixels.
const SIZE_PX: [u32; 2] = [96, 64];

fn case(name: &'static str, scene: Scene, view: View) -> Case {
    let profile = RenderProfile::default();
    Case { name, scene, views: vec![view], profile, most_error: MOST_ERROR }
}

/// A street by every kind of camera.
fn streets() -> Vec<Case> {
    let view = forward_view(SIZE_PX, 60.0);
    let small = forward_view([48, 32], 30.0);
    let street = |sh_degree| Scene::from_gaussians(&street(1_200, sh_degree));
    let with_lens = |lens| View { camera: Camera { lens, ..view.camera }, ..view };
    let opencv = OpenCv::new([-0.12, 0.03, -0.002, 0.0, 0.0, 0.0], [0.0015, -0.001], [0.0; 4]);
    let rolling = RollingShutter {
        direction: ShutterDirection::TopToBottom,
        world_from_camera_first: Pose {
            position_m: DVec3::new(0.05, 0.0, -0.9),
            rotation: DQuat::from_rotation_y(-0.01),
        },
    };
    let antialiased = RenderProfile { antialiased: true, ..RenderProfile::default() };
    let half = |view: View| match view.camera.scaled(48, 32) {
        Ok(camera) => View { camera, ..view },
        // 48 x 32 is a size that every camera may have.
        Err(_) => view,
    };
    let car = Arc::clone(&Scene::from_gaussians(&street_at(300, 2, 3)).chunks[0]);
    let placed = |pose, actor, tint| PlacedChunk {
        tint,
        ..PlacedChunk::at_rest(Arc::clone(&car), pose, actor)
    };
    let at = |x, z, yaw| Pose {
        position_m: DVec3::new(x, 0.0, z),
        rotation: DQuat::from_rotation_y(yaw),
    };
    let actors = vec![
        placed(at(1.0, 6.0, 0.4), 0, [1.0; 3]),
        placed(at(-2.0, 9.0, 2.0), 1, [0.5, 1.0, 0.7]),
    ];
    let six: Vec<View> = (0..6)
        .map(|k| {
            let rotation = DQuat::from_rotation_y(TAU * f64::from(k) / 6.0);
            View::new(view.camera, Pose { position_m: DVec3::new(0.0, 0.0, 20.0), rotation })
        })
        .collect();
    vec![
        case("pinhole, SH 0", street(0), view),
        case("pinhole, SH 3", street(3), view),
        // More than one segment of splats, whose sums are gathered apart.
        case("60,000 Gaussians", Scene::from_gaussians(&self::street(60_000, 0)), small),
        Case { profile: antialiased, ..case("antialiased", street(1), view) },
        Case { profile: antialiased, ..case("half size", street(1), half(view)) },
        Case { views: six, ..case("six views", street(1), view) },
        case("OpenCV", street(1), with_lens(Lens::opencv(opencv))),
        case(
            "fisheye",
            street(1),
            with_lens(Lens::Fisheye(Fisheye::new([-0.03, -0.005, -0.0008, 0.001], None))),
        ),
        case("rolling shutter", street(1), View { rolling_shutter: Some(rolling), ..view }),
        case("actors", Scene { placed: actors.clone(), ..street(1) }, view),
        Case {
            views: vec![
                view,
                with_lens(Lens::Fisheye(Fisheye::new([-0.03, -0.005, -0.0008, 0.001], None))),
                View { rolling_shutter: Some(rolling), ..view },
                half(view),
            ],
            ..case("all in one frame", Scene { placed: actors, ..street(1) }, view)
        },
    ]
}

/// Scenes at which a derivative could overflow, cancel or divide by 0.
pub fn extremes() -> Vec<Case> {
    let view = forward_view(SIZE_PX, 60.0);
    let mut random = Random::new(1, "extremes", 0);
    let mut around = |depth_m: f64| {
        let x = random.range(-0.6, 0.6);
        let y = random.range(-0.4, 0.4);
        depth_m * DVec3::new(x, y, 1.0)
    };
    let turned = |k: usize| {
        DQuat::from_rotation_z(0.7 * k as f64) * DQuat::from_rotation_x(0.9 + 0.3 * k as f64)
    };
    let spec = |k: usize, mean_m: DVec3, sigma_m: DVec3, opacity: f64| GaussianSpec {
        mean_m,
        rotation: turned(k),
        sigma_m,
        opacity,
        rgb: [0.2 + 0.1 * (k % 7) as f64, 0.5, 0.9 - 0.1 * (k % 5) as f64],
    };
    let mut many = |count: usize, depth_m: &dyn Fn(usize) -> f64, sigma_m: DVec3, opacity: f64| {
        let one = |k| spec(k, around(depth_m(k)), sigma_m, opacity);
        (0..count).map(one).collect::<Vec<_>>()
    };
    let depth = |k: usize| 3.0 + 0.2 * k as f64;
    let needles = many(30, &depth, DVec3::new(50.0, 1e-3, 1e-3), 0.6);
    let discs = many(30, &depth, DVec3::new(0.5, 0.5, 1e-5), 0.6);
    // At 1,000 km the reference is the less accurate one: it linearises the camera by differences.
    let huge = many(8, &depth, DVec3::new(1e3, 3e2, 1e2), 0.3);
    let tiny = many(60, &depth, DVec3::splat(1e-6), 0.8);
    // Some at the floor of the opacity's scale, some above it.
    let small = many(200, &depth, DVec3::splat(4e-3), 0.995);
    let opaque = many(40, &depth, DVec3::splat(0.3), 1.0 - 1e-7);
    let faint = many(60, &depth, DVec3::splat(0.5), 1.02 / 255.0);
    let near = many(10, &|k| 0.011 + 0.002 * k as f64, DVec3::splat(1e-3), 0.7);
    // A thousand layers that leave 1e-4 of the light at last.
    let deep = many(1_000, &|k| 3.0 + 0.001 * k as f64, DVec3::splat(3.0), 0.0095);
    let same = vec![spec(2, DVec3::new(0.1, 0.1, 4.0), DVec3::splat(0.4), 0.3); 40];
    let far_m = DVec3::new(4.5e6, -3e6, 100.0);
    let mut moved = street(600, 1);
    for mean_m in &mut moved.means_m {
        *mean_m = (DVec3::from_array(*mean_m) + far_m).to_array();
    }
    let far_view =
        View { world_from_camera: Pose { position_m: far_m, ..view.world_from_camera }, ..view };
    let mut scaled = street(600, 1);
    for (k, quat) in scaled.quats_wxyz.iter_mut().enumerate() {
        *quat = quat.map(|q| q * if k % 2 == 0 { 1e-3 } else { 1e3 });
    }
    let antialiased = RenderProfile { antialiased: true, ..RenderProfile::default() };
    vec![
        Case { most_error: NEEDLES, ..case("needles", scene_from_specs(&needles), view) },
        Case {
            profile: antialiased,
            most_error: NEEDLES,
            ..case("needles, antialiased", scene_from_specs(&needles), view)
        },
        case("discs", scene_from_specs(&discs), view),
        case("1 km wide", scene_from_specs(&huge), view),
        case("1 µm wide", scene_from_specs(&tiny), view),
        Case { profile: antialiased, ..case("4 mm, antialiased", scene_from_specs(&small), view) },
        case("opaque", scene_from_specs(&opaque), view),
        case("at the cut", scene_from_specs(&faint), view),
        case("at the near plane", scene_from_specs(&near), view),
        case("1,000 layers", scene_from_specs(&deep), view),
        Case { most_error: COVERED, ..case("40 in one place", scene_from_specs(&same), view) },
        case("5,400 km away", Scene::from_gaussians(&moved), far_view),
        case("quaternions of 1e±3", Scene::from_gaussians(&scaled), view),
        case("nothing", scene_from_specs(&[]), view),
    ]
}

fn street(count: usize, sh_degree: u8) -> Gaussians {
    street_at(count, sh_degree, 1)
}

/// A road, two facades and clutter along +z, y down.
fn street_at(count: usize, sh_degree: u8, seed: u64) -> Gaussians {
    let mut random = Random::new(seed, "street", 0);
    let mut gaussians = Gaussians::with_capacity(sh_degree, count);
    for k in 0..count {
        let z = random.range(2.0, 40.0);
        let (mean_m, sigma_m) = match k % 4 {
            0 => ([random.range(-8.0, 8.0), 1.6, z], [0.3, 0.01, 0.3]),
            1 => ([-8.0, random.range(-8.0, 1.6), z], [0.01, 0.3, 0.3]),
            2 => ([8.0, random.range(-8.0, 1.6), z], [0.01, 0.3, 0.3]),
            _ => ([random.range(-7.0, 7.0), random.range(-2.0, 1.6), z], [0.1; 3]),
        };
        gaussians.means_m.push(mean_m);
        gaussians
            .quats_wxyz
            .push([1.0, 0.0, 0.0, 0.0].map(|q: f64| (q + random.range(-0.1, 0.1)) as f32));
        let ln = |sigma_m: f64| (sigma_m.ln() + random.range(-0.5, 0.5)) as f32;
        gaussians.ln_scales.push(sigma_m.map(ln));
        gaussians.logit_opacities.push(random.range(-2.0, 4.0) as f32);
        for coefficient in 0..3 * sh::coefficients(sh_degree) {
            let most = if coefficient < 3 { 1.5 } else { 0.3 };
            gaussians.sh.push(random.range(-most, most) as f32);
        }
    }
    gaussians
}
