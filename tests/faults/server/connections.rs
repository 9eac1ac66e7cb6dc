//! Histories of connections: agents drive, each with a session of its own, over connections that
//! are cut at any byte, or that they leave after sending a request. They resume, and repeat the
//! request whose answer they did not get; some never come back. In some histories a frame does not
//! end, so that its deadline passes.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fmt;
use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use futures_util::future::join_all;
use futures_util::{SinkExt as _, StreamExt as _};
use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use tokio::io::DuplexStream;
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use wildcity_scene::geometry::Pose;

use crate::config::Limits;

use super::machine::{CLIENT_TIMEOUT, Machine, SimServer};
use super::network::{Cut, CutStream};
use super::random::Random;
use super::support::{Painter, Seen, pose, rig};

/// WebSocket connections at once.
const CONNECTIONS: usize = 32;

/// Largest number of connections of an agent: each of its cuts takes one, and so may a takeover.
const MOST_CONNECTIONS: usize = 40;

/// Deadline of an agent whose frames are late, in milliseconds, and the longest time until its answer:
/// threads of other histories may have the processors meanwhile.
const DEADLINE_MS: u64 = 30;
const LATE_WITHIN: Duration = Duration::from_secs(5);

/// As [`LATE_WITHIN`], of histories with a planted fault.
const PLANTED_WITHIN: Duration = Duration::from_millis(500);

/// Attempts of a request whose deadline passes on a busy machine.
const ATTEMPTS: usize = 100;

/// Names of sessions are used once: the episodes of all histories are in one directory.
static NAMES: AtomicU64 = AtomicU64::new(0);

/// A fault of a connection, as it shows at the client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Plant {
    /// A request that was carried out is carried out again after `resume`.
    StepsTwice,
    /// The permit of a connection is kept, if its client leaves without waiting for an answer.
    PermitLeaked,
    /// So is the memory of an answer.
    ReservationForgotten,
    /// Sessions have no deadline.
    DeadlineIgnored,
}

/// A request of an agent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Request {
    Step {
        x_m: u8,
    },
    /// A step whose frame does not end before its deadline; it is repeated.
    Late {
        x_m: u8,
    },
    Reset,
}

/// Fault of one connection.
#[derive(Clone, Copy, Debug)]
struct ConnectionFaults {
    cut: Cut,
    /// Whether the server is not notified of the cut.
    is_unclosed: bool,
    /// Whether each request is sent twice.
    repeats: bool,
    /// Bytes that are on their way at once.
    buffer_bytes: usize,
    /// Whether the client waits before it connects.
    waits: bool,
    /// The message after which the client leaves without waiting for its answer.
    leaves_after: Option<u64>,
}

/// An agent: its requests, and its connections.
#[derive(Clone, Debug)]
struct Agent {
    requests: Vec<Request>,
    /// Then comes one that nothing happens to, unless the agent stays away.
    connections: Vec<ConnectionFaults>,
    stays_away: bool,
}

/// A history of connections.
#[derive(Clone)]
pub(super) struct Connections {
    seed: u64,
    agents: Vec<Agent>,
}

impl Connections {
    /// Number of requests and of connections that are cut.
    pub(super) fn parts(&self) -> usize {
        self.agents.iter().map(|agent| agent.requests.len() + agent.connections.len()).sum()
    }
}

impl super::History for Connections {
    type Plant = Plant;

    fn from_seed(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let count = 1 + random.below(3);
        let agents = (0..count as u8).map(|index| Agent::random(&mut random, index)).collect();
        Self { seed, agents }
    }

