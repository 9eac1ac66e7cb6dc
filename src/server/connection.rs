//! One agent, in lock step: read a request, answer it.
//!
//! Requests are numbered. A request is carried out if its number follows the last one answered, or
//! repeats one that was refused; one that was carried out is never carried out again, but its
//! answer is sent again.

use std::future::pending;
use std::sync::Arc;

use tokio::time::{Instant, sleep_until, timeout};

use crate::limits;
use wildcity_session::{Observation, Outcome, Session, SessionError};

use super::Server;
use super::auth::Grant;
use super::convert::{self, Command, Parsed};
use super::fault::Fault;
use super::sessions::{Answer, Place};
use super::socket::{Incoming, Lost, Socket};

/// Serves a client until it leaves or is turned away. An open session is parked then.
pub(super) async fn serve(server: Arc<Server>, socket: Socket, grant: Arc<Grant>) {
    let hello_by = Instant::now() + server.limits.hello;
    let mut connection = Connection {
        server,
        socket,
        grant,
        hello_by,
        greeted: false,
        answered: None,
        last: None,
        place: None,
    };
    let lost = connection.run().await;
    connection.end(lost).await;
}

struct Connection {
    server: Arc<Server>,
    socket: Socket,
    grant: Arc<Grant>,
    /// When `hello` must have come, however much else comes before it.
    hello_by: Instant,
    greeted: bool,
    /// Number of the last request answered, refusals included.
    answered: Option<u64>,
    /// The last request carried out, and its answer.
    last: Option<(u64, Answer)>,
    place: Option<Place>,
}

const NO_SESSION: Fault = Fault::SessionState("no session is open; send open or resume");

impl Connection {
    async fn run(&mut self) -> Lost {
        loop {
            let handled = match self.next_request().await {
                Ok(text) => self.handle(&text).await,
                Err(Lost::Fault(fault)) if !fault.is_fatal() => self.refuse(None, &fault).await,
                Err(lost) => Err(lost),
            };
            if let Err(lost) = handled {
                return lost;
            }
        }
    }

    async fn next_request(&mut self) -> Result<String, Lost> {
        let idle = self.server.limits.idle;
        let (mut deadline, awaited) = if self.greeted {
            (Instant::now() + idle, "request")
        } else {
            (self.hello_by, "hello")
        };
        loop {
            let leave = async {
                match &self.place {
                    Some(place) => place.leave.notified().await,
                    None => pending().await,
                }
            };
            let fault = tokio::select! {
                incoming = self.socket.receive() => match incoming? {
                    Incoming::Text(text) => return Ok(text),
                    Incoming::SignOfLife => {
                        if self.greeted {
                            deadline = Instant::now() + idle;
                        }
                        continue;
                    }
                },
                () = leave => Fault::Replaced,
                () = self.server.stopped() => Fault::ShuttingDown,
                () = sleep_until(deadline) => Fault::TimedOut(awaited),
            };
            return Err(Lost::Fault(fault));
        }
    }

    async fn handle(&mut self, text: &str) -> Result<(), Lost> {
        let parsed = if text.len() <= limits::INLINE_REQUEST_BYTES {
            convert::parse(text)
        } else {
            let text = text.to_owned();
            let parsed = tokio::task::spawn_blocking(move || convert::parse(&text)).await;
            parsed.unwrap_or_else(|error| Parsed::Unnumbered(Fault::Internal(error.to_string())))
        };
        let (seq, command) = match parsed {
            Parsed::Numbered { seq, command } => (seq, command),
            Parsed::Unnumbered(fault) => return self.refuse(None, &fault).await,
        };
        if let Some((last, answer)) = &self.last
            && *last == seq
        {
            let answer = answer.clone();
            return self.send(&answer).await;
        }
        if let Err(fault) = self.check_order(seq) {
            return self.refuse(Some(seq), &fault).await;
        }
        self.answered = Some(seq);
        if let Some(place) = &mut self.place {
            place.answered = seq;
        }
        let resumes = matches!(command, Ok(Command::Resume { .. }));
        let carried_out = match command {
            Ok(command) => self.carry_out(seq, command).await,
            Err(fault) => Err(fault),
        };
        let answer = match carried_out {
            Ok(answer) => answer,
            Err(fault) => return self.refuse(Some(seq), &fault).await,
        };
        if let Some(place) = &self.place {
            place.tell();
        }
        if resumes {
            // From here on the numbers are the session's.
            self.last = self.place.as_ref().and_then(|place| place.last.clone());
            self.answered = self.place.as_ref().map(|place| place.answered);
        } else {
            self.last = Some((seq, answer.clone()));
            if let Some(place) = &mut self.place {
                (place.last, place.answered) = (self.last.clone(), seq);
            }
        }
        self.send(&answer).await
    }

    fn check_order(&self, seq: u64) -> Result<(), Fault> {
        let expected = match self.answered {
            None if seq == 0 => return Ok(()),
            None => "the first request of a connection is 0".to_owned(),
            Some(last) if seq == last || Some(seq) == last.checked_add(1) => return Ok(()),
            Some(last) => format!("{last} was the last: repeat it, or go on with the next"),
        };
        Err(Fault::SeqOutOfOrder { seq, expected })
    }

