//! One run of a case on one backend: what it renders, and the checks it makes.

use std::fmt;

use super::{Case, Outcome, Verdict};
use wildcity_render::compare::images::{AGREEMENT_DB, RenderedImage, agree, render_images};
use wildcity_render::gradient::Differentiate;
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, FrameStats, RenderError, Target, View};
use wildcity_scene::{RenderProfile, Scene};

/// One case on one backend.
pub struct CaseRun<'a> {
    backend: &'a dyn Backend,
    checks: Vec<Check>,
    refused: Option<RenderError>,
    reduced_to: Option<String>,
}

/// A measured value and its bound.
#[derive(Clone, Debug, PartialEq)]
pub struct Check {
    /// What was measured, and where.
    pub what: String,
    pub measured: f64,
    bound: Bound,
}

/// What a measured value must satisfy.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Bound {
    AtMost(f64),
    /// At least so many dB.
    AtLeastDb(f64),
    /// The value is 1 for true.
    True,
}

impl<'a> CaseRun<'a> {
    pub(super) fn new(backend: &'a dyn Backend) -> Self {
        Self { backend, checks: Vec::new(), refused: None, reduced_to: None }
    }

    /// All checks, in order.
    pub(super) fn into_checks(self) -> Vec<Check> {
        self.checks
    }

    /// The outcome of the run, given how its function ended.
    pub(super) fn outcome(self, case: &Case, ended: Result<(), RenderError>) -> Outcome {
        let (verdict, detail, bound_usage) = match (self.verdict(), &self.refused, ended) {
            // A frame that failed has no image to judge: missed, whatever was checked before.
            (_, _, Err(error)) => (Verdict::Missed, error.to_string(), f64::INFINITY),
            (Some(check), _, _) if !check.holds() => {
                (Verdict::Missed, check.to_string(), check.bound_usage())
            }
            // A limit that the device named is no failure, but a failed check before it is.
            (_, Some(limit), _) => (Verdict::Refused, limit.to_string(), 0.0),
            (Some(check), None, _) => (Verdict::Held, check.to_string(), check.bound_usage()),
            // A case without a check proves nothing.
            (None, None, _) => (Verdict::Missed, "nothing was compared".to_owned(), f64::INFINITY),
        };
        let case = case.number;
        let backend = self.backend.name();
        let checks = self.checks.len();
        Outcome {
            case,
            backend,
            verdict,
            reduced_to: self.reduced_to,
            detail,
            bound_usage,
            checks,
            seconds: 0.0,
        }
    }

    /// The first check that failed, or else the one closest to its bound.
    pub(super) fn verdict(&self) -> Option<&Check> {
        // The first failure, because later ones often follow from it.
        let missed = self.checks.iter().find(|check| !check.holds());
        let closest =
            || self.checks.iter().max_by(|a, b| a.bound_usage().total_cmp(&b.bound_usage()));
        missed.or_else(closest)
    }

    /// Checks that a value is at most `most`. A NaN is not.
    pub(super) fn check_at_most(&mut self, what: impl Into<String>, measured: f64, most: f64) {
        self.checks.push(Check { what: what.into(), measured, bound: Bound::AtMost(most) });
    }

    /// Checks that a value in dB is at least `least`. A NaN is not.
    pub(super) fn check_at_least_db(&mut self, what: impl Into<String>, measured: f64, least: f64) {
        self.checks.push(Check { what: what.into(), measured, bound: Bound::AtLeastDb(least) });
    }

    /// Checks that a statement is true.
    pub(super) fn check(&mut self, what: impl Into<String>, holds: bool) {
        let measured = f64::from(u8::from(holds));
        self.checks.push(Check { what: what.into(), measured, bound: Bound::True });
    }

    /// Accepts an error that names a limit of the device ([`RenderError::TooMany`]): the verdict is
    /// then [`Verdict::Refused`]. Only devices have such limits; from another backend it is an
    /// error like any other.
    pub(super) fn accept_limit(&mut self, error: RenderError) -> Result<(), RenderError> {
        if !matches!(error, RenderError::TooMany { .. }) || self.backend.name() != "gpu" {
            return Err(error);
        }
        self.refused = Some(error);
        Ok(())
    }

    /// Records what is rendered instead, if it is less than what the case states.
    pub(super) fn reduce_to(&mut self, what: impl Into<String>) {
        self.reduced_to = Some(what.into());
    }