    fn run(&self, machine: &Machine, plant: Option<Plant>) -> Result<(), String> {
        machine.runtime.block_on(async {
            let limits = Limits { connections: CONNECTIONS, ..Limits::default() };
            let server = machine.server(limits, None, Err("no uploads here".to_owned()));
            // Long enough for a busy machine; what is planted never comes.
            let patience = if plant.is_some() { PLANTED_WITHIN } else { LATE_WITHIN };
            let network = Network { server, unclosed: RefCell::default(), patience };
            let agents = self.agents.iter().map(|agent| {
                let name = format!("agent-{}", NAMES.fetch_add(1, Ordering::Relaxed));
                let network = &network;
                async move {
                    let driven = timeout(CLIENT_TIMEOUT, agent.drive(network, &name, plant)).await;
                    let driven = driven.unwrap_or_else(|_| Err("does not end".to_owned()));
                    driven.map_err(|reason| format!("{name}: {reason}"))
                }
            });
            let driven = join_all(agents).await.into_iter().collect::<Result<Vec<_>, String>>()?;
            let least = |driven: &Driven| driven.steps;
            let most = |driven: &Driven| driven.steps + driven.last_steps;
            let steps = driven.iter().map(least).sum()..=driven.iter().map(most).sum();
            let away = self.agents.iter().filter(|agent| agent.stays_away).count();
            network.finish(steps, away).await
        })
    }

    fn shorter(&self) -> Vec<Self> {
        let mut all = Vec::new();
        for index in 0..self.agents.len() {
            let mut change = |change: &dyn Fn(&mut Vec<Agent>)| {
                let mut shorter = self.clone();
                change(&mut shorter.agents);
                all.push(shorter);
            };
            change(&|agents| {
                agents.remove(index);
            });
            for request in 0..self.agents[index].requests.len() {
                change(&|agents| {
                    agents[index].requests.remove(request);
                });
            }
            if self.agents[index].stays_away {
                change(&|agents| agents[index].stays_away = false);
            }
            for connection in 0..self.agents[index].connections.len() {
                change(&|agents| {
                    agents[index].connections.remove(connection);
                });
            }
        }
        all
    }
}

impl fmt::Display for Connections {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "seed {}", self.seed)?;
        for Agent { requests, connections, stays_away } in &self.agents {
            let end = if *stays_away { ", then away" } else { "" };
            writeln!(f, "  {requests:?}{end}")?;
            for faults in connections {
                writeln!(f, "    {faults:?}")?;
            }
        }
        Ok(())
    }
}

impl Agent {
    fn random(random: &mut Random, index: u8) -> Self {
        let count = 1 + random.below(5);
        // Agents are at different places, so that no answer fits another agent.
        let request = |random: &mut Random| match random.below(6) {
            0 => Request::Reset,
            _ => Request::Step { x_m: 1 + 3 * index + random.below(3) as u8 },
        };
        let mut requests: Vec<Request> = (0..count).map(|_| request(random)).collect();
        let count = random.below(5);
        let connections = (0..count).map(|_| ConnectionFaults::random(random)).collect();
        // Of one agent only, since frames of all agents wait meanwhile; and seldom, since it takes
        // time.
        if index == 0 && random.once_in(8) {
            let late = random.below(requests.len() as u64) as usize;
            requests[late] = Request::Late { x_m: 1 };
        }
        Self { requests, connections, stays_away: random.once_in(4) }
    }

    fn is_late(&self) -> bool {
        self.requests.iter().any(|request| matches!(request, Request::Late { .. }))
    }
}

impl ConnectionFaults {
    /// The connection that nothing happens to.
    const NONE: Self = Self {
        cut: Cut::Never,
        is_unclosed: false,
        repeats: false,
        buffer_bytes: 64 << 10,
        waits: false,
        leaves_after: None,
    };

    fn random(random: &mut Random) -> Self {
        // The handshake has about 200 bytes each way, a request 150, an observation 2,000.
        let cut = match random.below(3) {
            0 => Cut::Sent(random.below(1_200)),
            1 => Cut::Received(random.below(900)),
            _ => Cut::Received(random.below(12_000)),
        };
        let is_unclosed = random.once_in(4);
        let buffer_bytes = [17, 300, 64 << 10][random.below(3) as usize];
        let repeats = random.once_in(4);
        // Hello, resume, open, the requests, and close.
        let leaves_after = random.once_in(3).then(|| random.below(9));
        // The server waits for a client that does not read, and the simulation would wait as well.
        let buffer_bytes = if is_unclosed || repeats { 64 << 10 } else { buffer_bytes };
        Self { cut, is_unclosed, repeats, buffer_bytes, waits: random.once_in(4), leaves_after }
    }
}

