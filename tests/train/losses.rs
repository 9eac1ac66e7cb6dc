//! Each loss against central differences of itself in f64, and L1 in f32 against f64.

use wildcity_train::compose::{Background, Exposure, compose, compose_gradient};
use wildcity_train::loss::ground::{Gaussian, Terms};
use wildcity_train::loss::{
    Loss, disparity, dssim, l1, l2, masked, metric_depth, normals, opacity, scale,
};

use crate::scene_files::Random;

/// Random numbers between two bounds.
fn numbers(count: usize, seed: u64, low: f64, high: f64) -> Vec<f64> {
    let mut random = Random(seed);
    (0..count).map(|_| low + (high - low) * random.unit()).collect()
}

/// Asserts that derivatives are those of a function, at some of its values.
fn check(what: &str, values: &[f64], by: &[f64], f: impl Fn(&[f64]) -> f64) {
    assert_eq!(values.len(), by.len(), "{what}");
    let most = by.iter().fold(0.0_f64, |most, value| most.max(value.abs()));
    assert!(most > 0.0, "{what}: no derivative");
    for i in (0..values.len()).step_by(values.len().div_ceil(40)) {
        let h = 1e-6;
        let at = |step: f64| {
            let mut values = values.to_vec();
            values[i] += step;
            f(&values)
        };
        let difference = (at(h) - at(-h)) / (2.0 * h);
        let error = (difference - by[i]).abs() / most;
        assert!(error < 1e-6, "{what}, value {i}: {} and not {difference}", by[i]);
    }
}

const SIZE_PX: [usize; 2] = [17, 13];
const PIXELS: usize = 17 * 13;

#[test]
fn losses_of_colours() {
    let image = numbers(3 * PIXELS, 1, 0.0, 1.0);
    let target = numbers(3 * PIXELS, 2, 0.0, 1.0);
    let mut weights = numbers(PIXELS, 3, 0.0, 1.0);
    weights[..40].fill(0.0);
    for weights in [None, Some(&weights[..])] {
        let loss = l1(&image, &target, weights);
        check("l1", &image, &loss.by, |image| l1(image, &target, weights).value);
        let loss = l2(&image, &target, weights);
        check("l2", &image, &loss.by, |image| l2(image, &target, weights).value);
        let f32s = |values: &[f64]| values.iter().map(|&value| value as f32).collect::<Vec<f32>>();
        let single_weights = weights.map(f32s);
        let single = l1(&f32s(&image), &f32s(&target), single_weights.as_deref());
        assert!((single.value - l1(&image, &target, weights).value).abs() < 1e-6);
    }
    // A mean: equal differences give this difference, whatever the weights.
    let darker: Vec<f64> = image.iter().map(|value| value - 0.25).collect();
    assert!((l1(&image, &darker, Some(&weights)).value - 0.25).abs() < 1e-12);
    assert!((l2(&image, &darker, Some(&weights)).value - 0.0625).abs() < 1e-12);
    // Nothing is left: no loss, and no NaN.
    let nothing = l1(&image, &target, Some(&[0.0; PIXELS]));
    assert!(nothing.value == 0.0 && nothing.by.iter().all(|&by| by == 0.0));

    let loss = dssim(SIZE_PX, &image, &target);
    check("dssim", &image, &loss.by, |image| dssim(SIZE_PX, image, &target).value);
    assert!(dssim(SIZE_PX, &image, &image).value.abs() < 1e-12);
    // A masked pixel has no derivative.
    let own = masked(&image, &weights);
    let loss = dssim(SIZE_PX, &own, &masked(&target, &weights));
    let by = masked(&loss.by, &weights);
    check("masked dssim", &image, &by, |image| {
        dssim(SIZE_PX, &masked(image, &weights), &masked(&target, &weights)).value
    });
    assert!(by[..3 * 40].iter().all(|&by| by == 0.0));
}

#[test]
fn bright_and_flat_images_have_a_similarity() {
    for level in [1.0_f32, 100.0, 1e4] {
        let flat = vec![level; 3 * PIXELS];
        let loss = dssim(SIZE_PX, &flat, &flat);
        assert!((0.0..0.1).contains(&loss.value.abs()), "{level}: {}", loss.value);
        assert!(loss.by.iter().all(|by| by.is_finite()), "{level}");
    }
}

#[test]
fn a_pixel_without_weight_may_hold_anything() {
    let mut image = numbers(3 * PIXELS, 1, 0.0, 1.0);
    let target = numbers(3 * PIXELS, 2, 0.0, 1.0);
    let mut weights = vec![1.0; PIXELS];
    weights[4] = 0.0;
    let before = l1(&image, &target, Some(&weights));
    image[13] = f64::NAN;
    assert_eq!(l1(&image, &target, Some(&weights)), before);
    assert!(masked(&image, &weights).iter().all(|value| value.is_finite()));
}

