//! One agent, in lock step: read a request, answer it.
//!
//! Requests are numbered. A request is carried out if its number follows the last one answered, or
//! repeats one that was refused since the last one that was carried out. A request that was carried out is
//! never carried out again: if its number is repeated, the stored answer is sent again.

use std::future::pending;
use std::sync::Arc;

use tokio::time::{Instant, sleep_until, timeout};

use wildcity_session::{Observation, Outcome, Session, SessionError, SessionOptions};

use crate::auth::Grant;
use crate::convert::{self, BranchPoint, Command, DriveRequest, Parsed};
use crate::fault::Fault;
use crate::inbox::Inbox;
use crate::limits;
use crate::sessions::{Answer, AnsweredRequest, SlotGuard};
use crate::socket::{Disconnect, Incoming, Socket};
use crate::state::ServerState;

/// Serves a client until the connection ends. An open session is parked then.
pub(crate) async fn serve(state: Arc<ServerState>, socket: Socket, grant: Arc<Grant>) {
    let hello_deadline = Instant::now() + state.limits.hello;
    let mut inbox = Inbox::new(socket);
    let mut connection = Connection {
        state,
        grant,
        hello_deadline,
        hello_done: false,
        answered_seq: None,
        last: None,
        slot: None,
    };
    let reason = connection.run(&mut inbox).await;
    connection.end(inbox.socket, reason).await;
}

struct Connection {
    state: Arc<ServerState>,
    grant: Arc<Grant>,
    /// Time by which `hello` must have arrived; other messages before it do not extend it.
    hello_deadline: Instant,
    hello_done: bool,
    /// Number of the last request answered, refusals included.
    answered_seq: Option<u64>,
    /// The last request carried out, and its answer.
    last: Option<AnsweredRequest>,
    slot: Option<SlotGuard>,
}

/// A request that was refused.
struct Refusal {
    /// Its number, if that could be read.
    seq: Option<u64>,
    fault: Fault,
}

const NO_SESSION: Fault = Fault::SessionState("no session is open; send open or resume");

fn new_session_name() -> String {
    format!("s-{}", uuid::Uuid::now_v7().as_simple())
}

impl Connection {
    /// Answers requests until the connection ends; returns why it did.
    async fn run(&mut self, inbox: &mut Inbox) -> Disconnect {
        loop {
            let handled = match self.next_request(inbox).await {
                Ok(text) => match inbox.during(self.handle(&text)).await {
                    Ok(answer) => self.send(&mut inbox.socket, &answer).await,
                    Err(Refusal { seq, fault }) => {
                        self.refuse(&mut inbox.socket, seq, &fault).await
                    }
                },
                Err(Disconnect::Fault(fault)) if !fault.is_fatal() => {
                    self.refuse(&mut inbox.socket, None, &fault).await
                }
                Err(reason) => Err(reason),
            };
            if let Err(reason) = handled {
                return reason;
            }
        }
    }

    async fn next_request(&mut self, inbox: &mut Inbox) -> Result<String, Disconnect> {
        let idle = self.state.limits.idle;
        let awaited = if self.hello_done { "request" } else { "hello" };
        let mut deadline =
            if self.hello_done { Instant::now() + idle } else { self.hello_deadline };
        loop {
            let released = async {
                match &self.slot {
                    Some(slot) => slot.release.notified().await,
                    None => pending().await,
                }
            };
            let fault = tokio::select! {
                incoming = inbox.next() => match incoming? {
                    Incoming::Text(text) => return Ok(text),
                    Incoming::Alive => {
                        if self.hello_done {
                            deadline = Instant::now() + idle;
                        }
                        continue;
                    }
                },
                () = released => Fault::Replaced,
                () = self.state.stopped() => Fault::ShuttingDown,
                () = sleep_until(deadline) => Fault::TimedOut(awaited),
            };
            return Err(Disconnect::Fault(fault));
        }
    }