    async fn carry_out(&mut self, seq: u64, command: Command) -> Result<Answer, Fault> {
        match command {
            Command::Hello { client } => self.hello(seq, client).await,
            _ if !self.greeted => Err(Fault::WrongOrder("the first request is hello")),
            Command::Open { .. } | Command::Resume { .. } if self.place.is_some() => {
                Err(Fault::SessionState("a session is open on this connection; close it first"))
            }
            Command::Open { name, mut opening } => {
                opening.profile = opening.profile.or(&self.server.profile);
                self.grant.reaches(&opening.twin)?;
                let name =
                    name.unwrap_or_else(|| format!("s-{}", uuid::Uuid::now_v7().as_simple()));
                let mut place = self.server.sessions.reserve(name.clone(), &self.grant.name)?;
                let opened = Session::open(self.server.engine.clone(), name, *opening);
                let session = timeout(self.server.limits.step, opened)
                    .await
                    .map_err(|_| SessionError::DeadlineExceeded)??;
                let text = convert::opened(seq, &session)?;
                tracing::info!(session = session.name(), "opened");
                place.session = Some(session);
                self.place = Some(place);
                Ok(Answer::Text(text.into()))
            }
            Command::Resume { session, last_seq } => {
                let patience = self.server.limits.step;
                let place =
                    self.server.sessions.resume(&session, &self.grant.name, patience).await?;
                if last_seq > place.answered {
                    let expected = format!("{} is the session's last answer", place.answered);
                    return Err(Fault::SeqOutOfOrder { seq: last_seq, expected });
                }
                let carried_out = place.last.as_ref().map_or(place.answered, |(last, _)| *last);
                let session = place.session.as_ref().ok_or(NO_SESSION)?;
                let text = convert::resumed(seq, carried_out, session)?;
                tracing::info!(session = session.name(), "resumed");
                self.place = Some(place);
                Ok(Answer::Text(text.into()))
            }
            Command::Step { movement, terminate } => {
                let begun = Instant::now();
                let frame = self.session()?.step(movement, terminate).await?;
                let metrics = &self.server.metrics;
                metrics.steps.inc();
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
            Command::Reset { seed, start } => {
                let frame = self.session()?.reset(seed, start).await?;
                self.observation(seq, frame)
            }
            Command::SwitchVersion { version } => {
                let patience = self.server.limits.step;
                let switched = timeout(patience, self.session()?.switch_version(version)).await;
                switched.map_err(|_| SessionError::DeadlineExceeded)??;
                self.server.metrics.versions_switched.inc();
                let text = convert::switched(seq, self.session()?)?;
                Ok(Answer::Text(text.into()))
            }
            Command::Close => {
                let session = self.place.as_mut().and_then(|place| place.session.take());
                let session = session.ok_or(NO_SESSION)?;
                self.place = None;
                tracing::info!(session = session.name(), "closed");
                let summary = session.close(Outcome::Completed).await;
                Ok(Answer::Text(convert::closed(seq, &summary)?.into()))
            }
        }
    }

    async fn hello(&mut self, seq: u64, client: String) -> Result<Answer, Fault> {
        if self.greeted {
            return Err(Fault::WrongOrder("hello was said already"));
        }
        let engine = &self.server.engine;
        let mut twins = engine.twins().await?;
        twins.retain(|twin| self.grant.sees(&twin.name));
        let text = convert::welcome(seq, &self.server.limits, engine.backend(), &twins)?;
        tracing::debug!(client, "hello");
        self.greeted = true;
        Ok(Answer::Text(text.into()))
    }

    fn session(&mut self) -> Result<&mut Session, Fault> {
        self.place.as_mut().and_then(|place| place.session.as_mut()).ok_or(NO_SESSION)
    }

    fn observation(&mut self, seq: u64, frame: Observation) -> Result<Answer, Fault> {
        let frame = convert::observation(seq, self.session()?, frame)?;
        Ok(Answer::Observation(Arc::new(frame)))
    }

    async fn send(&mut self, answer: &Answer) -> Result<(), Lost> {
        match answer {
            Answer::Text(text) => self.socket.send_text(text).await,
            Answer::Observation(frame) => {
                let bytes = frame.buffer.bytes();
                self.server.metrics.observation_bytes.inc_by(bytes.len() as u64);
                self.socket.send_binary(bytes).await
            }
        }
    }

    async fn refuse(&mut self, seq: Option<u64>, fault: &Fault) -> Result<(), Lost> {
        tracing::debug!(seq, "refused: {fault}");
        self.server.metrics.refused(&convert::code(fault));
        self.socket.send_text(&convert::refused(seq, fault)).await
    }

    async fn end(mut self, lost: Lost) {
        let (outcome, may_talk) = match &lost {
            Lost::Gone => (Outcome::AgentLost, true),
            Lost::Stuck => (Outcome::AgentTimeout, false),
            Lost::Fault(Fault::TimedOut(_)) => (Outcome::AgentTimeout, true),
            Lost::Fault(Fault::Replaced) => (Outcome::AgentLost, true),
            Lost::Fault(Fault::ShuttingDown) => (Outcome::ServerError, true),
            Lost::Fault(_) => (Outcome::AgentError, true),
        };
        // The session first: whoever wants to resume it need not wait for a goodbye.
        if let Some(mut place) = self.place.take() {
            tracing::info!(?lost, "the connection of a session ended");
            place.outcome = outcome;
        }
        if let Lost::Fault(fault) = &lost
            && self.refuse(None, fault).await.is_err()
        {
            return;
        }
        if may_talk {
            self.socket.close().await;
        }
    }
}
