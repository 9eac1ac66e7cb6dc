//! Files made by other programs.

use std::collections::HashMap;

use wildcity_scene::Gaussians;
use wildcity_twin::ingest;

use crate::data;

fn read(file: &str) -> Option<Gaussians> {
    let path = data::real(file)?;
    Some(ingest::read(&path, &mut |_, _| {}).unwrap_or_else(|e| panic!("{file}: {e}")))
}

/// The bits of one Gaussian, to find it in another file.
fn bits(g: &Gaussians, index: usize) -> Vec<u32> {
    let mean = g.means_m[index].map(|m| m as f32);
    let opacity = [g.logit_opacities[index]];
    let parts: [&[f32]; 5] =
        [&mean, &g.quats_wxyz[index], &g.ln_scales[index], &opacity, g.sh_at(index)];
    parts.concat().into_iter().map(f32::to_bits).collect()
}

#[test]
fn the_skull_is_what_its_readme_says() {
    let Some(skull) = read("scenes/skull/skull.ply") else { return };
    assert_eq!((skull.len(), skull.sh_degree), (82_621, 3));
    let Some(train) = read("scenes/train-1000.ply") else { return };
    assert_eq!((train.len(), train.sh_degree), (1_000, 3));
    let lengths = train.quats_wxyz.iter().map(|q| q.iter().map(|q| q * q).sum::<f32>().sqrt());
    let (low, high) = lengths.fold((9.0_f32, 0.0_f32), |(l, h), x| (l.min(x), h.max(x)));
    assert!((0.63..0.65).contains(&low) && (1.31..1.33).contains(&high), "{low} to {high}");
}

#[test]
fn the_small_skull_is_the_same_in_both_formats_and_a_part_of_the_whole() {
    let Some(skull) = read("scenes/skull/skull.ply") else { return };
    let Some(from_ply) = read("conformance/skull_small.ply") else { return };
    let Some(from_tensors) = read("conformance/skull_small.safetensors") else { return };
    assert_eq!(from_ply.len(), 19_300);
    assert!(from_ply == from_tensors, "the two formats differ");
    let whole: HashMap<_, _> = (0..skull.len()).map(|i| (bits(&skull, i), i)).collect();
    let missing = (0..from_ply.len()).filter(|&i| !whole.contains_key(&bits(&from_ply, i))).count();
    assert_eq!(missing, 0, "Gaussians of the small skull that the whole has not");
    assert!(from_ply.logit_opacities.iter().all(|&logit| logit > 0.0), "opacity above 0.5");
}

#[test]
fn gsplats_own_test_case_is_read() {
    let Some(case) = read("reference/gsplat_tiny_case.safetensors") else { return };
    assert_eq!((case.len(), case.sh_degree), (4, 3));
}

#[test]
fn three_gaussians_of_train_are_read() {
    let file = "conformance/metalsplatter/test-splat.3-points-from-train.ply";
    let Some(three) = read(file) else { return };
    assert_eq!((three.len(), three.sh_degree), (3, 3));
}

/// The compressed skull is the skull: same Gaussians within the steps of its quantisation, though
/// in another order, so each is compared with its nearest of the original.
#[test]
fn compressed_ply_matches_its_source() {
    let Some(skull) = read("scenes/skull/skull.ply") else { return };
    let Some(compressed) = read("conformance/skull.compressed.ply") else { return };
    assert_eq!((compressed.len(), compressed.sh_degree), (82_621, 3));
    // 1 cm buckets around every original.
    let bucket = |m: &[f64; 3]| m.map(|x| (x / 0.01).round() as i32);
    let mut originals: HashMap<[i32; 3], Vec<usize>> = HashMap::new();
    for (index, mean) in skull.means_m.iter().enumerate() {
        originals.entry(bucket(mean)).or_default().push(index);
    }
    let mut matched = 0;
    let sampled = (0..compressed.len()).step_by(40);
    let total = sampled.len();
    for i in sampled {
        let [x, y, z] = bucket(&compressed.means_m[i]);
        let around = (-1..=1)
            .flat_map(|dx| (-1..=1).flat_map(move |dy| (-1..=1).map(move |dz| [dx, dy, dz])));
        let near =
            around.filter_map(|[dx, dy, dz]| originals.get(&[x + dx, y + dy, z + dz])).flatten();
        matched += usize::from(near.into_iter().any(|&j| is_alike(&compressed, i, &skull, j)));
    }
    assert!(matched * 100 >= total * 99, "{matched} of {total} found");
}