/// A server, and the connections to it that no client uses any more.
struct Network {
    server: SimServer,
    unclosed: RefCell<Vec<DuplexStream>>,
    /// How long it waits for what has to come.
    patience: Duration,
}

/// One connection of an agent.
struct Link {
    socket: WebSocketStream<CutStream>,
    faults: ConnectionFaults,
    /// Requests that were sent.
    sent: u64,
    /// Whether the session has had another connection.
    is_resumed: bool,
    /// Whether the deadline of the session may pass.
    has_deadline: bool,
}

/// What came of an agent.
struct Driven {
    /// Steps that were answered.
    steps: u64,
    /// Steps that may have been carried out beyond them.
    last_steps: u64,
}

/// Frames that have begun do not end, until this is dropped.
struct HeldFrames<'a>(&'a Painter);

impl<'a> HeldFrames<'a> {
    fn new(painter: &'a Painter) -> Self {
        painter.held.store(true, Ordering::SeqCst);
        Self(painter)
    }
}

impl Drop for HeldFrames<'_> {
    fn drop(&mut self) {
        self.0.held.store(false, Ordering::SeqCst);
    }
}

/// The connection is cut.
struct Lost;

/// Where an agent is in its requests.
struct Progress<'a> {
    name: &'a str,
    /// Number of the request `open`, once that is carried out.
    opened_seq: Option<u64>,
    /// Requests that were answered, `close` included.
    answered: usize,
    /// Steps since the last reset.
    steps: u64,
    /// Whether the frame of the next request was late once.
    was_late: bool,
}