    /// The backend, if it computes gradients.
    pub(super) fn differentiate(&self) -> Option<&'a dyn Differentiate> {
        self.backend.as_differentiate()
    }

    /// Whether the backend is the reference backend.
    pub(super) fn is_reference(&self) -> bool {
        self.backend.name() == Reference.name()
    }

    /// The backend's images of one view.
    pub(super) fn render(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: View,
    ) -> Result<RenderedImage, RenderError> {
        // One image for each view, of which there is one.
        Ok(render_images(self.backend, scene, profile, &[view])?.remove(0))
    }

    /// The time and work of a frame of one view.
    pub(super) fn stats(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: View,
    ) -> Result<FrameStats, RenderError> {
        let mut opacity = vec![0.0; view.camera.pixels()];
        let target = Target { opacity: Some(&mut opacity), ..Target::default() };
        let frame = Frame { scene, profile, views: &[view] };
        self.backend.render(&frame, &mut [target], &|_, _| {})
    }

    /// The backend's images of several views, rendered in one frame.
    pub(super) fn render_all(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        views: &[View],
    ) -> Result<Vec<RenderedImage>, RenderError> {
        render_images(self.backend, scene, profile, views)
    }

    /// The reference backend's images of one view.
    pub(super) fn render_reference(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: View,
    ) -> Result<RenderedImage, RenderError> {
        Ok(render_images(&Reference, scene, profile, &[view])?.remove(0))
    }

    /// The backend's images of one view, after checks that every value is finite and that the
    /// reference backend's images agree. The reference backend is not compared with itself; its
    /// images must have the values that a case states.
    pub(super) fn render_and_compare(
        &mut self,
        what: impl Into<String>,
        scene: &Scene,
        profile: &RenderProfile,
        view: View,
    ) -> Result<RenderedImage, RenderError> {
        let what = what.into();
        let image = self.render(scene, profile, view)?;
        let RenderedImage { rgba, depth_m, opacity, .. } = &image;
        let mut values = rgba.iter().chain(depth_m).chain(opacity);
        // All maps in one check, so that the table of mutations has one entry for it.
        self.check(format!("{what}: every value is finite"), values.all(|v| v.is_finite()));
        if !self.is_reference() {
            let truth = self.render_reference(scene, profile, view)?;
            self.check_agreement(what, &image, &truth);
        }
        Ok(image)
    }

    /// Checks that two images agree ([`agree`]).
    pub(super) fn check_agreement(
        &mut self,
        what: impl Into<String>,
        image: &RenderedImage,
        truth: &RenderedImage,
    ) {
        match agree(image, truth) {
            Ok(db) => {
                self.check_at_least_db(format!("{}: as f64, dB", what.into()), db, AGREEMENT_DB)
            }
            Err(off) => self.check(format!("{}: as f64, {off}", what.into()), false),
        }
    }
}

impl Check {
    /// Whether the value satisfies its bound; a NaN never does.
    pub fn holds(&self) -> bool {
        match self.bound {
            Bound::AtMost(most) => self.measured <= most,
            Bound::AtLeastDb(least) => self.measured >= least,
            Bound::True => self.measured == 1.0,
        }
    }

    /// The share of its bound that the value takes: 1 is all of it. In dB the error counts: 20 dB
    /// are a factor of ten.
    pub fn bound_usage(&self) -> f64 {
        match self.bound {
            // A bound of 0 has no share; the value itself then orders the checks.
            Bound::AtMost(0.0) => self.measured,
            Bound::AtMost(most) => self.measured / most,
            // The error is 10^(-dB / 20): its quotient with that of the bound.
            Bound::AtLeastDb(least) => 10.0_f64.powf((least - self.measured) / 20.0),
            Bound::True => 0.0,
        }
    }
}

impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { what, measured, bound } = self;
        let number = |value: f64| match value {
            v if v == 0.0 || (1e-2..1e5).contains(&v.abs()) => {
                format!("{}", (v * 1e3).round() / 1e3)
            }
            v if v.is_finite() => format!("{v:.1e}"),
            v => format!("{v}"),
        };
        match *bound {
            Bound::AtMost(most) => {
                write!(f, "{what} {}, at most {}", number(*measured), number(most))
            }
            Bound::True if self.holds() => write!(f, "{what}"),
            Bound::True => write!(f, "not: {what}"),
            Bound::AtLeastDb(least) => {
                write!(f, "{what} {}, at least {}", number(*measured), number(least))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bound_usage(measured: f64, bound: Bound) -> f64 {
        Check { what: String::new(), measured, bound }.bound_usage()
    }

    #[test]
    fn bound_usage_is_the_share_of_the_bound() {
        assert_eq!(bound_usage(0.5, Bound::AtMost(2.0)), 0.25);
        assert_eq!(bound_usage(70.0, Bound::AtLeastDb(70.0)), 1.0);
        assert!((bound_usage(110.0, Bound::AtLeastDb(70.0)) - 0.01).abs() < 1e-15);
        assert!((bound_usage(50.0, Bound::AtLeastDb(70.0)) - 10.0).abs() < 1e-12);
        assert_eq!(bound_usage(f64::INFINITY, Bound::AtLeastDb(70.0)), 0.0);
    }

    #[test]
    fn the_detail_is_the_check_that_is_closest_to_its_bound() {
        let mut run = CaseRun::new(&Reference);
        run.check_at_least_db("far from its bound, dB", 145.0, 70.0);
        run.check_at_most("close to it", 3e-4, 5e-4);
        run.check_at_least_db("closer, dB", 71.0, 70.0);
        assert_eq!(run.verdict().unwrap().what, "closer, dB");
        // NaN fails every bound, and a failed check comes before the closest.
        run.check_at_most("beyond", f64::NAN, 5e-4);
        assert_eq!(run.verdict().unwrap().what, "beyond");
    }
}