fn is_alike(a: &Gaussians, i: usize, b: &Gaussians, j: usize) -> bool {
    let close = |a: &[f32], b: &[f32], by: f32| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= by);
    let unit = |q: [f32; 4]| {
        let length = q.iter().map(|q| q * q).sum::<f32>().sqrt();
        q.map(|q| q / length)
    };
    let p = unit(a.quats_wxyz[i]);
    let q = unit(b.quats_wxyz[j]);
    let dot: f32 = p.iter().zip(q).map(|(p, q)| p * q).sum();
    let sigmoid = |logit: f32| 1.0 / (1.0 + (-logit).exp());
    let apart = |axis: usize| (a.means_m[i][axis] - b.means_m[j][axis]).abs();
    (0..3).all(|axis| apart(axis) < 2e-3)
        && dot.abs() > 0.9999
        && close(&a.ln_scales[i], &b.ln_scales[j], 0.05)
        && (sigmoid(a.logit_opacities[i]) - sigmoid(b.logit_opacities[j])).abs() < 0.01
        && close(&a.sh_at(i)[..3], &b.sh_at(j)[..3], 0.05)
        // 8 bits over [-4, 4] are steps of 0.031.
        && close(&a.sh_at(i)[3..], &b.sh_at(j)[3..], 0.02)
}

#[test]
fn the_biker_and_the_guitar_are_read_compressed() {
    let Some(biker) = read("scenes/biker/biker.compressed.ply") else { return };
    assert_eq!((biker.len(), biker.sh_degree), (152_746, 0));
    let Some(guitar) = read("scenes/guitar/guitar.compressed.ply") else { return };
    assert_eq!((guitar.len(), guitar.sh_degree), (90_854, 0));
}

/// Means within a box.
fn is_within(g: &Gaussians, low: [f64; 3], high: [f64; 3]) -> bool {
    g.means_m.iter().all(|m| (0..3).all(|i| (low[i]..=high[i]).contains(&m[i])))
}

#[test]
fn a_sog_of_the_first_version_is_read() {
    let Some(logo) = read("scenes/playcanvas-logo/meta.json") else { return };
    assert_eq!((logo.len(), logo.sh_degree), (307_128, 0));
    // What meta.json says, of logarithms: exp(0.93) - 1 = 1.535, and so on.
    let low = [-1.535, -2.782, -0.577];
    let high = [1.535, 0.296, 0.577];
    assert!(is_within(&logo, low, high));
    // The extremes occur, so the range is used fully.
    let most = |axis: usize| logo.means_m.iter().map(|m| m[axis]).fold(f64::MIN, f64::max);
    for (axis, wanted) in [(0, 1.5348), (1, 0.2957), (2, 0.5768)] {
        assert!((most(axis) - wanted).abs() < 1e-4, "{}", most(axis));
    }
}

#[test]
fn a_streamed_sog_is_read_in_full_detail() {
    let Some(playbot) = read("scenes/playbot/lod-meta.json") else { return };
    assert_eq!((playbot.len(), playbot.sh_degree), (500_000, 2));
    let low = [-1.033496, -1.083135, -1.039343];
    let high = [1.03509, 0.05205518, 1.042389];
    assert!(is_within(&playbot, low, high));
    // Only the finest level, in one file, gives the same.
    let finest = read("scenes/playbot/0_0/meta.json").unwrap();
    assert!(playbot == finest, "the leaves of level 0 are its whole file");
}