impl Agent {
    /// Opens a session, sends all requests, and closes it. Returns which promise is broken.
    async fn drive(
        &self,
        network: &Network,
        name: &str,
        plant: Option<Plant>,
    ) -> Result<Driven, String> {
        let mut progress =
            Progress { name, opened_seq: None, answered: 0, steps: 0, was_late: false };
        let mut connections = self.connections.iter();
        for _ in 0..MOST_CONNECTIONS {
            if self.stays_away && connections.len() == 0 {
                return Ok(self.driven(&progress));
            }
            let faults = *connections.next().unwrap_or(&ConnectionFaults::NONE);
            if faults.waits {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            let Ok(mut link) = network.connect(faults).await else { continue };
            let driven = self.drive_link(&mut link, network, &mut progress, plant).await;
            if link.has_left() {
                network.plant(plant);
            }
            if faults.is_unclosed {
                network.unclosed.borrow_mut().push(link.socket.into_inner().into_unclosed());
            }
            match driven {
                Ok(Ok(())) => return Ok(self.driven(&progress)),
                Ok(Err(promise)) => return Err(promise),
                Err(Lost) => {}
            }
        }
        Err(format!("not at the end after {MOST_CONNECTIONS} connections"))
    }

    /// What came of it, however it ended.
    fn driven(&self, progress: &Progress<'_>) -> Driven {
        let is_step = |request: &&Request| !matches!(request, Request::Reset);
        let (answered, others) = self.requests.split_at(progress.answered);
        let steps = answered.iter().filter(is_step).count() as u64;
        Driven { steps, last_steps: others.iter().take(1).filter(is_step).count() as u64 }
    }

    /// Continues to drive over one connection.
    async fn drive_link(
        &self,
        link: &mut Link,
        network: &Network,
        progress: &mut Progress<'_>,
        plant: Option<Plant>,
    ) -> Result<Result<(), String>, Lost> {
        let client = json!({ "name": "simulation", "version": "1" });
        let hello = json!({ "type": "hello", "client": client, "protocols": ["wildcity.v1"] });
        link.ask(0, hello).await?;
        let mut open = json!({
            "type": "open", "twin": "test", "session": progress.name,
            "outputs": { "encoding": "raw" },
        });
        if self.is_late() && plant != Some(Plant::DeadlineIgnored) {
            open["deadline_ms"] = DEADLINE_MS.into();
            link.has_deadline = true;
        }
        let mut seq = 1;

        // Continues the session, if it was opened.
        let last_seq = progress.opened_seq.map_or(0, |opened| opened + progress.answered as u64);
        let resume = json!({ "type": "resume", "session": progress.name, "last_seq": last_seq });
        let resumed = link.ask_once(seq, resume).await?;
        let carried_out = resumed["last_seq"].as_u64();
        match (resumed["type"].as_str(), resumed["code"].as_str(), carried_out) {
            (Some("resumed"), _, Some(carried_out)) => {
                link.is_resumed = true;
                let opened = *progress.opened_seq.get_or_insert(carried_out);
                let next = opened + progress.answered as u64 + 1;
                if carried_out + 1 != next && carried_out != next {
                    return Ok(Err(format!("{carried_out} was carried out before {next}")));
                }
                if plant == Some(Plant::StepsTwice) && carried_out == next {
                    progress.opened_seq = Some(opened + 1);
                }
            }
            (_, Some("unknown_session"), _) if progress.opened_seq.is_none() => {
                seq += 1;
                let opened = link.ask(seq, open).await?;
                match (opened["type"].as_str(), opened["code"].as_str()) {
                    (Some("opened"), _) => progress.opened_seq = Some(seq),
                    // The request of an earlier connection arrived meanwhile.
                    (_, Some("session_exists")) => return Err(Lost),
                    _ => return Ok(Err(format!("open is answered with {opened}"))),
                }
            }
            _ => return Ok(Err(format!("resume is answered with {resumed}"))),
        }

        while progress.answered < self.requests.len() {
            let request = self.requests[progress.answered];
            let next = progress.next_seq();
            let body = match request {
                Request::Step { x_m } | Request::Late { x_m } => {
                    json!({ "type": "step", "pose": pose(x_m.into()) })
                }
                Request::Reset => json!({ "type": "reset" }),
            };
            if matches!(request, Request::Late { .. }) && !progress.was_late {
                progress.was_late = true;
                if let Err(promise) = link.be_late(network, next, body.clone()).await? {
                    return Ok(Err(promise));
                }
            }
            let seen = match self.observed(link, next, body).await? {
                Ok(seen) => seen,
                Err(said) => return Ok(Err(format!("request {next} is answered with {said}"))),
            };
            progress.was_late = false;
            progress.steps = if request == Request::Reset { 0 } else { progress.steps + 1 };
            if let Err(promise) = progress.check(&seen, next, request) {
                return Ok(Err(promise));
            }
            progress.answered += 1;
        }
        let next = progress.next_seq();
        let closed = link.ask(next, json!({ "type": "close" })).await?;
        match closed["type"].as_str() {
            Some("closed") if closed["summary"]["steps"] == json!(progress.steps) => Ok(Ok(())),
            _ => Ok(Err(format!("close after {} steps is answered with {closed}", progress.steps))),
        }
    }

    /// An observation. An agent with a short deadline asks again.
    async fn observed(
        &self,
        link: &mut Link,
        seq: u64,
        body: Value,
    ) -> Result<Result<Seen, String>, Lost> {
        let mut answer = link.observe(seq, body.clone()).await?;
        for _ in 0..ATTEMPTS {
            match &answer {
                Err(said) if self.is_late() && said.contains("deadline_exceeded") => {}
                _ => break,
            }
            answer = link.observe(seq, body.clone()).await?;
        }
        Ok(answer)
    }
}

impl Progress<'_> {
    /// Number of the next request of the session.
    fn next_seq(&self) -> u64 {
        self.opened_seq.unwrap_or_default() + self.answered as u64 + 1
    }

