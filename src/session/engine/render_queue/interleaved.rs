//! The order in which sessions and render threads use the queue, chosen by a seed.
//!
//! All shared state is behind one lock, so that an order of the critical sections is all that
//! threads can differ in. The threads of this simulation are those of the queue as far as the lock
//! goes: each takes it once, does what [`Frames`] says, and sleeps until [`Frames`] wakes it.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::rc::Rc;

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
    /// Since this many notifications.
    Asleep(u64),
    Ended,
    Rendering {
        frame: u64,
        cost: FrameCost,
        until: Instant,
    },
}

#[derive(Clone, Copy)]
struct Frame {
    number: u64,
    deadline: Instant,
}

/// Counts the notifications: a thread is awake if there was one after it fell asleep.
#[derive(Default)]
struct Notifications(Cell<u64>);

impl Signal for Notifications {
    fn wake_all(&self) {
        self.0.set(self.0.get() + 1);
    }
}

struct Simulation {
    random: Random,
    now: Instant,
    frames: Rc<Frames<Frame, Notifications>>,
    threads: [(Lane, Doing); 3],
    /// The frame that each session waits for.
    waiting: [Option<u64>; SESSIONS],
    /// What became of each frame: whether it was rendered.
    answered: BTreeMap<u64, bool>,
    asked: u64,
    is_closed: bool,
}

impl Simulation {
    fn new(seed: u64) -> Self {
        // Two frames at once, and the lane for small ones.
        let threads = [Lane::Main, Lane::Main, Lane::Side].map(|lane| (lane, Doing::Awake));
        Self {
            random: Random::new(seed, "order", 0),
            now: Instant::now(),
            frames: Rc::new(Frames::new(Notifications::default())),
            threads,
            waiting: [None; SESSIONS],
            answered: BTreeMap::new(),
            asked: 0,
            is_closed: false,
        }
    }

    /// Whether a thread sleeps, and nothing has woken it.
    fn is_asleep(&self, thread: usize) -> bool {
        let notifications = self.frames.changed.0.get();
        matches!(self.threads[thread].1, Doing::Asleep(since) if since == notifications)
    }

    /// A session asks for a frame, if it does not wait for one. A closed queue has no users.
    fn ask(&mut self, session: usize) {
        if self.waiting[session].is_some() || self.is_closed {
            return;
        }
        // A third are large, so that frames wait for the main lane and small ones overtake them.
        let is_large = self.random.below(3) == 0;
        let samples = if is_large { 2 * limits::LARGE_SAMPLES } else { 100 };
        let cost = FrameCost { session: session as u64, samples };
        // A large frame takes 3 ms: some deadlines are too early for it, and most are not.
        let deadline = self.now + Duration::from_millis(1 + self.random.below(40) as u64);
        let number = self.asked;
        self.asked += 1;
        let frame = Frame { number, deadline };
        if self.frames.add(cost, frame, self.now, deadline, |_| ()).is_ok() {
            self.waiting[session] = Some(number);
        }
    }

    fn close(&mut self) {
        self.is_closed = true;
        self.frames.close();
    }

    fn answer(&mut self, frame: u64, is_rendered: bool) {
        assert_eq!(self.answered.insert(frame, is_rendered), None, "frame {frame} has two answers");
        let session = self.waiting.iter_mut().find(|waits| **waits == Some(frame));
        *session.expect("a session waits for each frame") = None;
    }

    /// A render thread has its turn.
    fn turn(&mut self, thread: usize) {
        let lane = self.threads[thread].0;
        if self.is_asleep(thread) {
            return;
        }
        match self.threads[thread].1 {
            Doing::Ended => {}
            Doing::Rendering { until, .. } if until > self.now => {}
            Doing::Rendering { frame, cost, .. } => {
                if is_large(cost) {
                    self.frames.state.lock().rendered(cost, Duration::from_millis(3));
                }
                self.answer(frame, true);
                self.threads[thread].1 = Doing::Awake;
            }
            Doing::Awake | Doing::Asleep(_) => {
                // A thread that still sleeps has returned above, so that this one is awake or was
                // woken.
                self.threads[thread].1 = Doing::Awake;
                self.look(thread, lane);
            }
        }
    }

    /// A render thread looks at the frames.
    fn look(&mut self, thread: usize, lane: Lane) {
        let frames = self.frames.clone();
        match frames.look(frames.state.lock(), lane, self.now, |frame| frame.deadline) {
            Looked::Ends => {
                assert!(self.is_closed, "it is open");
                self.threads[thread].1 = Doing::Ended;
            }
            // The lock is held until it sleeps.
            Looked::Waits(_locked) => {
                self.threads[thread].1 = Doing::Asleep(frames.changed.0.get());
            }
            Looked::Drops(frame) => {
                // A large frame takes 3 ms, and the estimate of that is exact here.
                let left = frame.deadline.saturating_duration_since(self.now);
                assert!(left <= Duration::from_millis(4), "dropped with {left:?} left");
                self.answer(frame.number, false);
            }
            Looked::Renders { cost, job } => {
                assert!(!self.is_closed, "a frame begins after the end");
                assert!(lane == Lane::Main || !is_large(cost), "a large frame beside another");
                assert!(self.now < job.deadline, "a frame begins after its deadline");
                let took = Duration::from_millis(if is_large(cost) { 3 } else { 1 });
                let until = self.now + took;
                self.threads[thread].1 = Doing::Rendering { frame: job.number, cost, until };
            }
        }
    }

    /// No thread sleeps while there is a frame for it, or after the end.
    fn check(&self) {
        let asleep = [0, 1, 2].map(|thread| self.is_asleep(thread));
        if self.is_closed {
            assert_eq!(asleep, [false; 3], "a thread sleeps, and the queue is closed");
            return;
        }
        let mut state = self.frames.state.lock();
        let all_sleep = asleep == [true; 3];
        assert!(!all_sleep || state.queue.len() == 0, "a frame waits, and all threads sleep");
        if state.rendering > 0 && asleep[2] {
            let small = state.queue.pop(limits::LARGE_SAMPLES);
            assert!(small.is_none(), "a small frame waits for a large one");
        }
    }
}

#[test]
fn no_order_of_threads_loses_a_frame() {
    let mut rendered = 0;
    let mut frames = 0;
    let mut dropped = 0;
    for seed in 0..ORDERS {
        let mut simulation = Simulation::new(seed);
        // The queue of every other order is closed, at any time.
        let close_at = (seed % 2 == 0).then(|| simulation.random.below(TURNS / 2));
        for turn in 0..TURNS {
            if close_at == Some(turn) {
                simulation.close();
            }
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
        let state = simulation.frames.state.lock();
        if simulation.is_closed {
            let ended = |(_, doing): &(Lane, Doing)| matches!(doing, Doing::Ended);
            assert!(simulation.threads.iter().all(ended), "seed {seed}: a thread has no end");
            // They are dropped with the queue, which answers their sessions.
            assert_eq!(left.len(), state.queue.len(), "seed {seed}: frames {left:?} are lost");
            dropped += left.len();
        } else {
            assert!(left.is_empty(), "seed {seed}: frames {left:?} have no answer");
        }
        assert_eq!(state.rendering, 0, "seed {seed}: samples are counted for good");
        rendered += simulation.answered.values().filter(|&&is_rendered| is_rendered).count();
        frames += simulation.answered.len();
    }
    // Guards against a simulation in which hardly anything is rendered.
    assert!(rendered > frames / 2, "{rendered} of {frames} frames were rendered");
    assert!(dropped > 100, "{dropped} frames waited at the end");
}
