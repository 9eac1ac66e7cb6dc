//! One scene, a skull, in every format: each Gaussian is within the steps of the format, and images
//! reach a PSNR.

use std::collections::HashMap;

use glam::DVec3;
use wildcity_render::View;
use wildcity_scene::{Gaussians, RenderProfile, Scene, sh};
use wildcity_twin::ingest::{self, Axes};

use crate::data;
use crate::images::{cpu, psnr, render, view_along};

/// Tolerances to the original's numbers.
#[derive(Clone, Copy, Debug)]
struct Steps {
    mean_m: f64,
    /// Of the unit quaternion.
    quat: f32,
    ln_scale: f32,
    /// Of 0 to 1.
    opacity: f32,
    dc: f32,
    sh: f32,
    /// Clamps numbers as the format does.
    fit: fn(&mut Gaussians),
}

/// The least PSNR of images, in dB.
struct Loss {
    /// Against the original, clamped as in the format: the loss by quantisation.
    fitted: f64,
    /// Against the original.
    whole: f64,
}

/// The file's axes, in the original's.
const SAME: &str = "identity";
const RUB: &str = "1 0 0 0 -1 0 0 0 -1";
const KHR: &str = "-1 0 0 0 -1 0 0 0 1";

#[test]
fn splat() {
    // f32 positions and scales; bytes that were truncated, not rounded. Colours are clamped to 0
    // and 1.
    let steps = Steps {
        mean_m: 0.0,
        quat: 1.5 / 128.0,
        ln_scale: 1e-5,
        opacity: 1.1 / 255.0,
        dc: 0.0145,
        sh: 0.0,
        fit: |g| g.sh.iter_mut().for_each(|c| *c = c.clamp(-1.7725, 1.7725)),
    };
    check(
        "skull.splat",
        SAME,
        "scenes/skull/skull.ply",
        0,
        steps,
        Loss { fitted: 59.0, whole: 45.0 },
    );
}

#[test]
fn spz() {
    let two = Steps {
        mean_m: 0.51 / 4096.0,
        // x, y, and z are within 0.51/127.5 = 0.004; w, which follows from length 1, is within
        // √(2 √3 0.004) = 0.118 where it is nearly 0.
        quat: 0.118,
        ln_scale: 0.51 / 16.0,
        opacity: 0.51 / 255.0,
        dc: 0.51 / 255.0 / 0.15,
        // 4 bits of 8 for degrees 2 and 3.
        sh: 0.51 / 8.0,
        fit: |g| {
            g.ln_scales.as_flattened_mut().iter_mut().for_each(|ln| *ln = ln.max(-10.0));
            for (i, c) in g.sh.iter_mut().enumerate() {
                let most = if i % 48 < 3 { 0.5 / 0.15 } else { 1.0 };
                *c = c.clamp(-most, most);
            }
        },
    };
    // The largest component follows from the others, so it is off by three times as much where all
    // are 0.5.
    let three = Steps { quat: 3.0 * 0.51 * 0.7072 / 511.0, ..two };
    for (file, axes, steps) in [
        ("skull.rub.v2.spz", RUB, two),
        ("skull.rub.v3.spz", RUB, three),
        ("skull.rub.v4.spz", RUB, three),
        ("skull.v4.spz", SAME, three),
    ] {
        check(file, axes, "scenes/skull/skull.ply", 3, steps, Loss { fitted: 47.0, whole: 47.0 });
    }
}

#[test]
fn another_capture_in_spz() {
    // Both were quantised: the steps of the compressed PLY depend on a chunk's range.
    let steps = Steps {
        mean_m: 1e-3,
        quat: 4e-3,
        ln_scale: 0.05,
        opacity: 1.51 / 255.0,
        dc: 0.03,
        sh: 0.0,
        fit: |g| g.ln_scales.as_flattened_mut().iter_mut().for_each(|ln| *ln = ln.max(-10.0)),
    };
    let original = "scenes/biker/biker.compressed.ply";
    let loss = Loss { fitted: 40.0, whole: 40.0 };
    check("../scenes/biker/biker.spz", RUB, original, 0, steps, loss);
}

