use super::*;

/// Some Gaussians far apart, in no order, each with its own values.
fn scattered() -> Gaussians {
    let mut gaussians = Gaussians::with_capacity(1, 100);
    for i in 0..100_u32 {
        let far = f64::from(i * 37 % 100);
        gaussians.means_m.push([far, f64::from(i % 7), 0.0]);
        gaussians.quats_wxyz.push(if i * 37 % 100 < 50 {
            [1.0, 0.0, 0.0, 0.0]
        } else {
            [0.0, 1.0, 0.0, 0.0]
        });
        gaussians.ln_scales.push([-(far as f32) / 50.0; 3]);
        gaussians.logit_opacities.push(far as f32 / 100.0);
        gaussians.sh.extend([far as f32 / 100.0; 12]);
    }
    let class = |m: &[f64; 3]| if m[0] < 50.0 { SemanticClass::Road } else { SemanticClass::Car };
    gaussians.classes = Some(gaussians.means_m.iter().map(class).collect());
    gaussians
}

/// Whether neighbours are near each other, and the values of each belong together.
fn is_sorted(model: &Model) -> bool {
    let codes = (0..model.len()).map(|i| morton(&model.get(i, column::MEAN).map(f64::from)));
    let has_own_values = |i: usize| {
        let [x, ..] = model.get::<3>(i, column::MEAN);
        let far = x + model.origin_m.x as f32;
        let [ln_scale] = model.get(i, LN_SCALE);
        let [logit] = model.get(i, LOGIT);
        let at =
            |moments: &[Lanes]| moments[i / LANES * columns(model.sh_degree) + LOGIT].0[i % LANES];
        let moments = model.moments.each_ref().map(|moments| at(moments));
        (ln_scale + far / 50.0).abs() < 1e-5
            && (logit - far / 100.0).abs() < 1e-5
            && (moments == [0.0; 2] || moments == [far, -far])
            && (model.get::<1>(i, column::SH + 11)[0] - far / 100.0).abs() < 1e-5
            && (model.get::<4>(i, column::QUAT)[0] == 1.0) == (far < 50.0)
            && model.is_ground(i) == (far < 50.0)
            && model.classes.as_ref().is_some_and(|classes| {
                classes[i] == if far < 50.0 { SemanticClass::Road } else { SemanticClass::Car }
            })
    };
    codes.is_sorted() && (0..model.len()).all(has_own_values)
}

#[test]
fn gaussians_are_kept_in_the_order_of_their_places() {
    let gaussians = scattered();
    let is_ground = gaussians.means_m.iter().map(|m| m[0] < 50.0).collect();
    let mut model = Model::new(gaussians, is_ground, 1, Vec::new());
    assert!(is_sorted(&model));
    // What a step has learned stays with its Gaussian.
    for i in 0..model.len() {
        let [x, ..] = model.get::<3>(i, column::MEAN);
        let far = x + model.origin_m.x as f32;
        let place = i / LANES * columns(1) + LOGIT;
        model.moments[0][place].0[i % LANES] = far;
        model.moments[1][place].0[i % LANES] = -far;
    }
    model.copy(&[3, 90, 40], &[7, 100, 101]);
    assert_eq!(model.len(), 102);
    assert!(is_sorted(&model));
    let moving = (0..102).filter(|&i| {
        let place = i / LANES * columns(1) + LOGIT;
        model.moments[1][place].0[i % LANES] != 0.0
    });
    // All but the copies, and the one at 0 m.
    assert_eq!(moving.count(), 102 - 4);
}
