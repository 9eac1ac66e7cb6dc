//! One agent, in lock step: read a request, answer it.
//!
//! A connection may have several sessions. They share its numbers, so that they can be resumed together.
//!
//! Requests are numbered. A request is carried out if its number follows the last one answered, or
//! repeats one that was refused since the last one that was carried out. A request that was carried out is
//! never carried out again: if its number is repeated, the stored answer is sent again.

use std::future::pending;
use std::sync::Arc;

use futures_util::future::{join_all, select_all};
use tokio::time::{Instant, sleep_until, timeout};

use wildcity_session::{Observation, Outcome, Session, SessionError, SessionOptions, StepOptions};

use crate::auth::Grant;
use crate::convert::{self, AlsoResumed, BranchPoint, Command, DriveRequest, Parsed, SessionStep, Stepped};
use crate::fault::Fault;
use crate::inbox::Inbox;
use crate::limits;
use crate::metrics::Metrics;
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
        slots: Vec::new(),
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
                if self.slots.is_empty() {
                    return pending().await;
                }
                let each = self.slots.iter().map(|slot| Box::pin(slot.release.notified()));
                select_all(each).await;
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
        let (seq, session, command) = match parsed {
            Parsed::Numbered { seq, session, command } => (seq, session, command),
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
        for slot in &mut self.slots {
            slot.answered_seq = seq;
        }
        let command = command.map_err(refusal)?;
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

    /// Carries out a request. `named` is the session that it is for, if it names one.
    async fn carry_out(
        &mut self,
        seq: u64,
        named: Option<&str>,
        command: Command,
    ) -> Result<Answer, Fault> {
        match command {
            Command::Hello { client } => self.hello(seq, client).await,
            _ if !self.hello_done => Err(Fault::WrongOrder("the first request is hello")),
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
                let slot = self.slot(named)?;
                let metrics = &self.state.metrics;
                let session = self.slots[slot].session.as_mut().ok_or(NO_SESSION)?;
                let frame = step(metrics, session, movement, options).await?;
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
                let switched = timeout(max_wait, self.session(slot)?.switch_version(version)).await;
                switched.map_err(|_| SessionError::DeadlineExceeded)??;
                self.state.metrics.versions_switched.inc();
                self.slots[slot].update_view();
                let text = convert::switched(seq, self.session(slot)?)?;
                Ok(Answer::Text(text.into()))
            }
            Command::Close => {
                let slot = self.slot(named)?;
                let session = self.slots[slot].session.take().ok_or(NO_SESSION)?;
                // Dropping the slot frees the name.
                drop(self.slots.remove(slot));
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

    /// Checks that another session of this name can be opened: the second one of a connection needs one, so that a
    /// client that has forgotten to close the first is told.
    fn check_room(&self, name: Option<&String>) -> Result<(), Fault> {
        let limit = limits::CONNECTION_SESSIONS;
        if !self.slots.is_empty() && name.is_none() {
            return Err(Fault::SessionState(
                "a session is open on this connection; close it first, or name the next one",
            ));
        }
        if self.slots.len() >= limit {
            return Err(Fault::Busy { what: "sessions on this connection", limit });
        }
        Ok(())
    }

    /// Carries out steps of several sessions at once: their frames wait for the renderer together.
    async fn step_many(&mut self, seq: u64, steps: Vec<SessionStep>) -> Result<Answer, Fault> {
        if self.slots.is_empty() {
            return Err(NO_SESSION);
        }
        let open = self.names();
        let named = |slot: &&SlotGuard| steps.iter().any(|step| step.session == slot.name());
        let sessions = self.slots.iter().filter(named).filter_map(|slot| slot.session.as_ref());
        let pixels: u64 = sessions.map(Session::step_pixels).sum();
        let limit = wildcity_session::limits::ANSWER_PIXELS;
        if pixels > limit {
            return Err(SessionError::AnswerTooLarge { field: "steps", pixels, limit }.into());
        }

        let metrics = &self.state.metrics;
        let mut slots: Vec<_> = self.slots.iter_mut().map(Some).collect();
        let carried_out = steps.into_iter().map(|SessionStep { session: name, step: asked }| {
            let slot = open.iter().position(|known| *known == name);
            let slot = slot.and_then(|slot| slots[slot].take());
            let open = &open;
            async move {
                let result = async {
                    let (movement, options) = asked?;
                    let unknown =
                        || Fault::NotOnConnection { name: name.clone(), open: open.clone() };
                    let slot = slot.ok_or_else(unknown)?;
                    let session = slot.session.as_mut().ok_or(NO_SESSION)?;
                    let frame = self::step(metrics, session, movement, options).await?;
                    let frame = Arc::new(convert::observation(seq, session, frame)?);
                    slot.update_view();
                    slot.show(&frame);
                    Ok(frame)
                };
                let result = result.await;
                Stepped { session: name, result }
            }
        });
        let stepped = join_all(carried_out).await;
        for fault in stepped.iter().filter_map(|step| step.result.as_ref().err()) {
            tracing::debug!(seq, "refused: {fault}");
            metrics.refused(&convert::code(fault).0);
        }
        Ok(Answer::Many(Arc::new(convert::many(seq, stepped)?)))
    }

    async fn hello(&mut self, seq: u64, client: String) -> Result<Answer, Fault> {
        if self.hello_done {
            return Err(Fault::WrongOrder("hello was sent already"));
        }
        let engine = &self.state.engine;
        let mut twins = engine.twins().await?.twins;
        twins.retain(|twin| self.grant.allows_twin(&twin.name));
        let text = convert::welcome(seq, &self.state.limits, engine.backend(), &twins)?;
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
        slot.update_view();
        self.slots.push(slot);
        Ok(Answer::Text(text.into()))
    }

    /// Continues sessions of a connection that was lost, or the numbers of one whose `close` was carried out: its answer
    /// may have been lost.
    async fn resume(
        &mut self,
        seq: u64,
        name: &str,
        last_seq: u64,
        also: &[String],
    ) -> Result<Answer, Fault> {
        let max_wait = self.state.limits.step;
        let owner = &self.grant.name;
        let check = |answered_seq: u64| {
            if last_seq > answered_seq {
                let expected = format!("{answered_seq} is the session's last answer");
                return Err(Fault::SeqOutOfOrder { field: "last_seq", seq: last_seq, expected });
            }
            Ok(())
        };
        if also.is_empty()
            && let Some(closed) = self.state.sessions.closed(name, owner)
        {
            check(closed.last.seq)?;
            let text = convert::resumed(seq, name, closed.last.seq, Err(&closed), &[])?;
            self.answered_seq = Some(closed.last.seq);
            self.last = Some(closed.last);
            return Ok(Answer::Text(text.into()));
        }
        let first = self.state.sessions.resume("session", name, owner, max_wait).await?;
        check(first.answered_seq)?;
        let mut slots = vec![first];
        for (index, name) in also.iter().enumerate() {
            let field = format!("also[{index}]");
            let slot = self.state.sessions.resume(&field, name, owner, max_wait).await?;
            // The sessions of a connection share its numbers.
            if slot.answered_seq != slots[0].answered_seq {
                let seq = slot.answered_seq;
                return Err(Fault::OtherConnection { field, name: name.clone(), seq });
            }
            slots.push(slot);
        }
        let opened: Vec<&Session> =
            slots.iter().map(|slot| slot.session.as_ref().ok_or(NO_SESSION)).collect::<Result<_, _>>()?;
        let one = |(name, session)| AlsoResumed { name, session };
        let resumed_also: Vec<_> =
            also.iter().map(String::as_str).zip(opened[1..].iter().copied()).map(one).collect();
        let first = &slots[0];
        let carried_out = first.last.as_ref().map_or(first.answered_seq, |last| last.seq);
        let text = convert::resumed(seq, name, carried_out, Ok(opened[0]), &resumed_also)?;
        for slot in &slots {
            tracing::info!(session = slot.name(), "resumed");
            slot.update_view();
        }
        self.last = first.last.clone();
        self.answered_seq = Some(first.answered_seq);
        self.slots = slots;
        Ok(Answer::Text(text.into()))
    }

    /// Index of the session that a request names, or of the only one.
    fn slot(&self, named: Option<&str>) -> Result<usize, Fault> {
        match (named, &self.slots[..]) {
            (_, []) => Err(NO_SESSION),
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
        self.slots[slot].update_view();
        self.slots[slot].show(&frame);
        Ok(Answer::Observation(frame))
    }

    async fn send(&self, socket: &mut Socket, answer: &Answer) -> Result<(), Disconnect> {
        match answer {
            Answer::Text(text) => socket.send_text(text).await,
            Answer::Observation(frame) => {
                let bytes = frame.buffer.bytes();
                self.state.metrics.observation_bytes.inc_by(bytes.len() as u64);
                socket.send_binary(&[bytes]).await
            }
            Answer::Many(many) => {
                let frames = many.frames.iter().map(|frame| frame.buffer.bytes());
                let parts: Vec<&[u8]> = std::iter::once(&*many.header).chain(frames).collect();
                let bytes = parts.iter().map(|part| part.len() as u64).sum();
                self.state.metrics.observation_bytes.inc_by(bytes);
                socket.send_binary(&parts).await
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
        for mut slot in self.slots.drain(..) {
            tracing::info!(?reason, "the connection of a session ended");
            slot.outcome = outcome;
            // Parks it.
            drop(slot);
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

/// Carries out a step of a session, and counts it.
async fn step(
    metrics: &Metrics,
    session: &mut Session,
    movement: wildcity_sim::Command,
    options: StepOptions,
) -> Result<Observation, Fault> {
    let begun = Instant::now();
    let done = session.episode().step();
    let frame = session.follow(movement, options).await?;
    metrics.steps.inc_by(session.episode().step() - done);
    metrics.step_seconds.observe(begun.elapsed().as_secs_f64());
    metrics.queue_seconds.observe(frame.timings.queue.as_secs_f64());
    Ok(frame)
}
