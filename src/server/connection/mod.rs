//! One agent, in lock step: read a request, answer it.
//!
//! A connection may have several sessions. They share its sequence of numbers, so that they can be
//! resumed together.
//!
//! | file | requests |
//! |---|---|
//! | `mod.rs` | the loop, the numbers, and requests for one session |
//! | `opening.rs` | open, branch, resume |
//! | `sharing.rs` | share_memory |
//! | `steps.rs` | step, step_many |
//! | `trace.rs` | their spans |
//!
//! Requests are numbered. A request is carried out if its number follows the last one answered, or
//! repeats one that was refused since the last one that was carried out. A request that was carried
//! out is never carried out again: if its number is repeated, the stored answer is sent again.

mod opening;
mod sharing;
mod steps;
mod trace;

use std::future::pending;
use std::sync::Arc;

use futures_util::FutureExt as _;
use futures_util::future::select_all;
use tokio::time::{Instant, sleep_until, timeout};
use tracing::Instrument as _;

use wildcity_session::{Observation, Outcome, Session, SessionError};

use crate::auth::Grant;
use crate::convert::{self, Command, Parsed};
use crate::fault::Fault;
use crate::inbox::Inbox;
use crate::limits;
use crate::memory::SharedMemory;
use crate::sessions::{Answer, AnsweredRequest, SlotGuard};
use crate::socket::{Disconnect, Incoming, Socket};
use crate::state::ServerState;

