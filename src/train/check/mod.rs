//! The gradients of this machine: every backend against the definition (`reference`), and both
//! against vectors of others where these are.
//!
//! The bound of every row is [`MOST_ERROR`] of the largest derivative of its group of parameters,
//! and a cosine of [`LEAST_COSINE`]. Extreme scenes may have their own, with the reason beside it.

mod times;
mod vectors;

use std::fmt;

use serde::Serialize;
use wildcity_render::compare::gradient_cases::cases;
use wildcity_render::compare::gradients::{GroupError, group_errors};
use wildcity_render::gradient::{Differentiate, GradientError};

pub use wildcity_render::compare::gradient_cases::MOST_ERROR;

pub use self::times::{Time, times};
pub use self::vectors::{VectorError, Vectors};

/// Least cosine between two gradients of a group.
pub const LEAST_COSINE: f64 = 0.99999;

/// The gradients of one backend in one case.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub case: &'static str,
    pub backend: &'static str,
    /// What they are compared with: `reference` or `vectors`.
    pub against: &'static str,
    pub groups: Vec<GroupError>,
    pub most_error: f64,
    pub is_within: bool,
}

/// The rows of all cases on all backends.
#[derive(Clone, Debug, Serialize)]
pub struct Table {
    pub rows: Vec<Row>,
}

impl Row {
    fn new(
        case: &'static str,
        backend: &'static str,
        against: &'static str,
        groups: Vec<GroupError>,
        most_error: f64,
    ) -> Self {
        // Written so that a NaN is not within.
        let holds = |group: &GroupError| group.error <= most_error && group.cosine >= LEAST_COSINE;
        let is_within = groups.iter().all(holds);
        Self { case, backend, against, groups, most_error, is_within }
    }
}

impl Table {
    /// Compares some backends with the reference in all cases, and with the vectors, if there are
    /// any. What lies between the reference and itself with thresholds nudged by 1e-4 has no error.
    /// `progress` is called with the number of cases done and the next one's name.
    ///
    /// # Errors
    /// A backend does not compute gradients, or the vectors cannot be read.
    pub fn new(
        backends: &[&dyn Differentiate],
        vectors: Option<&Vectors>,
        progress: &mut dyn FnMut(usize, &str),
    ) -> Result<Self, CheckError> {
        let mut rows = Vec::new();
        if let Some(vectors) = vectors {
            progress(0, "vectors");
            rows.extend(vectors.rows(backends)?);
        }
        for (done, case) in cases().into_iter().enumerate() {
            progress(done, case.name);
            let truths = case.truths()?;
            for backend in backends {
                let groups = group_errors(&case.gradients(*backend)?, &truths);
                let row = Row::new(case.name, backend.name(), "reference", groups, case.most_error);
                rows.push(row);
            }
        }
        Ok(Self { rows })
    }

    /// Rows that exceed their bound.
    pub fn exceeded(&self) -> usize {
        self.rows.iter().filter(|row| !row.is_within).count()
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:22}  {:9}  {:9}", "case", "backend", "against")?;
        let groups =
            ["mean", "ln scale", "quat", "opacity", "sh", "twist", "depth", "background", "loss"];
        for group in groups {
            write!(f, "  {:>7.7}", group.trim_start_matches("ln "))?;
        }
        writeln!(f, "  bound")?;
        for row in &self.rows {
            write!(f, "{:22}  {:9}  {:9}", row.case, row.backend, row.against)?;
            // A case without a group, such as one without depths, leaves its column empty.
            for name in groups {
                match row.groups.iter().find(|group| group.group == name) {
                    Some(group) => write!(f, "  {:7.0e}", group.error)?,
                    None => write!(f, "  {:7}", "")?,
                }
            }
            let verdict = if row.is_within { "" } else { "  EXCEEDED" };
            writeln!(f, "  {:.0e}{verdict}", row.most_error)?;
        }
        Ok(())
    }
}

/// Why the gradients were not compared.
#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    #[error(transparent)]
    Gradient(#[from] GradientError),
    #[error(transparent)]
    Vectors(#[from] VectorError),
}
