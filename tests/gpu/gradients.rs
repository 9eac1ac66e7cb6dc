//! Gradients of the gpu backend against `reference`, and that they repeat.

use wildcity_render::Frame;
use wildcity_render::compare::gradients::{by_group, waves};
use wildcity_render::gradient::{Differentiate, Gradients};
use wildcity_scene::{RenderProfile, Scene};

use crate::gradient_cases::{check_actors, check_lenses, check_pinholes};
use crate::shared_gpu;
use crate::streets::{street, turning_views};

#[test]
fn gpu_has_the_gradients_of_the_reference() {
    check_pinholes(&**shared_gpu());
}

#[test]
fn gpu_has_the_gradients_of_every_lens_and_shutter() {
    check_lenses(&**shared_gpu());
}

#[test]
fn gpu_has_the_gradients_of_actors() {
    check_actors(&**shared_gpu());
}

#[test]
fn gradients_repeat_to_the_byte() {
    let scene = Scene::from_gaussians(&street(20_000, 1, 12));
    let profile = RenderProfile::default();
    let views = turning_views();
    let gpu = shared_gpu();
    let mut gradients = Gradients::default();
    let mut differ = || {
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        gpu.differentiate(&frame, true, &mut |images| waves(images), &mut gradients).unwrap();
        let bits = |(_, values): (_, Vec<f64>)| values.into_iter().map(f64::to_bits);
        by_group(&gradients).into_iter().flat_map(bits).collect::<Vec<u64>>()
    };
    let first = differ();
    for repeat in 0..20 {
        assert!(differ() == first, "repeat {repeat}");
    }
}