#[test]
fn images_smaller_than_a_window_have_a_similarity() {
    for size_px in [[1, 1], [3, 2], [2, 12]] {
        let values = 3 * size_px[0] * size_px[1];
        let [image, target] = [5, 6].map(|seed| numbers(values, seed, 0.0, 1.0));
        let loss = dssim(size_px, &image, &target);
        check("small", &image, &loss.by, |image| dssim(size_px, image, &target).value);
    }
}

#[test]
fn losses_of_depths() {
    let mut opacities = numbers(PIXELS, 7, 0.1, 1.0);
    let sums_m = numbers(PIXELS, 8, 1.0, 20.0);
    let mut measured_m = numbers(PIXELS, 9, 2.0, 30.0);
    measured_m[3] = 0.0;
    opacities[5] = 0.04;
    for (name, loss) in [
        ("disparity", disparity::<f64> as fn(&[f64], &[f64], &[f64]) -> _),
        ("depth", metric_depth),
    ] {
        let found = loss(&opacities, &sums_m, &measured_m);
        assert_eq!(found.pixels, PIXELS - 2);
        assert_eq!([found.by_depth_sum[3], found.by_opacity[5]], [0.0; 2]);
        check(name, &opacities, &found.by_opacity, |a| loss(a, &sums_m, &measured_m).value);
        check(name, &sums_m, &found.by_depth_sum, |d| loss(&opacities, d, &measured_m).value);
    }
    let nothing = disparity(&opacities, &sums_m, &[0.0; PIXELS]);
    assert!(nothing.value == 0.0 && nothing.pixels == 0);
}

#[test]
fn normals_of_depths() {
    let [width, height] = SIZE_PX;
    let ray = |i: usize| [(i % width) as f64 / 20.0 - 0.4, (i / width) as f64 / 20.0 - 0.3, 1.0];
    let rays: Vec<[f64; 3]> = (0..width * height).map(ray).collect();
    let opacities = numbers(PIXELS, 10, 0.3, 1.0);
    let noise = numbers(PIXELS, 11, 0.9, 1.1);
    let sums_m: Vec<f64> = (0..PIXELS).map(|i| opacities[i] * 5.0 * noise[i]).collect();
    let mut given = vec![[0.6, 0.0, -0.8]; PIXELS];
    given[40] = [0.0; 3];
    let loss = |a: &[f64], d: &[f64]| normals(SIZE_PX, &rays, a, d, &given);
    let found = loss(&opacities, &sums_m);
    assert_eq!(found.pixels, (width - 2) * (height - 2) - 1);
    check("normals", &opacities, &found.by_opacity, |a| loss(a, &sums_m).value);
    check("normals", &sums_m, &found.by_depth_sum, |d| loss(&opacities, d).value);

    // A plane that is tilted about y has one normal everywhere: x sin + z cos = 5 cos.
    let plane: Vec<f64> = rays.iter().map(|ray| 4.0 / (0.8 - 0.6 * ray[0])).collect();
    let found = normals(SIZE_PX, &rays, &[1.0; PIXELS], &plane, &given);
    assert!(found.value.abs() < 1e-12, "{}", found.value);
}

#[test]
fn losses_of_gaussians() {
    let logits = numbers(50, 12, -6.0, 6.0);
    let Loss { by, value } = opacity(&logits);
    assert!(value > 0.2 && value < 0.8);
    check("opacity", &logits, &by, |logits| opacity(logits).value);
    let ln_scales = numbers(60, 13, -6.0, 1.0);
    let Loss { by, .. } = scale(&ln_scales);
    check("scale", &ln_scales, &by, |ln_scales| scale(ln_scales).value);
    // Saturated: finite.
    let ends = opacity(&[-1e4_f32, 1e4]);
    assert!(ends.value == 0.5 && ends.by == [0.0; 2]);
}

#[test]
fn the_terms_of_the_ground() {
    let terms = Terms {
        up: [0.0, 0.6, 0.8],
        forward: [1.0, 0.0, 0.0],
        slice_m: 2.0,
        height: 0.7,
        upright: 0.2,
        opaque: 1.5,
    };
    let values = numbers(7 * 30, 14, -1.0, 1.0);
    let read = |values: &[f64]| -> Vec<Gaussian<f64>> {
        let gaussian = |v: &[f64]| Gaussian {
            mean_m: [5.0 * v[0], v[1], v[2]],
            normal: [v[3], v[4], v[5]],
            opacity: v[6],
        };
        values.chunks_exact(7).map(gaussian).collect()
    };
    let loss = terms.loss(&read(&values));
    let by: Vec<f64> = loss
        .by
        .iter()
        .flat_map(|by| {
            let [x, y, z] = by.mean_m;
            [[5.0 * x, y, z], by.normal].concat().into_iter().chain([by.opacity])
        })
        .collect();
    check("ground", &values, &by, |values| terms.loss(&read(values)).value);

    // A slope along the road costs nothing across it, and flat ground nothing at all.
    let flat = |x: f64| Gaussian { mean_m: [x, 0.0, 3.0], normal: [0.0, -0.6, -0.8], opacity: 1.0 };
    let loss = terms.loss(&[flat(0.1), flat(0.7), flat(5.0)]);
    assert!(loss.terms.iter().all(|term| term.abs() < 1e-12), "{:?}", loss.terms);
    assert!(terms.loss(&[]).value == 0.0);
}

