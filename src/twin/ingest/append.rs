//! Several scenes in one.

use std::ops::Range;

use wildcity_scene::{Gaussians, sh};

/// Appends some Gaussians of another scene. Where the colours' degrees differ, the lower ones get
/// zeros for what they have not.
pub(super) fn append(all: &mut Gaussians, part: &Gaussians, range: Range<usize>) {
    if part.sh_degree > all.sh_degree {
        let raised = (0..all.len()).flat_map(|i| raised(all.sh_of(i), part.sh_degree)).collect();
        all.sh = raised;
        all.sh_degree = part.sh_degree;
    }
    all.means_m.extend_from_slice(&part.means_m[range.clone()]);
    all.quats_wxyz.extend_from_slice(&part.quats_wxyz[range.clone()]);
    all.ln_scales.extend_from_slice(&part.ln_scales[range.clone()]);
    all.logit_opacities.extend_from_slice(&part.logit_opacities[range.clone()]);
    all.sh.extend(range.flat_map(|i| raised(part.sh_of(i), all.sh_degree)));
}

fn raised(colour: &[f32], sh_degree: u8) -> impl Iterator<Item = f32> {
    let zeros = std::iter::repeat(0.0);
    colour.iter().copied().chain(zeros).take(3 * sh::coefficients(sh_degree))
}
