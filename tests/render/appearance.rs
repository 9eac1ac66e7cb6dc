//! Exposure and overlays: they change colours as specified, and nothing else.

use std::sync::Arc;

use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, RenderError, Target};
use wildcity_scene::appearance::{Appearance, AppearanceError, Exposure, Overlay};
use wildcity_scene::{RenderProfile, Scene};

use crate::images::{Image, agree, cpu, max_difference, render_one};
use crate::skies::{appearance, draw_seen, sky};
use crate::streets::{street, street_views};

fn scene() -> Scene {
    Scene { sky: Some(sky()), ..Scene::from_gaussians(&street(10_000, 1, 4)) }
}

fn draw(backend: &dyn Backend, scene: &Scene, seen: &Appearance) -> Image {
    draw_seen(backend, scene, street_views()[2], seen)
}

#[test]
fn an_exposure_follows_the_sky_and_precedes_the_overlay() {
    let scene = scene();
    let view = street_views()[2];
    let seen = appearance(view);
    let exposure = seen.exposure.unwrap();
    let overlay = seen.overlay.as_ref().unwrap();
    for backend in [&cpu() as &dyn Backend, &Reference] {
        let plain = render_one(backend, &scene, &RenderProfile::DEFAULT, view);
        let image = draw(backend, &scene, &seen);
        assert_eq!((&image.depth_m, &image.opacity), (&plain.depth_m, &plain.opacity));
        let mut changed = 0;
        for (pixel, (seen, plain)) in image.rgba.chunks(4).zip(plain.rgba.chunks(4)).enumerate() {
            let over = &overlay.rgba8()[4 * pixel..][..4];
            let alpha = f32::from(over[3]) / 255.0;
            for c in 0..3 {
                let exposed = (0..3).map(|k| exposure.matrix[c][k] as f32 * plain[k]).sum::<f32>()
                    + exposure.offset[c] as f32;
                let wanted = exposed * (1.0 - alpha) + alpha * f32::from(over[c]) / 255.0;
                assert!((seen[c] - wanted).abs() < 2e-5, "{pixel}: {} not {wanted}", seen[c]);
            }
            assert_eq!(seen[3], plain[3], "alpha is the Gaussians'");
            changed += usize::from(seen[0] != plain[0]);
        }
        assert!(changed > image.opacity.len() / 2, "{changed}");
        // The 8-bit image has the same colours.
        for (byte, linear) in image.rgb8.chunks(3).zip(image.rgba.chunks(4)) {
            for c in 0..3 {
                let wanted = 255.0 * linear[c].clamp(0.0, 1.0);
                assert!((f32::from(byte[c]) - wanted).abs() < 0.51, "{byte:?} {linear:?}");
            }
        }
    }
}

#[test]
fn both_backends_agree() {
    let scene = scene();
    let seen = appearance(street_views()[2]);
    agree(&draw(&cpu(), &scene, &seen), &draw(&Reference, &scene, &seen)).unwrap();
}

#[test]
fn a_plain_appearance_changes_no_bit() {
    let scene = scene();
    let view = street_views()[2];
    let plain = render_one(&cpu(), &scene, &RenderProfile::DEFAULT, view);
    assert_eq!(draw(&cpu(), &scene, &Appearance::default()), plain);
    let identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let exposure = Some(Exposure { matrix: identity, offset: [0.0; 3] });
    let same = draw(&cpu(), &scene, &Appearance { exposure, overlay: None });
    assert!(max_difference(&same.rgba, &plain.rgba) < 1e-7);
}

#[test]
fn what_cannot_be_is_refused() {
    let pixels = vec![9; 4 * 6 * 5];
    assert_eq!(Overlay::new(6, pixels.clone()).unwrap().size_px(), [6, 5]);
    assert!(Overlay::new(7, pixels.clone()).is_err());
    assert!(Overlay::new(0, Vec::new()).is_err());
    let overlay = Some(Arc::new(Overlay::new(6, pixels).unwrap()));
    let seen = Appearance { exposure: None, overlay };
    assert_eq!(seen.check([6, 5]), Ok(()));
    let error = seen.check([5, 6]).unwrap_err();
    assert_eq!(error, AppearanceError::Size { overlay_px: [6, 5], camera_px: [5, 6] });
    assert_eq!(error.to_string(), "the overlay is 6 x 5 pixels, and the camera's image 5 x 6");
    for value in [f64::NAN, 101.0, f64::NEG_INFINITY] {
        let mut exposure = Exposure { matrix: [[1.0; 3]; 3], offset: [0.0; 3] };
        exposure.offset[2] = value;
        let error = Appearance { exposure: Some(exposure), overlay: None }.check([1, 1]);
        assert!(matches!(error, Err(AppearanceError::Exposure { field: "offset", .. })));
    }
    // A backend checks the overlay itself, whether the caller did or not.
    let scene = Scene::default();
    let views = street_views();
    let frame = Frame { scene: &scene, profile: &RenderProfile::DEFAULT, views: &views[2..] };
    let mut rgb8 = vec![0; 3 * views[2].camera.pixels()];
    let target = Target { rgb8: Some(&mut rgb8), appearance: Some(&seen), ..Target::default() };
    let refused = cpu().render(&frame, &mut [target], &|_, _| {});
    assert_eq!(refused, Err(RenderError::Overlay { view: 0, given: [6, 5], wanted: [97, 64] }));
}