    /// Carries out one request, or finds the answer that it had.
    async fn handle(&mut self, text: &str) -> Result<Answer, Refusal> {
        let parsed = if text.len() <= limits::INLINE_REQUEST_BYTES {
            convert::parse(text)
        } else {
            let text = text.to_owned();
            let parsed = tokio::task::spawn_blocking(move || convert::parse(&text)).await;
            parsed.unwrap_or_else(|error| Parsed::Unnumbered(Fault::Internal(error.to_string())))
        };
        let (seq, command) = match parsed {
            Parsed::Numbered { seq, command } => (seq, command),
            Parsed::Unnumbered(fault) => return Err(Refusal { seq: None, fault }),
        };

        // A repeated request gets the stored answer.
        if let Some(last) = &self.last
            && last.seq == seq
        {
            return Ok(last.answer.clone());
        }
        let refusal = |fault| Refusal { seq: Some(seq), fault };
        self.check_order(seq).map_err(refusal)?;

        // Carries the request out.
        self.answered_seq = Some(seq);
        if let Some(slot) = &mut self.slot {
            slot.answered_seq = seq;
        }
        let command = command.map_err(refusal)?;
        // `resume` itself sets the numbers: they continue those of the session.
        let is_resume = matches!(command, Command::Resume { .. });
        let answer = self.carry_out(seq, command).await.map_err(refusal)?;

        // Stores the answer in the slot too, where it survives the connection.
        if let Some(slot) = &self.slot {
            slot.update_view();
            slot.show(&answer);
        }
        if !is_resume {
            self.last = Some(AnsweredRequest { seq, answer: answer.clone() });
            if let Some(slot) = &mut self.slot {
                slot.last = self.last.clone();
                slot.answered_seq = seq;
            }
        }
        Ok(answer)
    }

    /// Accepts the numbers after the last request that was carried out, up to the one after the last answer: all
    /// those between them were refused, and can be used again.
    fn check_order(&self, seq: u64) -> Result<(), Fault> {
        let expected = match (&self.last, self.answered_seq) {
            (None, None) if seq == 0 => return Ok(()),
            (None, None) => "the first request of a connection is 0".to_owned(),
            (last, answered) => {
                let first = last.as_ref().map_or(0, |last| last.seq.saturating_add(1));
                let next = answered.map_or(first, |answered| answered.saturating_add(1));
                if (first..=next).contains(&seq) {
                    return Ok(());
                }
                let repeated = last.as_ref().map(|last| last.seq);
                let repeated =
                    repeated.map_or(String::new(), |last| format!(", or repeat request {last}"));
                match first == next {
                    true => format!("the next request is {next}{repeated}"),
                    false => format!("go on with {first} to {next}{repeated}"),
                }
            }
        };
        Err(Fault::SeqOutOfOrder { field: "seq", seq, expected })
    }

    async fn carry_out(&mut self, seq: u64, command: Command) -> Result<Answer, Fault> {
        match command {
            Command::Hello { client } => self.hello(seq, client).await,
            _ if !self.hello_done => Err(Fault::WrongOrder("the first request is hello")),
            Command::Open { .. } | Command::Branch { .. } | Command::Resume { .. }
                if self.slot.is_some() =>
            {
                Err(Fault::SessionState("a session is open on this connection; close it first"))
            }
            Command::Open { name, opening, drive } => self.open(seq, name, *opening, drive).await,
            Command::Branch { name, from } => self.branch(seq, name, from).await,
            Command::Resume { session, last_seq } => self.resume(seq, &session, last_seq).await,
            Command::Step { movement, options } => {
                let begun = Instant::now();
                let session = self.session()?;
                let done = session.episode().step();
                let frame = session.follow(movement, options).await?;
                let steps = session.episode().step() - done;
                let metrics = &self.state.metrics;
                metrics.steps.inc_by(steps);
                metrics.step_seconds.observe(begun.elapsed().as_secs_f64());
                metrics.queue_seconds.observe(frame.timings.queue.as_secs_f64());
                self.observation(seq, frame)
            }
            Command::Observe { poses } => {
                let frame = self.session()?.observe(poses).await?;
                self.observation(seq, frame)
            }
            Command::Prefetch { poses } => {
                self.session()?.prefetch(poses)?;
                Ok(Answer::Text(convert::ok(seq)?.into()))
            }
            Command::Snapshot { name } => {
                self.session()?.take_snapshot(name)?;
                Ok(Answer::Text(convert::ok(seq)?.into()))
            }
            Command::Restore { name } => {
                let frame = self.session()?.restore(&name).await?;
                self.observation(seq, frame)
            }
            Command::Reset { options } => {
                let frame = self.session()?.reset_with(options).await?;
                self.observation(seq, frame)
            }
            Command::SwitchVersion { version } => {
                let max_wait = self.state.limits.step;
                let switched = timeout(max_wait, self.session()?.switch_version(version)).await;
                switched.map_err(|_| SessionError::DeadlineExceeded)??;
                self.state.metrics.versions_switched.inc();
                let text = convert::switched(seq, self.session()?)?;
                Ok(Answer::Text(text.into()))
            }
            Command::Close => {
                let session = self.slot.as_mut().and_then(|slot| slot.session.take());
                let session = session.ok_or(NO_SESSION)?;
                self.slot = None;
                let name = session.name().to_owned();
                tracing::info!(session = name, "closed");
                let episode = session.episode_name();
                let summary = session.close(Outcome::Completed).await;
                let answer = Answer::Text(convert::closed(seq, &summary, episode)?.into());
                let last = AnsweredRequest { seq, answer: answer.clone() };
                let owner = &self.grant.name;
                self.state.sessions.remember_closed(name, owner, last, &summary);
                Ok(answer)
            }
        }
    }