#[test]
fn small_files_of_other_programs_are_read() {
    // Four corners of a square of 1, at opacity 0.9 (230/255), with a deviation of 0.1.
    let four = "conformance/splat-transform-fixtures/splat/minimal";
    for (file, z) in [
        (".splat", -1.0),
        (".ksplat", -1.0),
        ("-raw.spz", -1.0),
        ("-v2.spz", -1.0),
        ("-v3.spz", 1.0),
        ("-v4.spz", 1.0),
    ] {
        let Some(g) = read(&format!("{four}{file}")) else { return };
        assert_eq!(g.sh_degree, 0, "{file}");
        let corners = [[-1.0, 0.0, z], [0.0, 0.0, z], [-1.0, 0.0, 0.0], [0.0; 3]];
        assert_eq!(g.means_m, corners, "{file}");
        let ln = g.ln_scales.as_flattened().iter();
        assert!(ln.copied().all(|ln| (ln - 0.1_f32.ln()).abs() < 1.0 / 32.0), "{file}");
        assert!(g.logit_opacities.iter().all(|logit| (logit - 2.2192).abs() < 1e-4), "{file}");
    }
    let folder = "conformance/metalsplatter/test-splat.3-points-from-train";
    let ply = read(&format!("{folder}.ply")).unwrap();
    for (file, flip) in [("splat", 1.0), ("spz", -1.0)] {
        let g = read(&format!("{folder}.{file}")).unwrap();
        assert_eq!(g.len(), 3);
        for (mean, wanted) in g.means_m.iter().zip(&ply.means_m) {
            let wanted = [wanted[0], flip * wanted[1], flip * wanted[2]];
            assert!((0..3).all(|i| (mean[i] - wanted[i]).abs() < 1.3e-4), "{file}");
        }
        for (i, quat) in g.quats_wxyz.iter().enumerate() {
            let wanted = ply.quats_wxyz[i];
            let length = wanted.iter().map(|q| q * q).sum::<f32>().sqrt();
            let dot = quat[0] * wanted[0] + quat[1] * wanted[1];
            let dot = dot + flip as f32 * (quat[2] * wanted[2] + quat[3] * wanted[3]);
            assert!((dot / length).abs() > 0.99, "{file} {quat:?} {wanted:?}");
        }
    }
}

#[test]
fn every_component_type_of_gltf_is_read() {
    let folder = "conformance/khr_fixtures_bevy";
    for file in ["khr_conformance_matrix.glb", "khr_conformance_matrix.gltf"] {
        let Some(g) = read(&format!("{folder}/{file}")) else { return };
        assert_eq!((g.len(), g.sh_degree), (15, 3));
        assert!(g.means_m.iter().all(|m| *m == [1.0, 2.0, 3.0]));
        // Only x, as f32 and as normalised i8 and i16.
        assert!(g.quats_wxyz.iter().all(|q| *q == [0.0, 1.0, 0.0, 0.0]));
        // Logarithms, of the draft that the files follow: f32, i8, normalised i8, i16, normalised
        // i16.
        let scales = [[0.2, -0.1, 0.7], [1., -2., 3.], [1., 0., -1.], [2., -3., 4.], [1., 0., -1.]];
        assert_eq!(g.ln_scales[3..8], scales);
        let opacities = g.logit_opacities.iter().map(|logit| 1.0 / (1.0 + (-logit).exp()));
        let opacities: Vec<f32> = opacities.collect();
        for (index, wanted) in [(8, 0.75), (9, 64.0 / 255.0), (10, 16384.0 / 65535.0)] {
            assert!((opacities[index] - wanted).abs() < 1e-6, "{opacities:?}");
        }
        // 0.1, 0.2, 0.3, then 1.1, 1.2, 1.3 and so on; zeros above the primitive's degree.
        for (index, coefficients) in [(11, 1), (12, 4), (13, 9), (14, 16)] {
            for (k, &value) in g.sh_at(index).iter().enumerate() {
                let wanted = (k / 3) as f32 + 0.1 * (k % 3 + 1) as f32;
                let wanted = if k / 3 < coefficients { wanted } else { 0.0 };
                assert!((value - wanted).abs() < 1e-5, "{index} {k}: {value}");
            }
        }
    }
    // Without SH it has only COLOR_0.
    let fallback = read(&format!("{folder}/khr_extensible_fallback.gltf")).unwrap();
    let colour: Vec<f32> = fallback.sh.iter().map(|c| 0.282_094_8 * c + 0.5).collect();
    // It is linear light: 0.282, 0.564 and 0.846.
    let wanted = [0.567_659_2, 0.776_150_3, 0.929_126_5];
    assert!(colour.iter().zip(wanted).all(|(c, w)| (c - w).abs() < 1e-5), "{colour:?}");
}
