//! Runs that differ in their settings: error against the time that they took.

use serde::Serialize;

/// A run, as a line of a comparison.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ComparedRun {
    /// Width of its images, as a fraction of that of the recorded ones.
    pub size: f64,
    pub steps: usize,
    /// Most Gaussians at any time.
    pub cap: usize,
    /// Gaussians at the end.
    pub gaussians: usize,
    /// Of all steps, without evaluations.
    pub seconds: f64,
    /// Mean PSNR of the images that were held out, which are as large for all runs.
    pub held_out_db: f64,
}

/// What a comparison says to use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Advice<'a> {
    /// The run with the highest PSNR.
    pub best: &'a ComparedRun,
    /// The quickest run that loses at most [`SMALL_LOSS_DB`] of it, if it is another.
    pub quick: Option<&'a ComparedRun>,
}

/// A difference that few see in two pictures side by side.
pub const SMALL_LOSS_DB: f64 = 0.5;

impl ComparedRun {
    /// Whether its images are images: a scene that is none has no PSNR.
    pub fn is_judged(&self) -> bool {
        self.held_out_db.is_finite()
    }
}

/// Whether no other run is as good in less time, or better in as much.
pub fn pareto_front(runs: &[ComparedRun]) -> Vec<bool> {
    let is_dominated = |run: &ComparedRun| {
        runs.iter().any(|other| {
            let db = other.held_out_db;
            (other.seconds < run.seconds && db >= run.held_out_db)
                || (other.seconds <= run.seconds && db > run.held_out_db)
        })
    };
    runs.iter().map(|run| run.is_judged() && !is_dominated(run)).collect()
}

/// What to use; `None` without any run.
pub fn advice(runs: &[ComparedRun]) -> Option<Advice<'_>> {
    let judged = || runs.iter().filter(|run| run.is_judged());
    let best = judged().max_by(|a, b| a.held_out_db.total_cmp(&b.held_out_db))?;
    let is_as_good = |run: &&ComparedRun| run.held_out_db >= best.held_out_db - SMALL_LOSS_DB;
    let quickest = judged().filter(is_as_good).min_by(|a, b| a.seconds.total_cmp(&b.seconds))?;
    // The best run is as good as itself, and may be the quickest.
    Some(Advice { best, quick: (quickest.seconds < best.seconds).then_some(quickest) })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(seconds: f64, held_out_db: f64) -> ComparedRun {
        ComparedRun { size: 0.5, steps: 100, cap: 1_000, gaussians: 900, seconds, held_out_db }
    }

    #[test]
    fn a_run_that_is_slower_and_worse_is_not_on_the_front() {
        let runs = [run(10.0, 20.0), run(20.0, 19.0), run(30.0, 25.0), run(30.0, 24.0)];
        assert_eq!(pareto_front(&runs), [true, false, true, false]);
        // Equal in both: each is on it.
        assert_eq!(pareto_front(&[run(1.0, 1.0), run(1.0, 1.0)]), [true, true]);
    }

    #[test]
    fn the_quick_run_loses_little() {
        let runs = [run(10.0, 24.4), run(20.0, 24.6), run(50.0, 25.0)];
        assert_eq!(advice(&runs), Some(Advice { best: &runs[2], quick: Some(&runs[1]) }));
        assert_eq!(advice(&runs[..1]), Some(Advice { best: &runs[0], quick: None }));
        assert_eq!(advice(&[]), None);
        // A run without a PSNR is neither good nor in the way of others.
        let runs = [run(1.0, f64::NAN), run(50.0, 25.0)];
        assert_eq!(advice(&runs).map(|advice| advice.best), Some(&runs[1]));
        assert_eq!(pareto_front(&runs), [false, true]);
    }
}
