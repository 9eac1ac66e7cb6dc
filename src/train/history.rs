//! The curves of a run: a bounded number of points, whatever the number of steps.

use serde::{Deserialize, Serialize};

/// A step of a run, as a line of JSON.
#[derive(Clone, Debug, Serialize)]
pub struct Line {
    /// Steps that are done.
    pub step: usize,
    pub l1: f64,
    pub dssim: f64,
    /// In 1/m; 0 without measured depths.
    pub disparity: f64,
    /// The mean opacity where the sky is; 0 without a mask of it.
    pub sky: f64,
    /// The weighted sum of the ground's terms.
    pub ground: f64,
    pub gaussians: usize,
    /// Since the first step, without evaluations, and without the time that a run was stopped.
    pub seconds: f64,
    /// Mean of the images that are held out, at the steps that are evaluated.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out_db: Option<f64>,
    /// Wall time of each stage of the frame and its gradients, in milliseconds.
    pub stages_ms: Vec<(&'static str, f64)>,
}

/// Points of a curve. A page is 1,100 px wide: more could not be told apart.
const POINTS: usize = 400;

/// The means of the steps since the point before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Steps that were done.
    pub step: usize,
    /// Since the first step, without evaluations.
    pub seconds: f64,
    pub l1: f64,
    pub dssim: f64,
    /// In 1/m; 0 without measured depths.
    pub disparity: f64,
    /// The mean opacity where the sky is.
    pub sky: f64,
    pub ground: f64,
    pub gaussians: usize,
}

/// The mean PSNR of the images that are held out, after a step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    pub step: usize,
    pub seconds: f64,
    pub held_out_db: f64,
}

/// What a run has been like so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct History {
    pub points: Vec<CurvePoint>,
    pub evaluations: Vec<Evaluation>,
    /// Sums over the steps since the last point.
    sums: CurvePoint,
    steps: usize,
    seconds: f64,
}

impl History {
    /// The time of all steps so far.
    pub fn seconds(&self) -> f64 {
        self.seconds
    }

    /// Adds a step of a run of `steps`.
    pub(crate) fn add(&mut self, line: &Line, steps: usize) {
        self.seconds = line.seconds;
        if let Some(held_out_db) = line.held_out_db {
            let Line { step, seconds, .. } = *line;
            self.evaluations.push(Evaluation { step, seconds, held_out_db });
        }
        self.sums.l1 += line.l1;
        self.sums.dssim += line.dssim;
        self.sums.disparity += line.disparity;
        self.sums.sky += line.sky;
        self.sums.ground += line.ground;
        self.steps += 1;
        // The last step of a run ends a point, however few steps that has.
        if self.steps < steps.div_ceil(POINTS) && line.step < steps {
            return;
        }
        let mean = |sum: f64| sum / self.steps as f64;
        self.points.push(CurvePoint {
            step: line.step,
            seconds: line.seconds,
            l1: mean(self.sums.l1),
            dssim: mean(self.sums.dssim),
            disparity: mean(self.sums.disparity),
            sky: mean(self.sums.sky),
            ground: mean(self.sums.ground),
            gaussians: line.gaussians,
        });
        self.sums = CurvePoint::default();
        self.steps = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_run_has_a_bounded_number_of_points_and_their_means() {
        let mut history = History::default();
        for step in 1..=10_001 {
            let held_out_db = (step == 10_001).then_some(20.0);
            let line = Line {
                step,
                l1: step as f64,
                dssim: 0.5,
                disparity: 0.0,
                sky: 0.0,
                ground: 0.0,
                gaussians: step,
                seconds: step as f64,
                held_out_db,
                stages_ms: Vec::new(),
            };
            history.add(&line, 10_001);
        }
        // 26 steps a point, and the rest of 17.
        assert_eq!(history.points.len(), 385);
        assert_eq!([history.points[0].l1, history.points[1].l1], [13.5, 39.5]);
        assert_eq!(history.points[384].step, 10_001);
        assert_eq!(history.points[384].l1, (9_985..=10_001).sum::<usize>() as f64 / 17.0);
        assert_eq!(history.evaluations.len(), 1);
        assert_eq!(history.seconds(), 10_001.0);
    }
}
