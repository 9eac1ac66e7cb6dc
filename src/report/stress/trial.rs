//! A case on its way through one backend: what it draws, and which bounds it looked at.

use std::fmt;

use crate::render::reference::Reference;
use crate::render::{Backend, RenderError, View};
use crate::report::drawing::{AGREED_DB, Drawing, agree, draw};
use crate::scene::{RenderProfile, Scene};

/// One case on one backend.
pub struct Trial<'a> {
    backend: &'a dyn Backend,
    checks: Vec<Check>,
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
    Least(f64),
    /// The value is 1 if it is so.
    So,
}

impl<'a> Trial<'a> {
    pub(super) fn new(backend: &'a dyn Backend) -> Self {
        Self { backend, checks: Vec::new() }
    }

    /// Everything that was looked at.
    pub fn checks(&self) -> &[Check] {
        &self.checks
    }

    /// The first bound that does not hold, else the one that is closest to not holding.
    pub(super) fn verdict(&self) -> Option<&Check> {
        let missed = self.checks.iter().find(|check| !check.holds());
        let closest = || self.checks.iter().max_by(|a, b| a.strain().total_cmp(&b.strain()));
        missed.or_else(closest)
    }

    /// Looks at a value that must be at most `most`. NaN is not.
    pub(super) fn at_most(&mut self, what: impl Into<String>, measured: f64, most: f64) {
        self.checks.push(Check { what: what.into(), measured, bound: Bound::Most(most) });
    }

    /// Looks at a value that must be at least `least`. NaN is not.
    pub(super) fn at_least(&mut self, what: impl Into<String>, measured: f64, least: f64) {
        self.checks.push(Check { what: what.into(), measured, bound: Bound::Least(least) });
    }

    /// Looks at something that is so or not.
    pub(super) fn holds(&mut self, what: impl Into<String>, holds: bool) {
        let measured = f64::from(u8::from(holds));
        self.checks.push(Check { what: what.into(), measured, bound: Bound::So });
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
    ) -> Result<Drawing, RenderError> {
        Ok(draw(self.backend, scene, profile, &[view])?.remove(0))
    }

    /// What it draws of several in one frame.
    pub(super) fn draw_all(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        views: &[View],
    ) -> Result<Vec<Drawing>, RenderError> {
        draw(self.backend, scene, profile, views)
    }

    /// The definition's drawing.
    pub(super) fn truth(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: View,
    ) -> Result<Drawing, RenderError> {
        Ok(draw(&Reference, scene, profile, &[view])?.remove(0))
    }

    /// The backend's drawing, after it was looked at whether it is finite, and whether the definition's is
    /// the same. The definition is not compared with itself: of it a case holds what it says in numbers.
    pub(super) fn agreed(
        &mut self,
        what: impl Into<String>,
        scene: &Scene,
        profile: &RenderProfile,
        view: View,
    ) -> Result<Drawing, RenderError> {
        let (what, drawing) = (what.into(), self.draw(scene, profile, view)?);
        let Drawing { rgba, depth_m, opacity, .. } = &drawing;
        let mut values = rgba.iter().chain(depth_m).chain(opacity);
        self.holds(format!("{what}: every value is finite"), values.all(|v| v.is_finite()));
        if !self.is_reference() {
            let truth = self.truth(scene, profile, view)?;
            self.compare(what, &drawing, &truth);
        }
        Ok(drawing)
    }

    /// Looks at whether two drawings are of one thing.
    pub(super) fn compare(&mut self, what: impl Into<String>, drawing: &Drawing, truth: &Drawing) {
        match agree(drawing, truth) {
            Ok(db) => self.at_least(format!("{}: dB", what.into()), db, AGREED_DB),
            Err(off) => self.holds(format!("{}: {off}", what.into()), false),
        }
    }
}

impl Check {
    /// Whether the value is within its bound; NaN never is.
    pub fn holds(&self) -> bool {
        match self.bound {
            Bound::Most(most) => self.measured <= most,
            Bound::Least(least) => self.measured >= least,
            Bound::So => self.measured == 1.0,
        }
    }

    /// How much of its bound the value takes: 1 is all of it.
    pub fn strain(&self) -> f64 {
        match self.bound {
            Bound::Most(0.0) => self.measured,
            Bound::Most(most) => self.measured / most,
            Bound::Least(least) => least / self.measured,
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
            Bound::Least(least) => {
                write!(f, "{what} {}, at least {}", number(*measured), number(least))
            }
        }
    }
}