#[test]
fn sog() {
    // The PLY was made from this file, without floaters: only rounding to f32 lies between.
    let exact = Steps {
        mean_m: 1e-7,
        quat: 1e-6,
        ln_scale: 1e-6,
        opacity: 1e-6,
        dc: 1e-6,
        sh: 1e-6,
        fit: |_| (),
    };
    check(
        "skull_full_94936.sog",
        SAME,
        "scenes/skull/skull.ply",
        3,
        exact,
        Loss { fitted: 150.0, whole: 150.0 },
    );
    // Truncated, not rounded; scales from a codebook, colours from the centroid of similar ones.
    let again = Steps {
        mean_m: 3e-5,
        quat: 3.0 * 1.01 * 1.4143 / 255.0,
        ln_scale: 0.035,
        opacity: 1.01 / 255.0,
        dc: 1e-6,
        sh: 0.18,
        fit: |_| (),
    };
    check(
        "sog_sh1/skull_sh1.sog",
        SAME,
        "scenes/skull/skull.ply",
        1,
        again,
        Loss { fitted: 51.0, whole: 51.0 },
    );
}

#[test]
fn gltf() {
    // f32 throughout; scales and opacities were activated, and are converted back.
    let steps = Steps {
        mean_m: 1e-9,
        quat: 1e-7,
        ln_scale: 5e-7,
        opacity: 2e-7,
        dc: 1e-9,
        sh: 1e-9,
        fit: |_| (),
    };
    check(
        "skull_small.glb",
        KHR,
        "conformance/skull_small.ply",
        3,
        steps,
        Loss { fitted: 150.0, whole: 150.0 },
    );
}

#[test]
fn ksplat() {
    // Level 0: f32, except for colour and opacity.
    let steps = Steps {
        mean_m: 1e-7,
        quat: 1e-6,
        ln_scale: 2e-6,
        opacity: 1.01 / 255.0,
        dc: 1.01 / 255.0 / 0.282,
        sh: 1e-6,
        fit: |g| {
            let dc = g.sh.chunks_exact_mut(27).flat_map(|colour| &mut colour[..3]);
            dc.for_each(|c| *c = c.clamp(-1.7725, 1.7725));
        },
    };
    // Colours above 1 before the higher degrees darken them, a fifth of all blue values, are
    // clamped to 1.
    check(
        "skull_small.c0.sh2.ksplat",
        SAME,
        "conformance/skull_small.ply",
        2,
        steps,
        Loss { fitted: 62.0, whole: 37.5 },
    );
}

#[test]
fn nurec() {
    // f16 throughout: 11 bits of the largest number of each kind.
    let half = 0.51 / 1024.0;
    let steps = Steps {
        mean_m: 1.1 * f64::from(half),
        quat: 2.0 * half,
        ln_scale: 18.0 * half,
        opacity: 2.0 * half,
        dc: 4.0 * half,
        sh: 2.0 * half,
        fit: |_| (),
    };
    check(
        "skull.nurec.usdz",
        SAME,
        "scenes/skull/skull.ply",
        3,
        steps,
        Loss { fitted: 60.0, whole: 60.0 },
    );
}

/// Reads a file of the conformance set, and compares it with the original, Gaussian by Gaussian and
/// as images. If one of the two is a part of the other, only that part is compared.
fn check(file: &str, axes: &str, original: &str, sh_degree: u8, steps: Steps, at_least_db: Loss) {
    let Some(path) = data::real(&format!("conformance/{file}")) else { return };
    let mut read = ingest::read(&path, &mut |_, _| {}).unwrap_or_else(|e| panic!("{file}: {e}"));
    axes.parse::<Axes>().unwrap().apply(&mut read);
    assert_eq!(read.sh_degree, sh_degree, "{file}");
    let original = ingest::read(&data::real(original).unwrap(), &mut |_, _| {}).unwrap();
    let original = cut(&original, sh_degree);
    let mut fitted = original.clone();
    (steps.fit)(&mut fitted);
    // The matching Gaussians of both, in one order.
    let find = |few: &Gaussians, many: &Gaussians| {
        matches(few, many, steps).unwrap_or_else(|strange| panic!("{file}: {strange}"))
    };
    let (read, fitted, original) = if read.len() > original.len() {
        (read.select(find(&fitted, &read)), fitted, original)
    } else {
        let found = find(&read, &fitted);
        (read, fitted.select(found.iter().copied()), original.select(found.iter().copied()))
    };
    let off = |i: usize| off(&read, i, &fitted, i, steps);
    let most = (0..read.len()).map(off).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
    assert!(most.0 >= 0.5, "{file}: nothing is more than {most:?} steps off; they are too wide");
    for (of, at_least) in [(&fitted, at_least_db.fitted), (&original, at_least_db.whole)] {
        for (number, db) in losses_db(&read, of).into_iter().enumerate() {
            assert!(db >= at_least, "{file}, view {number}: {db:.1} dB, not {at_least}");
        }
    }
}

