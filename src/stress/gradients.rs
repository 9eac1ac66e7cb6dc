//! Gradients of extreme scenes.

use super::{Case, CaseBody, CaseRun};
use wildcity_render::RenderError;
use wildcity_render::compare::gradient_cases::extremes;
use wildcity_render::compare::gradients::{GroupError, by_group, group_errors};
use wildcity_render::gradient::GradientError;

pub(super) const T32: Case = Case {
    number: "T32",
    what: "gradients: needles, discs, 1 km and 1 µm wide, 40 in one place, opaque, at the cut and \
           at the near plane, a thousand layers, quaternions of 1e-3 and 1e3, 5,400 km away",
    bound: "finite; within 1e-4 of the largest derivative in f64, 1e-2 for needles, 1e-3 in one place",
    body: CaseBody::Light(t32),
};

fn t32(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    for case in extremes() {
        let name = case.name;
        let Some(backend) = run.differentiate() else {
            run.reduce_to("images: this backend computes no gradients");
            run.render_and_compare(name, &case.scene, &case.profile, case.views[0])?;
            continue;
        };
        let gradients = match case.gradients(backend) {
            Ok(gradients) => gradients,
            // A frame that fails ends the case. After any other refusal the remaining scenes still
            // run.
            Err(GradientError::Render(error)) => return Err(error),
            Err(error) => {
                run.check(format!("{name}: {error}"), false);
                continue;
            }
        };
        let mut values = by_group(&gradients).into_iter().flat_map(|(_, values)| values);
        run.check(format!("{name}: every derivative is finite"), values.all(f64::is_finite));
        if run.is_reference() {
            continue;
        }
        let Ok(truths) = case.truths() else {
            run.check(format!("{name}: has a definition"), false);
            continue;
        };
        let errors = group_errors(&gradients, &truths);
        // A NaN must win, and `max` would drop it.
        let mut worst = 0.0;
        for GroupError { error, .. } in &errors {
            worst = if *error > worst || error.is_nan() { *error } else { worst };
        }
        run.check_at_most(format!("{name}: off f64 by"), worst, case.most_error);
        let least = errors.iter().all(|group| group.cosine > 0.99999);
        run.check(format!("{name}: as f64 in direction"), least);
    }
    Ok(())
}
