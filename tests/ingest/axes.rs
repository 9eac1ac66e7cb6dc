use glam::{DMat3, DQuat, DVec3};
use wildcity_scene::{Gaussians, sh};
use wildcity_twin::ingest::Axes;

use crate::scene_files::gaussians;

const PRESETS: [&str; 4] = ["identity", "y-down-z-forward", "y-up-z-back", "y-up-z-forward"];

fn moved(axes: &str, scale: f64) -> (Gaussians, Gaussians) {
    let plain = gaussians(20, 3, 10.0, 1);
    let mut moved = plain.clone();
    axes.parse::<Axes>().unwrap().scaled(scale).unwrap().apply(&mut moved);
    (plain, moved)
}

fn covariance(g: &Gaussians, index: usize) -> DMat3 {
    let [w, x, y, z] = g.quats_wxyz[index].map(f64::from);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scale = g.ln_scales[index].map(|ln| f64::from(ln).exp());
    let half = rotation * DMat3::from_diagonal(DVec3::from_array(scale));
    half * half.transpose()
}

fn colour(g: &Gaussians, index: usize, direction: DVec3) -> DVec3 {
    let terms = g.sh_at(index).chunks_exact(3).zip(sh::basis(direction));
    terms.fold(DVec3::ZERO, |sum, (c, b)| {
        sum + b * DVec3::from_array([c[0], c[1], c[2]].map(f64::from))
    })
}

#[test]
fn presets_put_up_where_up_is() {
    let up_right_forward = [
        ("identity", [0., 0., 1.], [1., 0., 0.], [0., 1., 0.]),
        ("y-down-z-forward", [0., -1., 0.], [1., 0., 0.], [0., 0., 1.]),
        ("y-up-z-back", [0., 1., 0.], [1., 0., 0.], [0., 0., -1.]),
        ("y-up-z-forward", [0., 1., 0.], [1., 0., 0.], [0., 0., 1.]),
    ];
    for (preset, up, right, forward) in up_right_forward {
        let mut g = gaussians(3, 0, 1.0, 1);
        g.means_m = vec![up, right, forward];
        preset.parse::<Axes>().unwrap().scaled(2.0).unwrap().apply(&mut g);
        assert_eq!(g.means_m, [[0., 0., 2.], [2., 0., 0.], [0., 2., 0.]], "{preset}");
    }
}

#[test]
fn shapes_and_colours_move_with_the_axes() {
    let turned = "0.36 0.48 -0.8 -0.8 0.6 0 0.48 0.64 0.6";
    let mirrored = "-0.36,-0.48,0.8,-0.8,0.6,0,0.48,0.64,0.6";
    for axes in PRESETS.into_iter().chain([turned, mirrored]) {
        let (plain, moved) = moved(axes, 0.5);
        // The matrix, from three moved centres, independent of the code under test.
        let columns =
            |g: &Gaussians| DMat3::from_cols_array_2d(&[g.means_m[0], g.means_m[1], g.means_m[2]]);
        let matrix = columns(&moved) * columns(&plain).inverse() / 0.5;
        for index in 0..plain.len() {
            let mean = matrix * DVec3::from_array(plain.means_m[index]) * 0.5;
            assert!((mean - DVec3::from_array(moved.means_m[index])).length() < 1e-9, "{axes}");

            let wanted = matrix * covariance(&plain, index) * matrix.transpose() * 0.25;
            let error = covariance(&moved, index) - wanted;
            let largest = wanted.to_cols_array().into_iter().fold(0.0, |m: f64, x| m.max(x.abs()));
            let relative = error.to_cols_array().map(|e| e.abs() / largest);
            assert!(relative.iter().all(|&e| e < 1e-5), "{axes}: {relative:?}");

            for view in 0..plain.len() {
                let d = DVec3::from_array(plain.means_m[view]).normalize();
                let error = colour(&moved, index, matrix * d) - colour(&plain, index, d);
                assert!(error.abs().max_element() < 1e-6, "{axes}: {error}");
            }
        }
        assert_eq!(moved.logit_opacities, plain.logit_opacities);
    }
}

#[test]
fn identity_changes_no_bit() {
    let (plain, moved) = moved("identity", 1.0);
    assert_eq!(moved, plain);
}

#[test]
fn invalid_axes_are_refused_with_the_reason() {
    let refused = |axes: &str| axes.parse::<Axes>().unwrap_err().to_string();
    assert!(refused("sideways").contains("y-down-z-forward (OpenCV"), "{}", refused("sideways"));
    assert!(refused("1 0 0 0 1 0 0 0").contains("nine numbers"));
    assert!(refused("2 0 0 0 1 0 0 0 1").contains("length 1 and be at right angles"));
    assert!(refused("1 0 0 1 0 0 0 0 1").contains("at right angles"));
    assert!(refused("NaN 0 0 0 1 0 0 0 1").contains("at right angles"));
    for scale in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e9] {
        let text = Axes::IDENTITY.scaled(scale).unwrap_err().to_string();
        assert!(text.starts_with("--scale ") && text.contains("1e-6 to 1e6"), "{text}");
    }
}