/// The same Gaussians with colours of a lower degree.
fn cut(g: &Gaussians, sh_degree: u8) -> Gaussians {
    let sh = (0..g.len()).flat_map(|i| &g.sh_at(i)[..3 * sh::coefficients(sh_degree)]).copied();
    Gaussians { sh_degree, sh: sh.collect(), ..g.clone() }
}

/// For every Gaussian, the one of the other scene within the tolerances, in any order.
fn matches(few: &Gaussians, many: &Gaussians, steps: Steps) -> Result<Vec<usize>, String> {
    const CELL_M: f64 = 0.01;
    let cell = |m: &[f64; 3]| m.map(|x| (x / CELL_M).round() as i32);
    let mut cells: HashMap<[i32; 3], Vec<usize>> = HashMap::new();
    for (index, mean) in many.means_m.iter().enumerate() {
        cells.entry(cell(mean)).or_default().push(index);
    }
    let find = |i: usize| {
        let [x, y, z] = cell(&few.means_m[i]);
        let around = (0..27).map(|k| [x + k % 3 - 1, y + k / 3 % 3 - 1, z + k / 9 - 1]);
        let near = around.filter_map(|at| cells.get(&at)).flatten();
        let off = near.map(|&j| (off(few, i, many, j, steps), j));
        match off.min_by(|a, b| a.0.0.total_cmp(&b.0.0)) {
            Some(((off, _), j)) if off <= 1.0 => Ok(j),
            Some(((off, field), j)) => {
                Err(format!("{i} is {off} steps of {field} off its nearest, {j}"))
            }
            None => Err(format!("{i} has none near {:?}", few.means_m[i])),
        }
    };
    (0..few.len()).map(find).collect()
}

/// The largest difference of two Gaussians, in tolerances, and its field.
fn off(a: &Gaussians, i: usize, b: &Gaussians, j: usize, steps: Steps) -> (f64, &'static str) {
    let widest = |a: &[f32], b: &[f32], step: f32| {
        let apart = a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs()));
        apart.fold(0.0, f64::max) / f64::from(step.max(1e-9))
    };
    let unit = |q: [f32; 4]| {
        let length = q.iter().map(|q| q * q).sum::<f32>().sqrt();
        q.map(|q| q / length)
    };
    let p = unit(a.quats_wxyz[i]);
    let q = unit(b.quats_wxyz[j]);
    // An ellipsoid is the same after half a turn around one of its own axes, and as -q.
    let [w, x, y, z] = q;
    let turned = [[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]];
    let turned = turned.into_iter().flat_map(|q| [q, q.map(|q| -q)]);
    let quat = turned.map(|q| widest(&p, &q, steps.quat)).fold(f64::INFINITY, f64::min);
    let opacity = |logit: f32| 1.0 / (1.0 + (-logit).exp());
    let opacity = [opacity(a.logit_opacities[i]), opacity(b.logit_opacities[j])];
    // Colours beyond the range of the format's byte were clamped.
    let dc = |g: &Gaussians, i: usize| -> [f32; 3] { std::array::from_fn(|c| g.sh_at(i)[c]) };
    let mean = (0..3).map(|k| (a.means_m[i][k] - b.means_m[j][k]).abs()).fold(0.0, f64::max);
    [
        (mean / steps.mean_m.max(1e-9), "position"),
        (quat, "rotation"),
        (widest(&a.ln_scales[i], &b.ln_scales[j], steps.ln_scale), "ln scale"),
        (widest(&opacity[..1], &opacity[1..], steps.opacity), "opacity"),
        (widest(&dc(a, i), &dc(b, j), steps.dc), "colour"),
        (widest(&a.sh_at(i)[3..], &b.sh_at(j)[3..], steps.sh), "colour coefficients"),
    ]
    .into_iter()
    .fold((0.0, ""), |most, next| if next.0 > most.0 { next } else { most })
}

/// PSNR of images of the two, from the front and obliquely from above.
fn losses_db(read: &Gaussians, original: &Gaussians) -> Vec<f64> {
    let views = [DVec3::new(0.0, 0.0, -1.0), DVec3::new(0.8, -0.5, -0.4)].map(|side| -> View {
        let centre_m = DVec3::new(0.0, -0.53, 0.04);
        let forward = -side.normalize();
        view_along([480, 480], 480.0, centre_m - 2.2 * forward, forward, DVec3::Y)
    });
    let profile = RenderProfile { near: 0.2, ..RenderProfile::default() };
    let images =
        [read, original].map(|g| render(&cpu(), &Scene::from_gaussians(g), &profile, &views));
    let pairs = images[0].iter().zip(&images[1]);
    pairs.map(|(a, b)| psnr(&a.rgba, &b.rgba)).collect()
}
