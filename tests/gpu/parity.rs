//! Whole images: gpu against cpu, which is held against the reference elsewhere.

use glam::DVec3;
use wildcity::render::View;
use wildcity::scene::{RenderProfile, Scene};

use crate::gpu::gpu;
use crate::images::{agree, cpu, look, render};
use crate::streets::street;

/// Views from within a street: along it, across it, and back.
fn street_views() -> [View; 3] {
    let at = DVec3::new(0.4, 0.0, 20.0);
    [
        look([200, 131], 240.0, at, DVec3::new(0.1, 0.02, 1.0), DVec3::Y),
        look([131, 100], 90.0, at, DVec3::new(1.0, 0.1, 0.3), DVec3::Y),
        look([97, 64], 60.0, at, DVec3::new(-0.4, 0.0, -1.0), DVec3::new(0.2, 1.0, 0.0)),
    ]
}

#[test]
fn streets_of_every_sh_degree() {
    let gpu = gpu();
    for degree in 0..=3 {
        let scene = Scene::from_gaussians(&street(30_000, degree, 5));
        let profile = RenderProfile::default();
        let images = render(&gpu, &scene, &profile, &street_views());
        let truths = render(&cpu(), &scene, &profile, &street_views());
        for (view, (image, truth)) in images.iter().zip(&truths).enumerate() {
            let db = agree(image, truth).unwrap_or_else(|e| panic!("degree {degree}, view {view}: {e}"));
            println!("degree {degree}, view {view}: {db:.1} dB");
        }
    }
}
