//! Requests that give a connection its sessions: open, branch and resume.

use tokio::time::timeout;

use wildcity_episode::RecordHead;
use wildcity_options::Open;
use wildcity_scene::ProfileOverrides;
use wildcity_session::{ScenarioError, Session, SessionError};

use super::{Connection, NO_SESSION};
use crate::auth::{Grant, Role};
use crate::blocking::blocking;
use crate::convert::{self, AlsoResumed, BranchPoint, DriveRequest};
use crate::fault::Fault;
use crate::limits;
use crate::sessions::{Answer, SlotGuard};

fn new_session_name() -> String {
    // Version 7 begins with the time, so that names sort by age, and so do the files of episodes.
    format!("s-{}", uuid::Uuid::now_v7().as_simple())
}

/// What a token that is limited to some twins is told about a scenario that it may not use: the
/// same as if there was none, and no names.
fn hidden(error: SessionError, grant: &Grant) -> SessionError {
    let is_hidden = match &error {
        SessionError::Scenario(ScenarioError::Unknown { .. }) => !grant.allows_all_twins(),
        SessionError::Scenario(ScenarioError::Twin { wanted, .. }) => !grant.allows_twin(wanted),
        _ => false,
    };
    if is_hidden { SessionError::Scenario(ScenarioError::NotForTwin) } else { error }
}

impl Connection {
    /// Checks that another session of this name can be opened: the second session of a connection
    /// needs a name, so that a client that has forgotten to close the first one gets an error.
    pub(super) fn check_room(&self, name: Option<&String>) -> Result<(), Fault> {
        let limit = limits::CONNECTION_SESSIONS;
        if !self.slots.is_empty() && name.is_none() {
            return Err(Fault::SessionState(
                "a session is open on this connection; close it first, or name the next one",
            ));
        }
        if self.slots.len() >= limit {
            let must = format!(
                "the one after {limit} on this connection, which has no more: open another connection"
            );
            return Err(Fault::OutOfRange { field: "session".to_owned(), must });
        }
        Ok(())
    }

    pub(super) async fn open(
        &mut self,
        seq: u64,
        name: Option<String>,
        mut opening: Open,
        drive: Option<DriveRequest>,
    ) -> Result<Answer, Fault> {
        let profile = ProfileOverrides::new(std::mem::take(&mut opening.profile));
        opening.profile = profile.or(&self.state.profile).into_fields();
        // Before the reservation, so that a refused request takes no slot.
        self.grant.require_twin(&opening.twin)?;
        let name = name.unwrap_or_else(new_session_name);
        // The name is taken before the session is opened, which takes seconds: two requests must
        // not open one name. If opening fails, dropping the slot frees the name.
        let slot = self.state.sessions.reserve(name.clone(), &self.grant)?;
        let opened = Session::open(self.state.engine.clone(), name, opening);
        let grant = self.grant.clone();
        let opened = async move { opened.await.map_err(|error| hidden(error, &grant)) };
        self.fill(seq, slot, drive, opened).await
    }

    /// Opens a session in a state of another episode.
    pub(super) async fn branch(
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
                let slot = self.state.sessions.reserve(name.clone(), &self.grant)?;
                self.fill(seq, slot, None, Session::branch(engine, name, &from)).await
            }
            BranchPoint::Recorded { episode, step } => {
                // Only the record says whose it is, and of which twin: its first fields, before
                // anything else of it is read.
                self.check_record(&episode).await?;
                let from = Session::recorded(&engine, &episode, step).await?;
                let slot = self.state.sessions.reserve(name.clone(), &self.grant)?;
                self.fill(seq, slot, None, Session::continued(engine, name, from)).await
            }
        }
    }

    /// Refuses the record of another token, or of a twin that the token may not use, as if there
    /// was none.
    async fn check_record(&self, episode: &str) -> Result<(), Fault> {
        let path = self.state.episodes.join(format!("{episode}.jsonl"));
        let head = blocking(move || {
            RecordHead::read(&path).map_err(|error| Fault::Internal(error.to_string()))
        })
        .await;
        let grant = &self.grant;
        let is_allowed = head.is_ok_and(|head| {
            let is_own = head.owner.is_empty() || head.owner == grant.name;
            grant.allows_twin(&head.twin) && (is_own || grant.has(Role::Admin))
        });
        if is_allowed {
            return Ok(());
        }
        Err(SessionError::UnknownEpisode { name: episode.to_owned() }.into())
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
        let mut session = opened.map_err(|_| SessionError::DeadlineExceeded)??;
        session.set_owner(&self.grant.name);
        // The answer is made before the slot gets the session: if the drive that is asked for does
        // not exist, nothing is open.
        let text = convert::opened(seq, &session, drive.as_ref())?;
        tracing::info!(session = session.name(), "opened");
        slot.share_snapshots(&session);
        slot.session = Some(session);
        slot.update_view();
        self.slots.push(slot);
        Ok(Answer::Text(text.into()))
    }

    /// Resumes the sessions of a lost connection. Also resumes the numbers of a connection whose
    /// `close` was carried out, because its answer may have been lost.
    pub(super) async fn resume(
        &mut self,
        seq: u64,
        name: &str,
        last_seq: u64,
        also: &[String],
    ) -> Result<Answer, Fault> {
        let max_wait = self.state.limits.step;
        let owner = &self.grant.name;
        let check = |answered_seq: u64| {
            // The client claims an answer that was never given: it is not the client of this
            // session.
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
        // A slot that is dropped by an error parks its session again, so a wrong request changes
        // nothing.
        check(first.answered_seq)?;
        // All or none: `self.slots` is set at the end only.
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
        let opened: Vec<&Session> = slots
            .iter()
            .map(|slot| slot.session.as_ref().ok_or(NO_SESSION))
            .collect::<Result<_, _>>()?;
        let one = |(name, session)| AlsoResumed { name, session };
        let resumed_also: Vec<_> =
            also.iter().map(String::as_str).zip(opened[1..].iter().copied()).map(one).collect();
        let first = &slots[0];
        // From this number the client sees whether its pending request was carried out.
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
}
