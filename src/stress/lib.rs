//! The stress table: stiff and extreme scenes, each of which has broken a published renderer, with the
//! bound that every backend must keep. `wildcity stress` prints it, and tests run it.
//!
//! ```text
//! shapes     needles, dust, walls, what lies beside the view        T1 T2 T3 T13 T26
//! places     closer than a hand, behind, 4,500 km off, 10 km deep   T4 T5 T7 T9 T10
//! order      equal depths, duplicates, popping, millions of keys    T6 T8 T20 T21 T27
//! opacities  every opacity, poison, the stop rule                   T11 T12 T19 T28
//! sizes      nothing, one pixel, 8K, growing buffers, crops         T14 to T18
//! lenses     a wide splat, beyond a half circle, rolling shutters   T22 T23 T24
//! actors     what turns with its colours                            T25
//! ```

mod actors;

mod case_run;
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
    /// Its number in the table of the design, as `T1`; from T26 on, what was found here.
    pub number: &'static str,
    /// What is drawn.
    pub what: &'static str,
    /// What must hold.
    pub bound: &'static str,
    run: Run,
}

/// How a case is run.
#[derive(Clone, Copy, Debug)]
enum Run {
    /// Seconds, and little memory.
    Light(Body),
    /// Gigabytes and minutes: only if asked for.
    Heavy(Body),
}

type Body = fn(&mut CaseRun<'_>) -> Result<(), RenderError>;

/// Every case, in order of their numbers.
pub static CASES: [Case; 28] = [
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
];

/// How a case went on one backend.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Outcome {
    /// The case's number.
    pub case: &'static str,
    /// The backend's name.
    pub backend: &'static str,
    /// Whether it was run, and how it went.
    pub verdict: Verdict,
    /// What was drawn, where that is less than what the case says.
    #[serde(rename = "only")]
    pub reduced_to: Option<String>,
    /// What was compared, the first miss first, else what came closest to its bound; or what was refused.
    #[serde(rename = "told")]
    pub detail: String,
    /// How much of its bound that took: 1 is all of it, 0 none or nothing that has a size.
    #[serde(rename = "strain")]
    pub bound_usage: f64,
    /// How many bounds were looked at.
    pub checks: usize,
    /// How long it took.
    pub seconds: f64,
}

/// How a case went.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Within its bounds.
    Held,
    /// Out of one, or the frame failed.
    Missed,
    /// More than the device may hold, which it said with how much fits: a limit, and no miss.
    Refused,
    /// Not run: `detail` says why.
    NotRun,
}

impl Case {
    /// Runs the case on a backend; a heavy one only if `heavy`.
    pub fn run(&self, backend: &dyn Backend, heavy: bool) -> Outcome {
        let body = match self.run {
            Run::Heavy(_) if !heavy => {
                return self.not_run(backend.name(), "takes gigabytes and minutes: add --heavy");
            }
            Run::Light(body) | Run::Heavy(body) => body,
        };
        let start = Instant::now();
        let mut trial = CaseRun::new(backend);
        let ended = body(&mut trial);
        Outcome { seconds: start.elapsed().as_secs_f64(), ..trial.outcome(self, ended) }
    }

    /// Everything that it looks at on a backend, in order.
    ///
    /// # Errors
    /// A frame failed.
    pub fn checks(&self, backend: &dyn Backend) -> Result<Vec<Check>, RenderError> {
        let (Run::Light(body) | Run::Heavy(body)) = self.run;
        let mut trial = CaseRun::new(backend);
        body(&mut trial)?;
        Ok(trial.into_checks())
    }

    /// The outcome where it could not be run.
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
    /// Its verdict in a word, with what was drawn where that is less than what the case says.
    pub fn word(&self) -> String {
        match &self.reduced_to {
            Some(reduced_to) => format!("{} ({reduced_to})", self.verdict.word()),
            None => self.verdict.word().to_owned(),
        }
    }
}
