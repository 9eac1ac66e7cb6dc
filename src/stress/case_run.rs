//! A case on its way through one backend: what it draws, and which bounds it looked at.

use std::fmt;

use super::{Case, Outcome, Verdict};
use wildcity_render::compare::images::{AGREEMENT_DB, RenderedImage, agree, render_images};
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
    /// The value.
    pub measured: f64,
    bound: Bound,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Bound {
    Most(f64),
    /// In dB.
    LeastDb(f64),
    /// The value is 1 if it is so.
    So,
}

impl<'a> CaseRun<'a> {
    pub(super) fn new(backend: &'a dyn Backend) -> Self {
        Self { backend, checks: Vec::new(), refused: None, reduced_to: None }
    }

    /// Everything that was looked at.
    pub(super) fn into_checks(self) -> Vec<Check> {
        self.checks
    }

    /// How it went, in the end.
    pub(super) fn outcome(self, case: &Case, ended: Result<(), RenderError>) -> Outcome {
        let (verdict, detail, bound_usage) = match (self.verdict(), &self.refused, ended) {
            (_, _, Err(error)) => (Verdict::Missed, error.to_string(), f64::INFINITY),
            (Some(check), _, _) if !check.holds() => {
                (Verdict::Missed, check.to_string(), check.bound_usage())
            }
            (_, Some(limit), _) => (Verdict::Refused, limit.to_string(), 0.0),
            (Some(check), None, _) => (Verdict::Held, check.to_string(), check.bound_usage()),
            (None, None, _) => (Verdict::Missed, "nothing was compared".to_owned(), f64::INFINITY),
        };
        let (case, backend, checks) = (case.number, self.backend.name(), self.checks.len());
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

    /// The first bound that does not hold, else the one that is closest to not holding.
    pub(super) fn verdict(&self) -> Option<&Check> {
        let missed = self.checks.iter().find(|check| !check.holds());
        let closest =
            || self.checks.iter().max_by(|a, b| a.bound_usage().total_cmp(&b.bound_usage()));
        missed.or_else(closest)
    }

    /// Looks at a value that must be at most `most`. NaN is not.
    pub(super) fn at_most(&mut self, what: impl Into<String>, measured: f64, most: f64) {
        self.checks.push(Check { what: what.into(), measured, bound: Bound::Most(most) });
    }

    /// Looks at decibels that must be at least `least`. NaN is not.
    pub(super) fn at_least_db(&mut self, what: impl Into<String>, measured: f64, least: f64) {
        self.checks.push(Check { what: what.into(), measured, bound: Bound::LeastDb(least) });
    }

    /// Looks at something that is so or not.
    pub(super) fn holds(&mut self, what: impl Into<String>, holds: bool) {
        let measured = f64::from(u8::from(holds));
        self.checks.push(Check { what: what.into(), measured, bound: Bound::So });
    }

    /// Takes a refusal that names how much fits for the limit that it is. Devices have such limits and nothing
    /// else has: of another backend it is an error as any other.
    pub(super) fn refused(&mut self, error: RenderError) -> Result<(), RenderError> {
        if !matches!(error, RenderError::TooMany { .. }) || self.backend.name() != "gpu" {
            return Err(error);
        }
        self.refused = Some(error);
        Ok(())
    }

    /// Says what is drawn, where that is less than what the case says.
    pub(super) fn reduce_to(&mut self, what: impl Into<String>) {
        self.reduced_to = Some(what.into());
    }

    /// Whether this is the definition itself.
    pub(super) fn is_reference(&self) -> bool {
        self.backend.name() == Reference.name()
    }

    /// What the backend draws of a view.
    pub(super) fn draw(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: View,
    ) -> Result<RenderedImage, RenderError> {
        Ok(render_images(self.backend, scene, profile, &[view])?.remove(0))
    }

    /// What a frame of a view costs.
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

    /// What it draws of several in one frame.
    pub(super) fn draw_all(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        views: &[View],
    ) -> Result<Vec<RenderedImage>, RenderError> {
        render_images(self.backend, scene, profile, views)
    }

    /// The definition's drawing.
    pub(super) fn truth(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: View,
    ) -> Result<RenderedImage, RenderError> {
        Ok(render_images(&Reference, scene, profile, &[view])?.remove(0))
    }

    /// The backend's drawing, after it was looked at whether it is finite, and whether the definition's is
    /// the same. The definition is not compared with itself: of it a case holds what it says in numbers.
    pub(super) fn agreed(
        &mut self,
        what: impl Into<String>,
        scene: &Scene,
        profile: &RenderProfile,
        view: View,
    ) -> Result<RenderedImage, RenderError> {
        let (what, drawing) = (what.into(), self.draw(scene, profile, view)?);
        let RenderedImage { rgba, depth_m, opacity, .. } = &drawing;
        let mut values = rgba.iter().chain(depth_m).chain(opacity);
        self.holds(format!("{what}: every value is finite"), values.all(|v| v.is_finite()));
        if !self.is_reference() {
            let truth = self.truth(scene, profile, view)?;
            self.compare(what, &drawing, &truth);
        }
        Ok(drawing)
    }

    /// Looks at whether two drawings are of one thing.
    pub(super) fn compare(
        &mut self,
        what: impl Into<String>,
        drawing: &RenderedImage,
        truth: &RenderedImage,
    ) {
        match agree(drawing, truth) {
            Ok(db) => self.at_least_db(format!("{}: as f64, dB", what.into()), db, AGREEMENT_DB),
            Err(off) => self.holds(format!("{}: as f64, {off}", what.into()), false),
        }
    }
}

impl Check {
    /// Whether the value is within its bound; NaN never is.
    pub fn holds(&self) -> bool {
        match self.bound {
            Bound::Most(most) => self.measured <= most,
            Bound::LeastDb(least) => self.measured >= least,
            Bound::So => self.measured == 1.0,
        }
    }

