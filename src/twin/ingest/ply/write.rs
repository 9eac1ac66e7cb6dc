//! Writing Gaussians as INRIA's PLY, which every trainer and viewer reads.

use std::io::{self, Write};

use wildcity_scene::{Gaussians, sh};

use crate::ingest::classes;

/// Largest rounding of a mean to f32: others are written as f64.
const MOST_ROUNDING_M: f64 = 1e-4;

/// Writes Gaussians in the layout of Kerbl et al. 2023, little-endian: means, normals (0),
/// spherical harmonics channel by channel, opacities before the sigmoid, logarithms of the scales,
/// quaternions (w, x, y, z), and classes as uchar if there are some. Means far from the origin are
/// of type double.
///
/// # Errors
/// The writer fails.
pub fn write_ply(gaussians: &Gaussians, out: &mut impl Write) -> io::Result<()> {
    let rest = 3 * (sh::coefficients(gaussians.sh_degree) - 1);
    let rounding = |m: &f64| (*m - f64::from(*m as f32)).abs();
    // From about 2 km on, f32 rounds by more than this.
    let is_far = gaussians.means_m.iter().flatten().any(|m| rounding(m) > MOST_ROUNDING_M);
    let of_mean = if is_far { "double" } else { "float" };
    writeln!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {}", gaussians.len())?;
    for axis in ["x", "y", "z"] {
        writeln!(out, "property {of_mean} {axis}")?;
    }
    let named = |name: &str, count: usize| (0..count).map(|k| format!("{name}{k}")).collect();
    let normals: Vec<String> = ["nx", "ny", "nz"].map(str::to_owned).to_vec();
    let columns: [Vec<String>; 6] = [
        normals,
        named("f_dc_", 3),
        named("f_rest_", rest),
        vec!["opacity".to_owned()],
        named("scale_", 3),
        named("rot_", 4),
    ];
    for column in columns.iter().flatten() {
        writeln!(out, "property float {column}")?;
    }
    if gaussians.classes.is_some() {
        writeln!(out, "property uchar {}", classes::NAME)?;
    }
    writeln!(out, "end_header")?;
    for i in 0..gaussians.len() {
        for m in gaussians.means_m[i] {
            if is_far {
                out.write_all(&m.to_le_bytes())?;
            } else {
                out.write_all(&(m as f32).to_le_bytes())?;
            }
        }
        let sh = gaussians.sh_at(i);
        // All values of red, then of green, then of blue.
        let channel = |c: usize| (1..=rest / 3).map(move |k| sh[3 * k + c]);
        let values = [0.0; 3]
            .into_iter()
            .chain([sh[0], sh[1], sh[2]])
            .chain((0..3).flat_map(channel))
            .chain([gaussians.logit_opacities[i]])
            .chain(gaussians.ln_scales[i])
            .chain(gaussians.quats_wxyz[i]);
        for value in values {
            out.write_all(&value.to_le_bytes())?;
        }
        if let Some(classes) = &gaussians.classes {
            out.write_all(&[classes[i].value()])?;
        }
    }
    Ok(())
}
