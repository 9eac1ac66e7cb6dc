//! The order of frames: start-time fair queueing of the sessions, weighted by cost.
//!
//! Source: Goyal, Vin and Cheng, *Start-time fair queueing*, SIGCOMM 1996. Each frame has a start
//! tag: the later of the queue's virtual time and the finish tag of its session's previous frame.
//! Its finish tag is the start tag plus its cost. The frame with the smallest finish tag is next,
//! and the virtual time becomes its start tag. So each session gets the same number of samples, a
//! small frame passes the large ones that wait, and no frame is passed for ever: the tags of later
//! frames grow with the virtual time.

use std::collections::BTreeMap;

use wildcity_render::{View, sample_count};
use wildcity_scene::RenderProfile;

/// Cost of a frame for the renderer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameCost {
    /// Number of the frame's session.
    pub session: u64,
    /// Samples of all its images: of most images the pixels; of a sweep the beams.
    pub samples: u64,
}

impl FrameCost {
    /// That of images of some views.
    pub fn new(session: u64, views: &[View], profile: &RenderProfile) -> Self {
        Self { session, samples: sample_count(views, profile) }
    }
}

#[derive(Debug)]
pub(super) struct FairQueue<T> {
    /// By finish tag, and then in order of arrival.
    waiting: BTreeMap<(u64, u64), Waiting<T>>,
    /// The finish tag of each session's last frame, if it is later than the virtual time.
    finished: BTreeMap<u64, u64>,
    virtual_time: u64,
    arrivals: u64,
}

#[derive(Debug)]
struct Waiting<T> {
    cost: FrameCost,
    start: u64,
    item: T,
}

impl<T> Default for FairQueue<T> {
    fn default() -> Self {
        Self { waiting: BTreeMap::new(), finished: BTreeMap::new(), virtual_time: 0, arrivals: 0 }
    }
}

impl<T> FairQueue<T> {
    pub(super) fn len(&self) -> usize {
        self.waiting.len()
    }

    pub(super) fn push(&mut self, cost: FrameCost, item: T) {
        // Without an entry its last finish is not later than the virtual time, so that 0 does as
        // well.
        let before = self.finished.get(&cost.session).copied().unwrap_or_default();
        let start = before.max(self.virtual_time);
        // A frame without samples costs 1, so that its tag rises too. At 2²⁹ samples a frame, tags
        // saturate after 2³⁵ frames.
        let finish = start.saturating_add(cost.samples.max(1));
        self.finished.insert(cost.session, finish);
        self.arrivals += 1;
        self.waiting.insert((finish, self.arrivals), Waiting { cost, start, item });
    }

    /// Takes the next frame that has at most `most_samples` samples.
    pub(super) fn pop(&mut self, most_samples: u64) -> Option<(FrameCost, T)> {
        let fits = |waiting: &Waiting<T>| waiting.cost.samples <= most_samples;
        // The first one in nearly all cases. Only the side lane passes large frames, of which at
        // most `QUEUED_FRAMES` wait.
        let (&tag, _) = self.waiting.iter().find(|(_, waiting)| fits(waiting))?;
        let Waiting { cost, start, item } = self.waiting.remove(&tag)?;
        // Lanes take frames out of order, and the virtual time must not go back.
        self.virtual_time = self.virtual_time.max(start);
        // A session without a frame ahead of the virtual time is as good as new.
        let now = self.virtual_time;
        self.finished.retain(|_, finish| *finish > now);
        Some((cost, item))
    }

    /// Samples of all waiting frames that have more than `samples` samples.
    pub(super) fn samples_above(&self, samples: u64) -> u64 {
        let costs = self.waiting.values().map(|waiting| waiting.cost.samples);
        costs.filter(|&own| own > samples).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ANY: u64 = u64::MAX;

    /// Serves `frames` frames of sessions that always have one waiting. Returns how many each
    /// session got.
    fn served(costs: &[u64], frames: usize) -> Vec<usize> {
        let mut queue = FairQueue::default();
        let mut counts = vec![0; costs.len()];
        for (session, &samples) in (0..).zip(costs) {
            queue.push(FrameCost { session, samples }, ());
        }
        for _ in 0..frames {
            let (cost, ()) = queue.pop(ANY).unwrap();
            counts[cost.session as usize] += 1;
            queue.push(cost, ());
        }
        counts
    }

    #[test]
    fn each_session_gets_the_same_number_of_samples() {
        // 10,000 samples for each session are 100 + 1,000 + 1,000 + 200 = 2,300 frames.
        let counts = served(&[100, 10, 10, 50], 2_300);
        for (count, wanted) in counts.iter().zip([100, 1_000, 1_000, 200]) {
            assert!(count.abs_diff(wanted) < 40, "{counts:?}");
        }
    }

    #[test]
    fn a_small_frame_passes_large_ones_that_came_before() {
        let mut queue = FairQueue::default();
        for session in 0..12 {
            queue.push(FrameCost { session, samples: 1 << 27 }, session);
        }
        queue.push(FrameCost { session: 99, samples: 768 }, 99);
        assert_eq!(queue.pop(ANY).unwrap().1, 99);
        // Frames of exactly 768 samples do not count.
        assert_eq!(queue.samples_above(768), 12 << 27);
        // Frames of equal cost are served in order of arrival.
        let order: Vec<u64> = std::iter::from_fn(|| queue.pop(ANY)).map(|(_, item)| item).collect();
        assert_eq!(order, (0..12).collect::<Vec<_>>());
        assert_eq!(queue.pop(ANY).map(|(_, item)| item), None);
    }

    #[test]
    fn a_large_frame_is_not_passed_for_ever() {
        let mut queue = FairQueue::default();
        queue.push(FrameCost { session: 0, samples: 1_000 }, 0);
        let mut passed = 0;
        loop {
            // The tag of the large frame is 1,000, and those of the small ones are 10, 20, 30 ..:
            // about a hundred come first.
            queue.push(FrameCost { session: 1, samples: 10 }, 1);
            match queue.pop(ANY).unwrap().1 {
                0 => break,
                _ => passed += 1,
            }
            assert!(passed <= 101, "frames of the other session came first");
        }
        // New sessions are no way around it: their frames start at the virtual time.
        assert_eq!(queue.pop(5).map(|(_, item)| item), None, "the one that waits is larger");
    }
}
