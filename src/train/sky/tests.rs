use glam::DVec3;
use wildcity_render::compare::gaussians::forward_view;
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::{Fisheye, Lens};

use super::*;

fn sky(images: usize) -> TrainedSky {
    TrainedSky::new(&SkySettings::default(), images, 7)
}

#[test]
fn the_network_of_a_server_has_the_same_colors() {
    let mut sky = sky(2);
    let directions: Vec<[f32; 3]> = (0..50)
        .map(|k| DVec3::new((0.3 * f64::from(k)).sin(), (0.7 * f64::from(k)).cos(), 0.4))
        .map(|direction| direction.normalize().as_vec3().to_array())
        .collect();
    // The mean of both is what the second one has.
    for (image, factor) in [0.5, 1.5].into_iter().enumerate() {
        let (appearance, _) = &mut sky.appearances[image];
        for (k, value) in appearance.iter_mut().enumerate() {
            *value = factor * (0.1 * k as f32 - 0.6);
        }
    }
    let mean: Vec<f32> = (0..16).map(|k| 0.1 * k as f32 - 0.6).collect();
    let colors = sky.layers.colors(&sky.layers.inputs(&directions, &mean));
    let network = sky.network().expect("a network");
    for (direction, color) in directions.iter().zip(colors.chunks_exact(3)) {
        let direction = DVec3::from_array(direction.map(f64::from));
        let theirs = network.rgb(direction).to_array();
        for (ours, theirs) in color.iter().zip(theirs) {
            assert!((f64::from(*ours) - theirs).abs() < 1e-5, "{ours} {theirs}");
        }
    }
}

#[test]
fn derivatives_are_those_of_differences() {
    let sky = sky(1);
    let directions: Vec<[f32; 3]> =
        (0..600).map(|k| [(0.11 * k as f32).sin(), (0.07 * k as f32).cos(), 0.3]).collect();
    let appearance: Vec<f32> = (0..16).map(|k| 0.05 * k as f32).collect();
    let by: Vec<f32> = (0..1_800).map(|k| (0.31 * k as f32).cos()).collect();
    let loss = |layers: &Layers, appearance: &[f32]| -> f64 {
        let colors = layers.colors(&layers.inputs(&directions, appearance));
        colors.iter().zip(&by).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
    };
    let inputs = sky.layers.inputs(&directions, &appearance);
    let (by_layers, by_inputs) = sky.layers.gradient(&inputs, &by);
    let most = by_layers.iter().fold(0.0_f32, |most, by| most.max(by.abs()));
    // A step of 1e-3 passes few kinks of 600 nodes; f32 resolves the loss to 1e-5.
    let h = 1e-3;
    for index in (0..by_layers.len()).step_by(211) {
        let at = |step: f64| {
            let mut layers = sky.layers.clone();
            let mut steps = vec![0.0; by_layers.len()];
            steps[index] = step;
            layers.add(&steps);
            loss(&layers, &appearance)
        };
        let difference = (at(h) - at(-h)) / (2.0 * h);
        let off = (difference - f64::from(by_layers[index])).abs();
        assert!(off < 2e-2 * f64::from(most), "{index}: {difference} {}", by_layers[index]);
    }
    let by_appearance = &by_inputs[by_inputs.len() - 16..];
    let most = by_appearance.iter().fold(0.0_f32, |most, by| most.max(by.abs()));
    for index in 0..16 {
        let at = |step: f32| {
            let mut moved = appearance.clone();
            moved[index] += step;
            loss(&sky.layers, &moved)
        };
        let difference = (at(1e-3) - at(-1e-3)) / 2e-3;
        let off = (difference - f64::from(by_appearance[index])).abs();
        assert!(off < 2e-2 * f64::from(most), "{index}: {difference} {}", by_appearance[index]);
    }
}

/// The largest difference between a sky that is interpolated and one of every pixel.
fn interpolation_error(view: &View) -> f64 {
    let sky = sky(1);
    let pixels = view.camera.pixels();
    let image = sky.image(view, 0, &vec![0.0; pixels]);
    let network = sky.network().expect("a network");
    let mut most = 0.0_f64;
    for pixel in 0..pixels {
        let width = view.camera.width_px as usize;
        let at = [pixel % width, pixel / width].map(|px| px as f64 + 0.5);
        let drawn = DVec3::from_array([0, 1, 2].map(|c| f64::from(image.rgb[3 * pixel + c])));
        match view.ray_world(DVec2::from_array(at)) {
            Some(direction) => {
                most = most.max((network.rgb(direction) - drawn).abs().max_element());
            }
            None => assert_eq!(drawn, DVec3::ZERO),
        }
    }
    most
}

#[test]
fn a_sky_between_its_nodes_is_that_of_every_pixel() {
    // Less than a step of 8 bits, for the finest details that a network may have at its start.
    let view = forward_view([119, 77], 180.0);
    let error = interpolation_error(&view);
    assert!(error < 1.0 / 255.0, "{error}");
    // A lens whose field ends within the image.
    let lens = Lens::Fisheye(Fisheye::new([0.0; 4], Some(0.25)));
    let narrow = View { camera: Camera { lens, ..view.camera }, ..view };
    let error = interpolation_error(&narrow);
    assert!(error < 1.0 / 255.0, "{error}");
}

#[test]
fn what_is_covered_costs_no_node() {
    let view = forward_view([64, 48], 60.0);
    let mut opacity = vec![1.0; view.camera.pixels()];
    let covered = sky(1).image(&view, 0, &opacity);
    assert!(covered.inputs.is_empty() && covered.rgb.iter().all(|value| *value == 0.0));
    opacity[20 * 64 + 33] = 0.5;
    let open = sky(1).image(&view, 0, &opacity);
    assert_eq!(open.inputs.len(), 4 * 55);
    assert_eq!(open.rgb.iter().filter(|value| **value > 0.0).count(), 3);
}
