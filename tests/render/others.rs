//! Comparison with images of the same Gaussians by other renderers.

use wildcity_render::Backend;
use wildcity_render::reference::Reference;
use wildcity_scene::RenderProfile;

use crate::images::{cpu, max_difference, psnr, render_one};
use crate::truths::{gsplat, skull_front};

#[test]
fn gsplat_is_met() {
    let Some(truth) = gsplat() else { return };
    let off = |backend: &dyn Backend, profile: &RenderProfile| {
        let image = render_one(backend, &truth.scene, profile, truth.view);
        max_difference(&image.rgba, &truth.rgba)
    };
    assert!(off(&Reference, &truth.profile) <= 1e-5);
    assert!(off(&cpu(), &truth.profile) <= 1e-4);
    // With another profile the comparison fails.
    for setting in ["blur=0.2", "antialiased=true", "alpha_cut=0.02", "alpha_cap=0.5"] {
        let mut other = truth.profile;
        other.set(setting).unwrap();
        assert!(off(&Reference, &other) > 1e-4, "{setting} made no difference");
    }
}

#[test]
fn an_independent_renderer_of_a_real_capture_is_met() {
    let Some(truth) = skull_front() else { return };
    let image = render_one(&cpu(), &truth.scene, &truth.profile, truth.view);
    let db = psnr(&image.rgba, &truth.rgba);
    assert!(db >= 60.0, "{db:.1} dB");
}