    /// Compares an observation with that of a session over one connection.
    fn check(&self, seen: &Seen, seq: u64, request: Request) -> Result<(), String> {
        let time_us = 100_000 * self.steps;
        let found = [&seen.meta["seq"], &seen.meta["step"], &seen.meta["time_us"]];
        let expected = [json!(seq), json!(self.steps), json!(time_us)];
        if found.into_iter().ne(expected.iter()) {
            return Err(format!("{request:?}: seq, step and time are {found:?}, not {expected:?}"));
        }
        let (Request::Step { x_m } | Request::Late { x_m }) = request else { return Ok(()) };
        let world_from_rig =
            Pose { position_m: DVec3::new(x_m.into(), 0.0, 0.0), rotation: DQuat::IDENTITY };
        let tensors = seen.tensors();
        for (name, image) in images(&world_from_rig) {
            if tensors.tensor(&name).ok().is_none_or(|tensor| tensor.data() != image) {
                return Err(format!("{request:?}: {name} is not the image of that place"));
            }
        }
        Ok(())
    }
}

/// The images of all cameras from a place, by the names of their tensors.
fn images(world_from_rig: &Pose) -> BTreeMap<String, Vec<u8>> {
    let cameras = rig().cameras;
    let image = |camera: &wildcity_scene::rig::RigCamera| {
        let world_from_camera = *world_from_rig * camera.rig_from_camera;
        (format!("camera/{}/rgb", camera.name), Painter::image(&world_from_camera, &camera.camera))
    };
    cameras.iter().map(image).collect()
}

impl Network {
    async fn connect(&self, faults: ConnectionFaults) -> Result<Link, Lost> {
        let (stream, _) = self.server.connect(faults.buffer_bytes).await;
        let stream = CutStream::new(stream, faults.cut);
        let mut request = "ws://localhost/v1/session".into_client_request().map_err(|_| Lost)?;
        let subprotocol = "wildcity.v1".parse().map_err(|_| Lost)?;
        request.headers_mut().insert("Sec-WebSocket-Protocol", subprotocol);
        let (socket, _) =
            tokio_tungstenite::client_async(request, stream).await.map_err(|_| Lost)?;
        Ok(Link { socket, faults, sent: 0, is_resumed: false, has_deadline: false })
    }

    /// A fault of the server that shows after a client has left.
    fn plant(&self, plant: Option<Plant>) {
        let state = &self.server.state;
        match plant {
            Some(Plant::PermitLeaked) => {
                std::mem::forget(state.websocket_permits.clone().try_acquire_owned());
            }
            Some(Plant::ReservationForgotten) => {
                self.server.keep(state.engine.reserve_answer_bytes(1));
            }
            _ => {}
        }
    }

    /// Checks that each step was carried out once, and that nothing is left of the connections and
    /// sessions. Some agents stayed `away`: their sessions end now.
    async fn finish(self, steps: RangeInclusive<u64>, away: usize) -> Result<(), String> {
        let Self { server, unclosed, patience } = self;
        drop(unclosed);
        let state = &server.state;
        let permits = || state.websocket_permits.available_permits();
        settled(patience, || permits() == CONNECTIONS && state.sessions.count() <= away).await;
        let sessions = state.sessions.count();
        if permits() < CONNECTIONS || sessions > away {
            let permits = permits();
            return Err(format!("{sessions} sessions stay, and {permits} permits are free"));
        }
        state.sessions.end_all_parked().await;
        let engine = &state.engine;
        let left = || {
            let sessions = state.sessions.count() as u64;
            [sessions, engine.answer_bytes(), engine.residency().reserved_bytes]
        };
        // A frame that was late may still be drawn.
        settled(patience, || left() == [0; 3] && engine.queued_frames() == 0).await;
        if left() != [0; 3] {
            let [sessions, answers, reserved] = left();
            return Err(format!(
                "{sessions} sessions stay, {answers} bytes of answers and {reserved} reserved bytes"
            ));
        }
        match state.metrics.steps.get() {
            carried_out if steps.contains(&carried_out) => Ok(()),
            carried_out => Err(format!("{carried_out} steps were made, not {steps:?}")),
        }
    }
}