/// Serves a client until the connection ends, and then parks its open sessions; or ends them, if
/// the client does not come back.
pub(crate) async fn serve(
    state: Arc<ServerState>,
    socket: Socket,
    grant: Arc<Grant>,
    is_forwarded: bool,
) {
    let hello_deadline = Instant::now() + state.limits.hello;
    // Behind a proxy of this machine every client seems to be local.
    let same_machine = if is_forwarded {
        Err("the connection comes through a proxy")
    } else {
        socket.same_machine()
    };
    let mut inbox = Inbox::new(socket);
    let mut connection = Connection {
        state,
        grant,
        hello_deadline,
        hello_done: false,
        answered_seq: None,
        last: None,
        slots: Vec::new(),
        same_machine,
        memory: None,
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
    /// The sessions, in the order in which they were opened.
    slots: Vec<SlotGuard>,
    /// Whether the client is on this machine; if not, why it seems so.
    same_machine: Result<(), &'static str>,
    /// Memory that the client may have opened, for observations.
    memory: Option<SharedMemory>,
}

/// A request that was refused.
struct Refusal {
    /// Its number, if that could be read.
    seq: Option<u64>,
    fault: Fault,
}

const NO_SESSION: Fault = Fault::SessionState("no session is open; send open or resume");

impl Connection {
    /// Answers requests until the connection ends; returns why it did.
    async fn run(&mut self, inbox: &mut Inbox) -> Disconnect {
        loop {
            let handled = match self.next_request(inbox).await {
                Ok(text) => self.answer(inbox, &text).instrument(trace::request()).await,
                // A binary frame, for example: it has no number, so its refusal has none either,
                // and the next message can be read.
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

    /// Carries out one request and sends its answer.
    async fn answer(&mut self, inbox: &mut Inbox, text: &str) -> Result<(), Disconnect> {
        // The request always runs to its end, even if the client leaves meanwhile: a step is
        // carried out whole or not at all.
        let handled = inbox.during(self.handle(text)).await;
        let send = tracing::debug_span!("send");
        match handled {
            Ok(answer) => self.send(&mut inbox.socket, &answer).instrument(send).await,
            Err(Refusal { seq, fault }) => {
                self.refuse(&mut inbox.socket, seq, &fault).instrument(send).await
            }
        }
    }

    async fn next_request(&mut self, inbox: &mut Inbox) -> Result<String, Disconnect> {
        let idle = self.state.limits.idle;
        let awaited = if self.hello_done { "request" } else { "hello" };
        // Time before `hello` is not extended by pings, or a client without a request could stay
        // for ever.
        let mut deadline =
            if self.hello_done { Instant::now() + idle } else { self.hello_deadline };
        loop {
            // Any of the sessions may be taken over, which ends this connection for all of them.
            // Without sessions this never completes.
            let released = async {
                if self.slots.is_empty() {
                    return pending().await;
                }
                let each = self.slots.iter().map(|slot| Box::pin(slot.release.notified()));
                select_all(each).await;
            };
            let fault = tokio::select! {
                incoming = inbox.next() => match incoming? {
                    Incoming::Text(text) => return Ok(text),
                    // A client that computes for long sends pings to stay. One that has begun a
                    // request has to end it.
                    Incoming::Alive => {
                        if self.hello_done && !inbox.is_within_message() {
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

    /// Carries out one request, or returns the stored answer of a repeated one.
    async fn handle(&mut self, text: &str) -> Result<Answer, Refusal> {
        // Most requests have some hundred bytes, for which a change of threads costs more than
        // parsing.
        let parsed = if text.len() <= limits::INLINE_REQUEST_BYTES {
            convert::parse(text)
        } else {
            let text = text.to_owned();
            // The turn belongs to the work, which goes on if this future is dropped.
            let turn = self.state.parse_turns.clone().acquire_owned().await;
            let parse = move || {
                let _turn = turn;
                convert::parse(&text)
            };
            let parsed = tokio::task::spawn_blocking(parse).await;
            parsed.unwrap_or_else(|error| Parsed::Unnumbered(Fault::Internal(error.to_string())))
        };
        let (seq, session, command) = match parsed {
            Parsed::Numbered { seq, session, command } => (seq, session, command),
            Parsed::Unnumbered(fault) => return Err(Refusal { seq: None, fault }),
        };

        // From here on every refusal has the number, so that the client can match it.
        let refusal = |fault| Refusal { seq: Some(seq), fault };
        // A repeated request gets the stored answer.
        if let Some(last) = &self.last
            && last.seq == seq
        {
            let answer = last.answer.clone();
            return self.delivered(seq, answer).await.map_err(refusal);
        }
        self.check_order(seq).map_err(refusal)?;

        // Carries the request out.
        self.answered_seq = Some(seq);
        for slot in &mut self.slots {
            slot.answered_seq = seq;
        }
        // The number is used up before the command is looked at: a refusal is an answer, too.
        let command = command.map_err(refusal)?;
        trace::note(seq, session.as_deref(), &command);
        // `resume` itself sets the numbers: they continue those of the session.
        let is_resume = matches!(command, Command::Resume { .. });
        let answer = self.carry_out(seq, session.as_deref(), command).await.map_err(refusal)?;

        // Stores the answer in the slots too, where it survives the connection.
        if !is_resume {
            self.last = Some(AnsweredRequest { seq, answer: answer.clone() });
            for slot in &mut self.slots {
                slot.last = self.last.clone();
                slot.answered_seq = seq;
            }
        }
        // Last, because this may fail for want of memory: the answer is stored by then, and can be
        // asked for again.
        self.delivered(seq, answer).await.map_err(refusal)
    }

    /// Accepts the numbers after the last request that was carried out, up to the one after the
    /// last answer: all those between them were refused, and can be used again.
    fn check_order(&self, seq: u64) -> Result<(), Fault> {
        let expected = match (&self.last, self.answered_seq) {
            // `first` is after the last request that was carried out, and `next` after the last one
            // answered. Both exist as soon as one request was answered.
            (None, None) if seq == 0 => return Ok(()),
            (None, None) => "the first request of a connection is 0".to_owned(),
            (last, answered) => {
                // u64::MAX is never exceeded, but a client may send it.
                let first = last.as_ref().map_or(0, |last| last.seq.saturating_add(1));
                let next = answered.map_or(first, |answered| answered.saturating_add(1));
                if (first..=next).contains(&seq) {
                    return Ok(());
                }
                let repeated = last
                    .as_ref()
                    .map(|last| last.seq)
                    .map_or(String::new(), |last| format!(", or repeat request {last}"));
                if first == next {
                    format!("the next request is {next}{repeated}")
                } else {
                    format!("go on with {first} to {next}{repeated}")
                }
            }
        };
        Err(Fault::SeqOutOfOrder { field: "seq", seq, expected })
    }

    /// Carries out a request. `named` is the session that the request names, if any.
    async fn carry_out(
        &mut self,
        seq: u64,
        named: Option<&str>,
        command: Command,
    ) -> Result<Answer, Fault> {
        match command {
            Command::Hello { client } => self.hello(seq, client).await,
            // Before all other commands, so that none of them has to ask.
            _ if !self.hello_done => Err(Fault::WrongOrder("the first request is hello")),
            Command::ShareMemory { proof: None } => self.offer_memory(seq),
            Command::ShareMemory { proof: Some(proof) } => self.open_memory(seq, &proof),
            Command::Open { name, opening, drive } => {
                self.check_room(name.as_ref())?;
                self.open(seq, name, *opening, drive).await
            }
            Command::Branch { name, from } => {
                self.check_room(name.as_ref())?;
                self.branch(seq, name, from).await
            }
            Command::Resume { .. } if !self.slots.is_empty() => {
                Err(Fault::SessionState("a session is open on this connection; close it first"))
            }
            Command::Resume { session, last_seq, also } => {
                self.resume(seq, &session, last_seq, &also).await
            }
            Command::StepMany { steps } => self.step_many(seq, steps).await,
            Command::Step { movement, options } => {
                // The session is looked up again by index for each use, because a reference would
                // borrow all of `self`.
                let slot = self.slot(named)?;
                let metrics = &self.state.metrics;
                let session = self.slots[slot].session.as_mut().ok_or(NO_SESSION)?;
                let frame = steps::step(metrics, session, movement, options).await?;
                self.observation(seq, slot, frame)
            }
            Command::Observe { poses } => {
                let slot = self.slot(named)?;
                let frame = self.session(slot)?.observe(poses).await?;
                self.observation(seq, slot, frame)
            }
            Command::Prefetch { poses } => {
                let slot = self.slot(named)?;
                self.session(slot)?.prefetch(poses)?;
                Ok(Answer::Text(convert::ok(seq)?.into()))
            }
            Command::Snapshot { name } => {
                let slot = self.slot(named)?;
                self.session(slot)?.take_snapshot(name)?;
                Ok(Answer::Text(convert::ok(seq)?.into()))
            }
            Command::Restore { name } => {
                let slot = self.slot(named)?;
                let frame = self.session(slot)?.restore(&name).await?;
                self.observation(seq, slot, frame)
            }
            Command::Reset { options } => {
                let slot = self.slot(named)?;
                let frame = self.session(slot)?.reset_with(options).await?;
                self.observation(seq, slot, frame)
            }
            Command::SwitchVersion { version } => {
                let slot = self.slot(named)?;
                let max_wait = self.state.limits.step;
                // A version may have to be read from a slow store; the session stays on its own if
                // that takes too long.
                let switched = timeout(max_wait, self.session(slot)?.switch_version(version)).await;
                switched.map_err(|_| SessionError::DeadlineExceeded)??;
                self.state.metrics.versions_switched.inc();
                self.slots[slot].update_view();
                let text = convert::switched(seq, self.session(slot)?)?;
                Ok(Answer::Text(text.into()))
            }
            Command::Close => {
                let slot = self.slot(named)?;
                // The name is free before the record is complete, which may take a while.
                let mut session = self.slots[slot].session.take().ok_or(NO_SESSION)?;
                // Dropping the slot frees the name.
                drop(self.slots.remove(slot));
                let name = session.name().to_owned();
                tracing::info!(session = name, "closed");
                let episode = session.episode_name();
                let summary = session.end(Outcome::Completed).await;
                let answer = Answer::Text(convert::closed(seq, &summary, episode)?.into());
                let last = AnsweredRequest { seq, answer: answer.clone() };
                let owner = &self.grant.name;
                self.state.sessions.remember_closed(name, owner, last, &summary);
                // Only now: a client that lost its connection meanwhile finds the answer.
                session.free().await;
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
        // A client must not learn the names of twins that it may not use.
        twins.retain(|twin| self.grant.allows_twin(&twin.name));
        let text = convert::welcome(seq, &self.state.limits, engine, &twins)?;
        tracing::debug!(client, "hello");
        self.hello_done = true;
        Ok(Answer::Text(text.into()))
    }

    /// Index of the session that a request names, or of the only one.
    fn slot(&self, named: Option<&str>) -> Result<usize, Fault> {
        match (named, &self.slots[..]) {
            (_, []) => Err(NO_SESSION),
            // A client with one session need not name it.
            (None, [_]) => Ok(0),
            (None, _) => Err(Fault::InvalidRequest {
                field: Some("session".to_owned()),
                reason: format!("session: name one of {}", self.names().join(", ")),
            }),
            (Some(name), slots) => {
                let unknown =
                    || Fault::NotOnConnection { name: name.to_owned(), open: self.names() };
                slots.iter().position(|slot| slot.name() == name).ok_or_else(unknown)
            }
        }
    }

    /// Names of the open sessions.
    fn names(&self) -> Vec<String> {
        self.slots.iter().map(|slot| slot.name().to_owned()).collect()
    }

    fn session(&mut self, slot: usize) -> Result<&mut Session, Fault> {
        self.slots[slot].session.as_mut().ok_or(NO_SESSION)
    }

    fn observation(&mut self, seq: u64, slot: usize, frame: Observation) -> Result<Answer, Fault> {
        let frame = Arc::new(convert::observation(seq, self.session(slot)?, frame)?);
        // The view first: a push that commits now loads what this session sees next.
        self.slots[slot].update_view();
        self.slots[slot].show(&frame);
        Ok(Answer::Observation(frame))
    }

    async fn send(&self, socket: &mut Socket, answer: &Answer) -> Result<(), Disconnect> {
        match answer {
            Answer::Text(text) => socket.send_text(text).await,
            Answer::Observation(_) | Answer::Many(_) => {
                self.state.metrics.observation_bytes.inc_by(answer.message_bytes());
                socket.send_binary(&answer.message_parts()).await
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
        self.state.metrics.refused(&fault.report().code().0);
        socket.send_text(&fault.answer(seq)).await
    }

    /// Parks the sessions, or ends them if the client does not come back; sends the reason to the
    /// client if that is possible, and closes the socket.
    async fn end(mut self, mut socket: Socket, reason: Disconnect) {
        // The outcome of each episode, unless the client may and does resume its session within the
        // grace period.
        let outcome = match &reason {
            Disconnect::PeerLeft | Disconnect::PeerGone | Disconnect::Fault(Fault::Replaced) => {
                Outcome::AgentLost
            }
            Disconnect::SendTimedOut | Disconnect::Fault(Fault::TimedOut(_)) => {
                Outcome::AgentTimeout
            }
            Disconnect::Fault(Fault::ShuttingDown) => Outcome::ServerError,
            Disconnect::Fault(_) => Outcome::AgentError,
        };
        // The session first: a client that resumes it need not wait for this connection to close.
        for mut slot in self.slots.drain(..) {
            tracing::info!(?reason, "the connection of a session ended");
            slot.outcome = outcome;
            // The client may have left this connection for another one, which waits for the slot.
            let is_resumed = slot.release.notified().now_or_never().is_some();
            let ended = match &reason {
                Disconnect::PeerGone if !is_resumed => slot.session.take(),
                _ => None,
            };
            // Parks the session, or frees its name.
            drop(slot);
            if let Some(session) = ended {
                session.close(outcome).await;
            }
        }
        match &reason {
            Disconnect::Fault(fault) => {
                if self.refuse(&mut socket, None, fault).await.is_ok() {
                    socket.close(Some(fault.close_status())).await;
                }
            }
            Disconnect::PeerLeft | Disconnect::PeerGone => socket.close(None).await,
            // A part of a message was sent: nothing can follow it.
            Disconnect::SendTimedOut => {}
        }
    }
}