    /// How much of its bound the value takes: 1 is all of it. Of decibels it is the error that counts, a tenth
    /// for every 20 dB.
    pub fn bound_usage(&self) -> f64 {
        match self.bound {
            Bound::Most(0.0) => self.measured,
            Bound::Most(most) => self.measured / most,
            Bound::LeastDb(least) => 10.0_f64.powf((least - self.measured) / 20.0),
            Bound::So => 0.0,
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
            Bound::Most(most) => {
                write!(f, "{what} {}, at most {}", number(*measured), number(most))
            }
            Bound::So if self.holds() => write!(f, "{what}"),
            Bound::So => write!(f, "not: {what}"),
            Bound::LeastDb(least) => {
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
        assert_eq!(bound_usage(0.5, Bound::Most(2.0)), 0.25);
        assert_eq!(bound_usage(70.0, Bound::LeastDb(70.0)), 1.0);
        assert!((bound_usage(110.0, Bound::LeastDb(70.0)) - 0.01).abs() < 1e-15);
        assert!((bound_usage(50.0, Bound::LeastDb(70.0)) - 10.0).abs() < 1e-12);
        assert_eq!(bound_usage(f64::INFINITY, Bound::LeastDb(70.0)), 0.0);
    }

    #[test]
    fn the_detail_is_the_check_that_is_closest_to_its_bound() {
        let mut trial = CaseRun::new(&Reference);
        trial.at_least_db("far from its bound, dB", 145.0, 70.0);
        trial.at_most("close to it", 3e-4, 5e-4);
        trial.at_least_db("closer, dB", 71.0, 70.0);
        assert_eq!(trial.verdict().unwrap().what, "closer, dB");
        trial.at_most("beyond", f64::NAN, 5e-4);
        assert_eq!(trial.verdict().unwrap().what, "beyond");
    }
}
