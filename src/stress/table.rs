//! The results of cases on backends, as one table.

use std::fmt;

use serde::Serialize;

use super::{Case, Outcome, Verdict};
use wildcity_render::Backend;

/// The results of cases (rows) on backends (columns).
#[derive(Clone, Debug, Serialize)]
pub struct Table {
    pub backends: Vec<Column>,
    /// One row per case.
    pub rows: Vec<Row>,
}

/// A backend of the table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Column {
    pub backend: &'static str,
    /// The device or instruction set, or why the backend is not available.
    pub detail: String,
}

/// A case, and its outcome on each backend.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub case: &'static str,
    /// The scene and the views.
    pub what: &'static str,
    /// The bound, in words.
    pub bound: &'static str,
    /// One per backend, in order of the columns.
    pub outcomes: Vec<Outcome>,
}

/// A backend to run cases on, or its name and why it is not available.
pub type Candidate = Result<Box<dyn Backend>, (&'static str, String)>;

/// Runs cases on backends; heavy cases only if `heavy`. Before each run it calls `progress` with
/// the number of finished runs and the number of the next case.
pub fn run(
    cases: &[&Case],
    backends: &[Candidate],
    heavy: bool,
    progress: &mut dyn FnMut(usize, &str),
) -> Table {
    let mut done = 0;
    let made = cases.iter().map(|case| {
        let tried = backends.iter().map(|candidate| {
            progress(done, case.number);
            done += 1;
            match candidate {
                Ok(backend) => case.run(&**backend, heavy),
                Err((name, why)) => case.not_run(name, why),
            }
        });
        let outcomes = tried.collect();
        Row { case: case.number, what: case.what, bound: case.bound, outcomes }
    });
    // The cases run here: the iterators above are lazy.
    let rows = made.collect();
    let column = |candidate: &Candidate| match candidate {
        Ok(backend) => Column { backend: backend.name(), detail: backend.detail() },
        Err((name, why)) => Column { backend: name, detail: why.clone() },
    };
    Table { backends: backends.iter().map(column).collect(), rows }
}

impl Table {
    /// Number of outcomes with a verdict.
    pub fn count(&self, verdict: Verdict) -> usize {
        let outcomes = self.rows.iter().flat_map(|row| &row.outcomes);
        outcomes.filter(|outcome| outcome.verdict == verdict).count()
    }

    /// Width of a backend's column in characters, with a gap of two.
    fn width(&self, backend: usize) -> usize {
        // Characters and not bytes, as `write!` pads by characters.
        let words = self.rows.iter().filter_map(|row| Some(row.outcomes.get(backend)?.word()));
        words.map(|word| word.chars().count()).fold(8, usize::max) + 2
    }
}

impl Row {
    /// The outcome to print: the first that missed its bound, or else the one closest to its bound,
    /// or else one that was not run.
    pub fn tightest(&self) -> Option<&Outcome> {
        let missed = self.outcomes.iter().find(|outcome| outcome.verdict == Verdict::Missed);
        let held = || self.outcomes.iter().filter(|outcome| outcome.verdict == Verdict::Held);
        let closest = || held().max_by(|a, b| a.bound_usage.total_cmp(&b.bound_usage));
        let not_run = || self.outcomes.iter().find(|outcome| outcome.verdict == Verdict::NotRun);
        missed.or_else(closest).or_else(not_run)
    }
}

impl Verdict {
    /// The verdict in a word, as in the table.
    pub fn word(self) -> &'static str {
        match self {
            Self::Held => "held",
            Self::Missed => "MISSED",
            Self::Refused => "refused",
            Self::NotRun => "not run",
        }
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Column { backend, detail } in &self.backends {
            writeln!(f, "{backend:<10} {detail}")?;
        }
        let widths: Vec<usize> = (0..self.backends.len()).map(|i| self.width(i)).collect();
        write!(f, "\n{:<5}", "case")?;
        for (Column { backend, .. }, width) in self.backends.iter().zip(&widths) {
            write!(f, "{backend:<width$}")?;
        }
        writeln!(f, "what; bound; what came closest to it")?;
        let indent = 5 + widths.iter().sum::<usize>();
        for row in &self.rows {
            write!(f, "{:<5}", row.case)?;
            for (outcome, width) in row.outcomes.iter().zip(&widths) {
                write!(f, "{:<width$}", outcome.word())?;
            }
            writeln!(f, "{}", row.what)?;
            writeln!(f, "{:indent$}{}", "", row.bound)?;
            let refused = row.outcomes.iter().filter(|o| o.verdict == Verdict::Refused);
            // The tightest outcome, and every refusal with the limit that its device named.
            for Outcome { backend, detail, .. } in row.tightest().into_iter().chain(refused) {
                writeln!(f, "{:indent$}{backend}: {detail}", "")?;
            }
        }
        let [held, refused, missed, not_run] =
            [Verdict::Held, Verdict::Refused, Verdict::Missed, Verdict::NotRun]
                .map(|verdict| self.count(verdict));
        writeln!(f, "\n{held} held, {refused} refused, {missed} missed, {not_run} not run")
    }
}