    async fn hello(&mut self, seq: u64, client: String) -> Result<Answer, Fault> {
        if self.hello_done {
            return Err(Fault::WrongOrder("hello was sent already"));
        }
        let engine = &self.state.engine;
        let mut twins = engine.twins().await?.twins;
        twins.retain(|twin| self.grant.allows_twin(&twin.name));
        let text = convert::welcome(seq, &self.state.limits, engine, &twins)?;
        tracing::debug!(client, "hello");
        self.hello_done = true;
        Ok(Answer::Text(text.into()))
    }

    async fn open(
        &mut self,
        seq: u64,
        name: Option<String>,
        mut opening: SessionOptions,
        drive: Option<DriveRequest>,
    ) -> Result<Answer, Fault> {
        opening.profile = opening.profile.or(&self.state.profile);
        self.grant.require_twin(&opening.twin)?;
        let name = name.unwrap_or_else(new_session_name);
        let slot = self.state.sessions.reserve(name.clone(), &self.grant.name)?;
        let opened = Session::open(self.state.engine.clone(), name, opening);
        self.fill(seq, slot, drive, opened).await
    }

    /// Opens a session in a state of another episode.
    async fn branch(
        &mut self,
        seq: u64,
        name: Option<String>,
        from: BranchPoint,
    ) -> Result<Answer, Fault> {
        let name = name.unwrap_or_else(new_session_name);
        let engine = self.state.engine.clone();
        match from {
            BranchPoint::Snapshot { session, snapshot } => {
                let snapshots = self.state.sessions.snapshots(&session, &self.grant.name)?;
                let from = snapshots.find("from.snapshot", &snapshot)?;
                self.grant.require_twin(from.twin())?;
                let slot = self.state.sessions.reserve(name.clone(), &self.grant.name)?;
                self.fill(seq, slot, None, Session::branch(engine, name, &from)).await
            }
            BranchPoint::Recorded { episode, step } => {
                let from = Session::recorded(&engine, &episode, step).await?;
                self.grant.require_twin(from.twin())?;
                let slot = self.state.sessions.reserve(name.clone(), &self.grant.name)?;
                self.fill(seq, slot, None, Session::continued(engine, name, from)).await
            }
        }
    }

    /// Opens a session into a new slot.
    async fn fill(
        &mut self,
        seq: u64,
        mut slot: SlotGuard,
        drive: Option<DriveRequest>,
        opening: impl Future<Output = Result<Session, SessionError>>,
    ) -> Result<Answer, Fault> {
        let opened = timeout(self.state.limits.step, opening).await;
        let session = opened.map_err(|_| SessionError::DeadlineExceeded)??;
        let text = convert::opened(seq, &session, drive.as_ref())?;
        tracing::info!(session = session.name(), "opened");
        slot.share_snapshots(&session);
        slot.session = Some(session);
        self.slot = Some(slot);
        Ok(Answer::Text(text.into()))
    }

