//! Stress cases: extreme scenes, each of which has broken a published renderer, with the bound that
//! every backend must keep. `wildcity dev stress` runs them and prints the table, so that a faulty
//! driver is found on the machine that has it. Tests run them as well.
//!
//! ```text
//! shapes     needles, tiny Gaussians, walls, beside the view        T1 T2 T3 T13 T26
//! places     centimetres away, behind, 4,500 km off, 10 km deep     T4 T5 T7 T9 T10
//! order      equal depths, duplicates, popping, millions of keys    T6 T8 T20 T21 T27
//! opacities  every opacity, NaN and infinity, the stop rule         T11 T12 T19 T28
//! sizes      nothing, one pixel, 8K, growing buffers, crops, shrunk T14 to T18 T31
//! lenses     a wide splat, more than 180°, rolling shutters         T22 T23 T24
//! actors     colours that rotate with an actor, places, motion       T25 T29 T30
//! gradients  all of these extremes, backwards                        T32
//! ```
//!
//! The reference backend is not compared with itself: its images must be finite, and have the
//! values that a case states.
//!
//! # How to add a case
//!
//! 1. Write a constant `TN: Case` and a function `tN(run: &mut CaseRun<'_>)` in the file of its
//!    family. The function builds a scene
//!    ([`GaussianSpec`](wildcity_render::compare::gaussians::GaussianSpec) is the short form),
//!    renders it with `run.render_and_compare`, which also checks that every value is finite and
//!    that the reference backend agrees, and states further bounds with `run.check_at_most`,
//!    `run.check_at_least_db` and `run.check`. Each check's text must say what was measured and
//!    where.
//! 2. Add it to [`CASES`], in order of numbers. A case that takes gigabytes or minutes is a
//!    `CaseBody::Heavy`, which runs only with `--heavy`.
//! 3. Add a mutation to `tests/stress/mutations.rs` for every check: a faulty backend with which
//!    the check must fail. A test fails for a check without one, since a bound that no fault
//!    exceeds proves nothing.

mod actors;
mod case_run;
mod gradients;
mod lenses;
mod opacities;
mod order;
mod places;
mod shapes;
mod sizes;
pub mod table;

use std::time::Instant;

use serde::Serialize;

use wildcity_render::{Backend, RenderError};

pub use case_run::{CaseRun, Check};

/// One row of the table.
#[derive(Clone, Copy, Debug)]
pub struct Case {
    /// Its number, such as `T1`. T1 to T25 are those of the project's design; the others were found
    /// later.
    pub number: &'static str,
    /// The scene and the views.
    pub what: &'static str,
    /// The bound, in words.
    pub bound: &'static str,
    body: CaseBody,
}

/// What a case runs, and how much it takes.
#[derive(Clone, Copy, Debug)]
enum CaseBody {
    /// Seconds, and little memory.
    Light(Body),
    /// Gigabytes and minutes: run only on request.
    Heavy(Body),
}

type Body = fn(&mut CaseRun<'_>) -> Result<(), RenderError>;

/// All cases, in order of their numbers.
pub static CASES: [Case; 32] = [
    shapes::T1,
    shapes::T2,
    shapes::T3,
    places::T4,
    places::T5,
    order::T6,
    places::T7,
    order::T8,
    places::T9,
    places::T10,
    opacities::T11,
    opacities::T12,
    shapes::T13,
    sizes::T14,
    sizes::T15,
    sizes::T16,
    sizes::T17,
    sizes::T18,
    opacities::T19,
    order::T20,
    order::T21,
    lenses::T22,
    lenses::T23,
    lenses::T24,
    actors::T25,
    shapes::T26,
    order::T27,
    opacities::T28,
    actors::T29,
    actors::T30,
    sizes::T31,
    gradients::T32,
];

/// The result of a case on one backend.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Outcome {
    pub case: &'static str,
    pub backend: &'static str,
    /// Whether it was run, and whether its bounds held.
    pub verdict: Verdict,
    /// What was rendered instead, if it is less than what the case states.
    #[serde(rename = "only")]
    pub reduced_to: Option<String>,
    /// The first check that failed; or else the check closest to its bound, the limit of the
    /// device, or why the case was not run.
    #[serde(rename = "told")]
    pub detail: String,
    /// The share of its bound that this check's value takes: 1 is all of it; 0 for a check without
    /// a size.
    #[serde(rename = "strain")]
    pub bound_usage: f64,
    pub checks: usize,
    /// Wall time in seconds.
    pub seconds: f64,
}

/// The verdict on a case.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    Held,
    /// A bound does not hold, or a frame failed.
    Missed,
    /// The frame exceeds a limit of the device, which the device named. This is not a failure.
    Refused,
    /// Not run: `detail` says why.
    NotRun,
}

impl Case {
    /// Runs the case on a backend; a heavy one only if `heavy`.
    pub fn run(&self, backend: &dyn Backend, heavy: bool) -> Outcome {
        let body = match self.body {
            CaseBody::Heavy(_) if !heavy => {
                return self.not_run(backend.name(), "takes gigabytes and minutes: add --heavy");
            }
            CaseBody::Light(body) | CaseBody::Heavy(body) => body,
        };
        let start = Instant::now();
        let mut run = CaseRun::new(backend);
        let ended = body(&mut run);
        // The clock stops before the outcome is made. An error of the body is a verdict, so that
        // the table has every case.
        Outcome { seconds: start.elapsed().as_secs_f64(), ..run.outcome(self, ended) }
    }

    /// All checks of the case on a backend, in order.
    ///
    /// # Errors
    /// A frame failed.
    pub fn checks(&self, backend: &dyn Backend) -> Result<Vec<Check>, RenderError> {
        // Heavy cases run here as well; whether to ask for one is up to the caller.
        let (CaseBody::Light(body) | CaseBody::Heavy(body)) = self.body;
        let mut run = CaseRun::new(backend);
        body(&mut run)?;
        Ok(run.into_checks())
    }

    /// The outcome if the case was not run.
    pub fn not_run(&self, backend: &'static str, why: &str) -> Outcome {
        Outcome {
            case: self.number,
            backend,
            verdict: Verdict::NotRun,
            reduced_to: None,
            detail: why.to_owned(),
            bound_usage: 0.0,
            checks: 0,
            seconds: 0.0,
        }
    }
}

impl Outcome {
    /// The verdict in a word, with what was rendered instead if it is less than what the case
    /// states.
    pub fn word(&self) -> String {
        match &self.reduced_to {
            Some(reduced_to) => format!("{} ({reduced_to})", self.verdict.word()),
            None => self.verdict.word().to_owned(),
        }
    }
}
