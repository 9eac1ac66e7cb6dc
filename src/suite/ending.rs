//! How a run ended: its exit code, and why.

use crate::compare::{CompareError, Comparison};
use crate::result::SuiteResult;

/// The exit code of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitCode {
    /// All criteria are met.
    Passed = 0,
    /// An episode failed by driving, the pass rate is too low, or the run is worse than the
    /// previous one.
    Driving = 1,
    /// The command line, the suite, a scenario or the previous run is invalid.
    Usage = 2,
    /// An episode was not driven.
    Technical = 3,
    /// With `--verify`: an episode does not repeat.
    NotVerified = 4,
    /// No episode failed more than is allowed, but some were not judged, or left the trained area.
    NotJudged = 5,
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ending {
    pub code: ExitCode,
    pub why: String,
}

impl Ending {
    /// Decides how a run ended. Technical failures take precedence over driving failures, because
    /// an incomplete result says little about the driver.
    ///
    /// Without a required pass rate and without a previous run, every episode must pass. An episode
    /// without a verdict is not a pass in any case: a driver that leaves the trained area would
    /// raise its rate.
    pub fn new(result: &SuiteResult, against: Option<&Result<Comparison, CompareError>>) -> Self {
        let counts = &result.counts;
        let has_failed = counts.failed > 0;
        // Without any verdict, nothing was tested, whatever is accepted.
        // The criteria that a suite accepts are passes already, so `not_judged` has only the
        // others.
        let is_unjudged = counts.not_judged > 0
            || (counts.off_model > 0 && !result.accepts_off_model())
            || result.pass_rate.runs == 0;
        // The lower end of the interval: with few episodes a high rate proves little.
        let low = result.pass_rate.interval[0];
        let rate_is_low = result.at_least.is_some_and(|least| low < least);
        let is_worse = matches!(against, Some(Ok(comparison)) if comparison.worse);
        let is_not_compared = matches!(against, Some(Err(_)));
        let must_all_pass = result.at_least.is_none() && against.is_none();
        // In order of precedence.
        let code = if counts.technical > 0 {
            ExitCode::Technical
        } else if is_not_compared {
            ExitCode::Usage
        } else if rate_is_low || is_worse || (must_all_pass && has_failed) {
            ExitCode::Driving
        } else if is_unjudged {
            ExitCode::NotJudged
        } else {
            ExitCode::Passed
        };
        let mut why = vec![result.counts.to_string()];
        why.extend(result.at_least.map(|least| {
            if rate_is_low {
                format!("the pass rate is at least {low:.3}, and {least} was wanted")
            } else {
                format!("the pass rate is at least {low:.3}, as wanted ({least})")
            }
        }));
        why.extend(against.map(|compared| match compared {
            Ok(comparison) => comparison.conclusion(),
            Err(error) => error.to_string(),
        }));
        Self { code, why: why.join("; ") }
    }

    /// The ending of a run of which some episodes do not repeat, one text for each.
    pub fn not_verified(wrong: &[String]) -> Self {
        Self { code: ExitCode::NotVerified, why: format!("not repeated: {}", wrong.join("; ")) }
    }
}