#[test]
fn colours_over_a_background_with_an_exposure() {
    let rgb = numbers(3 * PIXELS, 15, 0.0, 1.0);
    let opacities = numbers(PIXELS, 16, 0.0, 1.0);
    let sky = numbers(3 * PIXELS, 17, 0.0, 1.0);
    let weights = numbers(3 * PIXELS, 18, -1.0, 1.0);
    let exposure = Exposure {
        matrix: [[1.1, 0.02, -0.03], [0.01, 0.9, 0.05], [-0.02, 0.03, 1.2]],
        offset: [0.02, -0.01, 0.03],
    };
    let value = |rgb: &[f64], opacities: &[f64], sky: &[f64], exposure: &Exposure<f64>| {
        let image = compose(rgb, opacities, Background::Image(sky), exposure);
        image.iter().zip(&weights).map(|(a, b)| a * b).sum::<f64>()
    };
    let by = compose_gradient(&rgb, &opacities, Background::Image(&sky), &exposure, &weights);
    check("rgb", &rgb, &by.rgb, |rgb| value(rgb, &opacities, &sky, &exposure));
    check("opacity", &opacities, &by.opacity, |a| value(&rgb, a, &sky, &exposure));
    check("sky", &sky, &by.background, |sky| value(&rgb, &opacities, sky, &exposure));
    let read = |values: &[f64]| Exposure {
        matrix: [0, 1, 2].map(|row| [0, 1, 2].map(|column| values[3 * row + column])),
        offset: [9, 10, 11].map(|k| values[k]),
    };
    let flat = |exposure: &Exposure<f64>| -> Vec<f64> {
        exposure.matrix.iter().flatten().chain(&exposure.offset).copied().collect()
    };
    check("exposure", &flat(&exposure), &flat(&by.exposure), |values| {
        value(&rgb, &opacities, &sky, &read(values))
    });
    let same = compose(&rgb, &[1.0; PIXELS], Background::Color([0.3; 3]), &Exposure::identity());
    assert_eq!(same, rgb);
}

#[test]
fn large_images_are_composed_as_their_pixels_are() {
    // Two parts, and a rest of the few pixels that are summed first.
    const COUNT: usize = 97 * 61;
    let [rgb, behind, by] = [20, 21, 22].map(|seed| numbers(3 * COUNT, seed, -1.0, 1.0));
    let opacity = numbers(COUNT, 23, 0.0, 1.0);
    let exposure =
        Exposure { matrix: [[0.9, 0.1, 0.0], [0.2, 1.1, -0.1], [0.0, 0.3, 0.8]], offset: [0.1; 3] };
    let background = Background::Image(&behind);
    let image = compose(&rgb, &opacity, background, &exposure);
    let gradient = compose_gradient(&rgb, &opacity, background, &exposure, &by);
    let mut sums = [0.0; 12];
    for pixel in 0..COUNT {
        let at = 3 * pixel..3 * pixel + 3;
        let [rgb, behind, by] = [&rgb, &behind, &by].map(|values| &values[at.clone()]);
        let opacity = &opacity[pixel..=pixel];
        let background = Background::Image(behind);
        assert_eq!(image[at.clone()], compose(rgb, opacity, background, &exposure), "{pixel}");
        let own = compose_gradient(rgb, opacity, background, &exposure, by);
        assert_eq!(gradient.rgb[at.clone()], own.rgb, "{pixel}");
        assert_eq!(gradient.background[at], own.background, "{pixel}");
        assert_eq!(gradient.opacity[pixel], own.opacity[0], "{pixel}");
        let own = own.exposure.matrix.as_flattened().iter().chain(&own.exposure.offset);
        sums.iter_mut().zip(own).for_each(|(sum, own)| *sum += own);
    }
    let found = gradient.exposure.matrix.as_flattened().iter().chain(&gradient.exposure.offset);
    for (found, sum) in found.zip(sums) {
        assert!((found - sum).abs() < 1e-9 * COUNT as f64, "{found} {sum}");
    }
}