/// Waits until a condition holds. The caller looks again, whether it does.
async fn settled(patience: Duration, holds: impl Fn() -> bool) {
    let waiting = async {
        while !holds() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    let _ = timeout(patience, waiting).await;
}

impl Link {
    /// Asks for a frame that does not end.
    async fn be_late(
        &mut self,
        network: &Network,
        seq: u64,
        body: Value,
    ) -> Result<Result<(), String>, Lost> {
        let _held = HeldFrames::new(&network.server.painter);
        let begun = Instant::now();
        let Ok(answer) = timeout(network.patience, self.observe(seq, body)).await else {
            return Ok(Err(format!("request {seq} has a deadline and no answer")));
        };
        match answer? {
            Err(said) if said.contains("deadline_exceeded") => Ok(Ok(())),
            // A connection before this one may have asked for it already.
            Ok(_) if self.is_resumed => Ok(Ok(())),
            Ok(_) => Ok(Err(format!("request {seq} has a frame after {:?}", begun.elapsed()))),
            Err(said) => Ok(Err(format!("request {seq}, which is late, is answered with {said}"))),
        }
    }

    /// Sends a request several times. Each is answered, with the same bytes, unless the deadline of
    /// the first passes.
    async fn exchange(
        &mut self,
        seq: u64,
        mut request: Value,
        times: usize,
    ) -> Result<Message, Lost> {
        request["seq"] = seq.into();
        let text = request.to_string();
        for _ in 0..times {
            self.socket.send(Message::text(text.clone())).await.map_err(|_| Lost)?;
        }
        self.sent += 1;
        if self.has_left() {
            return Err(Lost);
        }
        let mut answers = Vec::new();
        for _ in 0..times {
            match self.socket.next().await {
                Some(Ok(message @ (Message::Text(_) | Message::Binary(_)))) => {
                    answers.push(message);
                }
                _ => return Err(Lost),
            }
        }
        answers.dedup();
        // On a busy machine the deadline of the first may pass. It was not carried out, and the
        // second one may be.
        if let [first, _] = answers.as_slice()
            && self.has_deadline
            && first.to_text().is_ok_and(|said| said.contains("deadline_exceeded"))
        {
            answers.remove(0);
        }
        assert_eq!(answers.len(), 1, "a repeated request has two answers: {answers:?}");
        answers.pop().ok_or(Lost)
    }

    /// Whether the client has left after its last request.
    fn has_left(&self) -> bool {
        self.faults.leaves_after.is_some_and(|last| self.sent > last)
    }

    fn times(&self) -> usize {
        if self.faults.repeats { 2 } else { 1 }
    }

    async fn ask(&mut self, seq: u64, request: Value) -> Result<Value, Lost> {
        let answer = self.exchange(seq, request, self.times()).await?;
        serde_json::from_slice(&answer.into_data()).map_err(|_| Lost)
    }

    /// As [`Link::ask`], for a request after which the numbers continue from a different value.
    async fn ask_once(&mut self, seq: u64, request: Value) -> Result<Value, Lost> {
        let answer = self.exchange(seq, request, 1).await?;
        serde_json::from_slice(&answer.into_data()).map_err(|_| Lost)
    }

    /// An observation, or the answer in its place.
    async fn observe(&mut self, seq: u64, request: Value) -> Result<Result<Seen, String>, Lost> {
        Ok(match self.exchange(seq, request, self.times()).await? {
            Message::Binary(bytes) => Ok(Seen::decode(bytes)),
            other => Err(other.to_string()),
        })
    }
}
