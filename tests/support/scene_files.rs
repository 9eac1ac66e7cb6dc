//! Synthetic Gaussians, and the files that a trainer would write for them.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::fmt::Write as _;

use wildcity_scene::{Gaussians, sh};

/// Uniform numbers in [0, 1), the same for the same seed (splitmix64).
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((x ^ (x >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    pub(crate) fn between(&mut self, low: f64, high: f64) -> f32 {
        (low + (high - low) * self.unit()) as f32
    }

    pub(crate) fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            items.swap(i, (self.unit() * (i + 1) as f64) as usize);
        }
    }
}

/// `n` plausible Gaussians within `reach_m` of the origin; every number is an f32.
pub(crate) fn gaussians(n: usize, sh_degree: u8, reach_m: f64, seed: u64) -> Gaussians {
    let mut random = Random(seed);
    let mut g = Gaussians::with_capacity(sh_degree, n);
    for _ in 0..n {
        g.means_m.push([0; 3].map(|_| random.between(-reach_m, reach_m).into()));
        g.quats_wxyz.push([0; 4].map(|_| random.between(0.1, 1.0)));
        g.ln_scales.push([0; 3].map(|_| random.between(-7.0, -1.0)));
        g.logit_opacities.push(random.between(-5.0, 5.0));
        g.sh.extend((0..3 * sh::coefficients(sh_degree)).map(|_| random.between(-1.0, 1.0)));
    }
    g
}

/// A column of a PLY file.
#[derive(Clone, Debug)]
pub(crate) struct Column {
    pub(crate) name: String,
    pub(crate) is_double: bool,
}

/// INRIA's columns in INRIA's order.
pub(crate) fn inria_columns(sh_degree: u8, normals: bool) -> Vec<Column> {
    let rest = 3 * (sh::coefficients(sh_degree) - 1);
    let mut names = vec!["x".to_owned(), "y".into(), "z".into()];
    names.extend(["nx", "ny", "nz"].iter().filter(|_| normals).map(|&n| n.to_owned()));
    names.extend((0..3).map(|i| format!("f_dc_{i}")));
    names.extend((0..rest).map(|i| format!("f_rest_{i}")));
    names.push("opacity".into());
    names.extend((0..3).map(|i| format!("scale_{i}")));
    names.extend((0..4).map(|i| format!("rot_{i}")));
    names.into_iter().map(|name| Column { name, is_double: false }).collect()
}

/// A PLY file with these columns.
pub(crate) fn ply(gaussians: &Gaussians, columns: &[Column]) -> Vec<u8> {
    let mut file = ply_header(gaussians.len(), columns).into_bytes();
    for index in 0..gaussians.len() {
        for column in columns {
            let value = value(gaussians, index, &column.name);
            if column.is_double {
                file.extend(value.to_le_bytes())
            } else {
                file.extend((value as f32).to_le_bytes())
            }
        }
    }
    file
}

/// The header of such a file.
pub(crate) fn ply_header(count: usize, columns: &[Column]) -> String {
    let mut header = String::from("ply\nformat binary_little_endian 1.0\ncomment made by a test\n");
    writeln!(header, "element vertex {count}").unwrap();
    for column in columns {
        let kind = if column.is_double { "double" } else { "float" };
        writeln!(header, "property {kind} {}", column.name).unwrap();
    }
    header + "end_header\n"
}

/// The value of a Gaussian for a column name of a PLY file; 0.25 for columns that are not of
/// Gaussians.
fn value(g: &Gaussians, index: usize, name: &str) -> f64 {
    let (stem, number) = match name.rsplit_once('_') {
        Some((stem, digits)) => (stem, digits.parse::<usize>().unwrap()),
        None => (name, 0),
    };
    let coefficients = sh::coefficients(g.sh_degree);
    match stem {
        "x" => g.means_m[index][0],
        "y" => g.means_m[index][1],
        "z" => g.means_m[index][2],
        "rot" => g.quats_wxyz[index][number].into(),
        "scale" => g.ln_scales[index][number].into(),
        "opacity" => g.logit_opacities[index].into(),
        "f_dc" => g.sh_at(index)[number].into(),
        "f_rest" => {
            let (channel, k) = (number / (coefficients - 1), number % (coefficients - 1) + 1);
            g.sh_at(index)[3 * k + channel].into()
        }
        _ => 0.25,
    }
}

/// A tensor of a safetensors file: name, shape, values.
pub(crate) type Tensor = (&'static str, Vec<usize>, Vec<f64>);

/// Tensors of a gsplat checkpoint.
pub(crate) fn gsplat_tensors(g: &Gaussians) -> Vec<Tensor> {
    let (n, k) = (g.len(), sh::coefficients(g.sh_degree));
    let double = |values: &[f32]| values.iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
    let colour = |from: usize, to: usize| {
        g.sh.chunks(3 * k).flat_map(|c| double(&c[3 * from..3 * to])).collect::<Vec<_>>()
    };
    let mut tensors = vec![
        ("opacities", vec![n], double(&g.logit_opacities)),
        ("means", vec![n, 3], g.means_m.as_flattened().to_vec()),
        ("sh0", vec![n, 1, 3], colour(0, 1)),
        ("scales", vec![n, 3], double(g.ln_scales.as_flattened())),
        ("quats", vec![n, 4], double(g.quats_wxyz.as_flattened())),
    ];
    if k > 1 {
        tensors.push(("shN", vec![n, k - 1, 3], colour(1, k)));
    }
    tensors
}

/// A safetensors file; `doubles` names the tensors in F64.
pub(crate) fn safetensors(tensors: &[Tensor], doubles: &[&str]) -> Vec<u8> {
    let (mut body, mut entries) = (Vec::new(), Vec::new());
    for (name, shape, values) in tensors {
        let (start, is_double) = (body.len(), doubles.contains(name));
        for &value in values {
            if is_double {
                body.extend(value.to_le_bytes())
            } else {
                body.extend((value as f32).to_le_bytes())
            }
        }
        let (dtype, end) = (if is_double { "F64" } else { "F32" }, body.len());
        entries.push(format!(
            r#""{name}":{{"dtype":"{dtype}","shape":{shape:?},"data_offsets":[{start},{end}]}}"#
        ));
    }
    let header = format!("{{{}}}", entries.join(","));
    [&(header.len() as u64).to_le_bytes(), header.as_bytes(), &body].concat()
}
