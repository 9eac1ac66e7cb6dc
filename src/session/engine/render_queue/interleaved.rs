//! The order in which sessions and render threads use the queue, chosen by a seed.
//!
//! All shared state is behind one lock, so that an order of the critical sections is all that
//! threads can differ in. The threads of this simulation are those of the queue as far as the lock
//! goes: each takes it once, does what [`State`] says, and sleeps until it is woken.

use std::collections::BTreeMap;

use wildcity_scene::random::Random;

use super::*;

/// Orders that are tried.
const ORDERS: u64 = 2_000;

/// Critical sections of an order.
const TURNS: usize = 400;

const SESSIONS: usize = 6;

/// What a render thread does.
enum Doing {
    Awake,
    Asleep,
    Rendering { frame: u64, cost: FrameCost, until: Instant },
}

#[derive(Clone, Copy)]
struct Frame {
    number: u64,
    deadline: Instant,
}

struct Simulation {
    random: Random,
    now: Instant,
    state: State<Frame>,
    threads: [(Lane, Doing); 3],
    /// The frame that each session waits for.
    waiting: [Option<u64>; SESSIONS],
    /// What became of each frame: whether it was rendered.
    answered: BTreeMap<u64, bool>,
    frames: u64,
}

impl Simulation {
    fn new(seed: u64) -> Self {
        // Two frames at once, and the lane for small ones.
        let threads = [Lane::Main, Lane::Main, Lane::Side].map(|lane| (lane, Doing::Awake));
        Self {
            random: Random::new(seed, "order", 0),
            now: Instant::now(),
            state: State::new(),
            threads,
            waiting: [None; SESSIONS],
            answered: BTreeMap::new(),
            frames: 0,
        }
    }

    fn wake(&mut self) {
        for (_, doing) in &mut self.threads {
            if matches!(doing, Doing::Asleep) {
                *doing = Doing::Awake;
            }
        }
    }

    /// A session asks for a frame, if it does not wait for one.
    fn ask(&mut self, session: usize) {
        if self.waiting[session].is_some() {
            return;
        }
        let is_large = self.random.below(3) == 0;
        let samples = if is_large { 2 * limits::LARGE_SAMPLES } else { 100 };
        let cost = FrameCost { session: session as u64, samples };
        let deadline = self.now + Duration::from_millis(1 + self.random.below(40) as u64);
        let number = self.frames;
        self.frames += 1;
        let frame = Frame { number, deadline };
        if self.state.add(cost, frame, self.now, deadline).is_ok() {
            self.waiting[session] = Some(number);
            self.wake();
        }
    }

    fn answer(&mut self, frame: u64, is_rendered: bool) {
        assert_eq!(self.answered.insert(frame, is_rendered), None, "frame {frame} has two answers");
        let session = self.waiting.iter_mut().find(|waits| **waits == Some(frame));
        *session.expect("a session waits for each frame") = None;
    }

    /// A render thread has its turn.
    fn turn(&mut self, thread: usize) {
        let lane = self.threads[thread].0;
        match self.threads[thread].1 {
            Doing::Asleep => {}
            Doing::Rendering { until, .. } if until > self.now => {}
            Doing::Rendering { frame, cost, .. } => {
                if is_large(cost) {
                    self.state.rendered(cost, Duration::from_millis(3));
                }
                self.answer(frame, true);
                self.threads[thread].1 = Doing::Awake;
            }
            Doing::Awake => match self.state.next(lane, self.now, |frame| frame.deadline) {
                Next::Ends => unreachable!("it is open"),
                Next::Waits => self.threads[thread].1 = Doing::Asleep,
                Next::Drops(frame) => {
                    // A large frame takes 3 ms, and the estimate of that is exact here.
                    let left = frame.deadline.saturating_duration_since(self.now);
                    assert!(left <= Duration::from_millis(4), "dropped with {left:?} left");
                    self.answer(frame.number, false);
                }
                Next::Renders { cost, job, wakes } => {
                    assert!(lane == Lane::Main || !is_large(cost), "a large frame beside another");
                    assert!(self.now < job.deadline, "a frame begins after its deadline");
                    if wakes {
                        self.wake();
                    }
                    let took = Duration::from_millis(if is_large(cost) { 3 } else { 1 });
                    let until = self.now + took;
                    self.threads[thread].1 = Doing::Rendering { frame: job.number, cost, until };
                }
            },
        }
    }

    /// No thread sleeps while there is a frame for it.
    fn check(&mut self) {
        let is_asleep = |(_, doing): &(Lane, Doing)| matches!(doing, Doing::Asleep);
        let all_sleep = self.threads.iter().all(is_asleep);
        assert!(!all_sleep || self.state.queue.len() == 0, "a frame waits, and all threads sleep");
        let has_large = self.state.rendering > 0;
        if has_large && is_asleep(&self.threads[2]) {
            let small = self.state.queue.pop(limits::LARGE_SAMPLES);
            assert!(small.is_none(), "a small frame waits for a large one");
        }
    }
}

#[test]
fn no_order_of_threads_loses_a_frame() {
    let [mut rendered, mut frames] = [0, 0];
    for seed in 0..ORDERS {
        let mut simulation = Simulation::new(seed);
        for turn in 0..TURNS {
            // No session asks at the end, so that all frames are answered.
            let choices = if turn < TURNS / 2 { 3 + SESSIONS } else { 3 };
            match simulation.random.below(choices) {
                thread @ 0..3 => simulation.turn(thread),
                session => simulation.ask(session - 3),
            }
            simulation.check();
            simulation.now += Duration::from_micros(300);
        }
        let left: Vec<_> = simulation.waiting.iter().flatten().collect();
        assert!(left.is_empty(), "seed {seed}: frames {left:?} have no answer");
        assert_eq!(simulation.state.rendering, 0, "seed {seed}: samples are counted for good");
        rendered += simulation.answered.values().filter(|&&is_rendered| is_rendered).count();
        frames += simulation.answered.len();
    }
    assert!(rendered > frames / 2, "{rendered} of {frames} frames were rendered");
}