    /// Continues a session, or the numbers of one whose `close` was carried out: its answer may have been lost.
    async fn resume(&mut self, seq: u64, name: &str, last_seq: u64) -> Result<Answer, Fault> {
        let max_wait = self.state.limits.step;
        let check = |answered_seq: u64| {
            if last_seq > answered_seq {
                let expected = format!("{answered_seq} is the session's last answer");
                return Err(Fault::SeqOutOfOrder { field: "last_seq", seq: last_seq, expected });
            }
            Ok(())
        };
        if let Some(closed) = self.state.sessions.closed(name, &self.grant.name) {
            check(closed.last.seq)?;
            let text = convert::resumed(seq, name, closed.last.seq, Err(&closed))?;
            self.answered_seq = Some(closed.last.seq);
            self.last = Some(closed.last);
            return Ok(Answer::Text(text.into()));
        }
        let slot = self.state.sessions.resume(name, &self.grant.name, max_wait).await?;
        check(slot.answered_seq)?;
        let carried_out = slot.last.as_ref().map_or(slot.answered_seq, |last| last.seq);
        let session = slot.session.as_ref().ok_or(NO_SESSION)?;
        let text = convert::resumed(seq, name, carried_out, Ok(session))?;
        tracing::info!(session = session.name(), "resumed");
        self.last = slot.last.clone();
        self.answered_seq = Some(slot.answered_seq);
        self.slot = Some(slot);
        Ok(Answer::Text(text.into()))
    }

    fn session(&mut self) -> Result<&mut Session, Fault> {
        self.slot.as_mut().and_then(|slot| slot.session.as_mut()).ok_or(NO_SESSION)
    }

    fn observation(&mut self, seq: u64, frame: Observation) -> Result<Answer, Fault> {
        let frame = convert::observation(seq, self.session()?, frame)?;
        Ok(Answer::Observation(Arc::new(frame)))
    }

    async fn send(&self, socket: &mut Socket, answer: &Answer) -> Result<(), Disconnect> {
        match answer {
            Answer::Text(text) => socket.send_text(text).await,
            Answer::Observation(frame) => {
                let bytes = frame.buffer.bytes();
                self.state.metrics.observation_bytes.inc_by(bytes.len() as u64);
                socket.send_binary(bytes).await
            }
        }
    }

    async fn refuse(
        &self,
        socket: &mut Socket,
        seq: Option<u64>,
        fault: &Fault,
    ) -> Result<(), Disconnect> {
        tracing::debug!(seq, "refused: {fault}");
        self.state.metrics.refused(&convert::code(fault).0);
        socket.send_text(&convert::refused(seq, fault)).await
    }

    /// Parks the session, sends the reason to the client if that is possible, and closes the socket.
    async fn end(mut self, mut socket: Socket, reason: Disconnect) {
        let outcome = match &reason {
            Disconnect::PeerLeft | Disconnect::Fault(Fault::Replaced) => Outcome::AgentLost,
            Disconnect::SendTimedOut | Disconnect::Fault(Fault::TimedOut(_)) => {
                Outcome::AgentTimeout
            }
            Disconnect::Fault(Fault::ShuttingDown) => Outcome::ServerError,
            Disconnect::Fault(_) => Outcome::AgentError,
        };
        // The session first: a client that resumes it need not wait for this connection to close.
        if let Some(mut slot) = self.slot.take() {
            tracing::info!(?reason, "the connection of a session ended");
            slot.outcome = outcome;
        }
        match &reason {
            Disconnect::Fault(fault) => {
                if self.refuse(&mut socket, None, fault).await.is_ok() {
                    socket.close(Some(convert::close_status(fault))).await;
                }
            }
            Disconnect::PeerLeft => socket.close(None).await,
            // A part of a message was sent: nothing can follow it.
            Disconnect::SendTimedOut => {}
        }
    }
}
