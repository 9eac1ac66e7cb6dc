//! Numbers that the gate at import refuses, injected past it.

use wildcity::scene::Gaussians;

type Poison = fn(&mut Gaussians, f32);

const POISONS: [(&str, Poison); 5] = [
    ("mean", |g, bad| g.means_m[0][1] = bad.into()),
    ("quaternion", |g, bad| g.quats_wxyz[0][2] = bad),
    ("scale", |g, bad| g.ln_scales[0][0] = bad),
    ("colour", |g, bad| g.sh[0] = bad),
    ("colour by direction", |g, bad| g.sh[4] = bad),
];

/// The same Gaussians of SH degree 1, and one more before all others of the file: nearly opaque, of
/// 14 cm.
pub(crate) fn with_one_more(good: &Gaussians, mean_m: [f64; 3]) -> Gaussians {
    let mut more = good.clone();
    more.means_m.insert(0, mean_m);
    more.quats_wxyz.insert(0, [1.0, 0.0, 0.0, 0.0]);
    more.ln_scales.insert(0, [-2.0; 3]);
    more.logit_opacities.insert(0, 4.0);
    more.sh.splice(0..0, [1.0; 12]);
    more
}

/// The same Gaussians with each poison in the first one, by name.
pub(crate) fn poisoned(more: &Gaussians) -> Vec<(String, Gaussians)> {
    let mut all = Vec::new();
    let mut add = |name: String, poison: &dyn Fn(&mut Gaussians)| {
        let mut poisoned = more.clone();
        poison(&mut poisoned);
        all.push((name, poisoned));
    };
    for (name, poison) in POISONS {
        for bad in [f32::NAN, f32::INFINITY] {
            add(format!("{name} {bad}"), &|g| poison(g, bad));
        }
    }
    add("opacity NaN".to_owned(), &|g| g.logit_opacities[0] = f32::NAN);
    add("colour of a million".to_owned(), &|g| g.sh[0] = 1e6);
    add("no rotation".to_owned(), &|g| g.quats_wxyz[0] = [0.0; 4]);
    all
}
