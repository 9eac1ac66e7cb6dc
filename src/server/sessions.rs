//! The sessions of a server: those with a connection, and those that wait to be resumed.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::{Mutex as AsyncMutex, Notify, OwnedMutexGuard};
use tokio::time::{Instant, timeout};

use wildcity_scene::geometry::Pose;
use wildcity_session::{EpisodeSummary, Observation, Outcome, Session, Snapshots};
use wildcity_twin::residency::Viewpoint;

use crate::auth::{Grant, Role};
use crate::fault::Fault;
use crate::limits;
use crate::watchers::{Newest, Watch};

/// How long one attempt to take over a session waits before it notifies the old connection again.
const TAKEOVER_ATTEMPT: Duration = Duration::from_millis(100);

/// All sessions of a server, by name.
pub(crate) struct SessionRegistry {
    limit: usize,
    resume_grace: Duration,
    /// Set once no session is opened any more.
    is_ending: AtomicBool,
    entries: Mutex<BTreeMap<String, Entry>>,
    /// Sessions that were closed a short while ago, by name: the answer to `close` may be asked for
    /// again.
    closed: Mutex<BTreeMap<String, ClosedSession>>,
}

/// A session that its client closed.
#[derive(Clone)]
pub(crate) struct ClosedSession {
    owner: String,
    since: Instant,
    /// The request `close`, and its answer.
    pub(crate) last: AnsweredRequest,
    /// Steps and simulated time of the last episode.
    pub(crate) steps: u64,
    pub(crate) time_us: i64,
}

struct Entry {
    slot: Arc<AsyncMutex<SessionSlot>>,
    /// Name of the token that opened the session.
    owner: String,
    /// The session's snapshots, from which other sessions can be opened.
    snapshots: Snapshots,
    /// The session after its last request; none before the first.
    view: Option<SessionView>,
    /// Where watchers see the session's observations.
    newest: Newest,
    /// Notifies the connection that holds the slot to release it.
    release: Arc<Notify>,
    /// Set while no connection holds the slot.
    parked: Option<Parked>,
}

/// A session without a connection.
#[derive(Clone, Copy)]
struct Parked {
    since: Instant,
    /// The outcome of the episode if no client resumes the session.
    outcome: Outcome,
}

/// The part of a session's state that is visible to the rest of the server.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct SessionView {
    pub(crate) twin: String,
    pub(crate) version: u64,
    pub(crate) step: u64,
    pub(crate) world_from_rig: Pose,
    /// Viewpoints of the next frame, if the ego stays where it is.
    pub(crate) viewpoints: Vec<Viewpoint>,
}

/// An entry of the list of sessions.
pub(crate) struct ListedSession {
    pub(crate) name: String,
    pub(crate) view: SessionView,
    /// Whether a connection holds the session.
    pub(crate) connected: bool,
}

/// A session, and the data that must survive the loss of its connection.
#[derive(Default)]
pub(crate) struct SessionSlot {
    /// `None` while the session is opened, and once it is closed.
    pub(crate) session: Option<Session>,
    /// The last request that the session carried out, and its answer, which is sent again if the
    /// request is repeated.
    pub(crate) last: Option<AnsweredRequest>,
    /// Number of the last request that was answered, refusals included.
    pub(crate) answered_seq: u64,
}

/// A request that was carried out.
#[derive(Clone)]
pub(crate) struct AnsweredRequest {
    pub(crate) seq: u64,
    pub(crate) answer: Answer,
}

/// An answer that was sent, and can be sent again.
#[derive(Clone)]
pub(crate) enum Answer {
    Text(Arc<str>),
    Observation(Arc<Observation>),
    /// Observations of several sessions.
    Many(Arc<ManyAnswer>),
}

impl Answer {
    /// The parts of a message, in order.
    pub(crate) fn message_parts(&self) -> Vec<&[u8]> {
        match self {
            Self::Text(text) => vec![text.as_bytes()],
            Self::Observation(frame) => vec![frame.buffer.bytes()],
            Self::Many(many) => {
                let frames = many.frames.iter().map(|frame| frame.buffer.bytes());
                std::iter::once(&*many.header).chain(frames).collect()
            }
        }
    }

    /// Length of the message.
    pub(crate) fn message_bytes(&self) -> u64 {
        self.message_parts().iter().map(|part| part.len() as u64).sum()
    }
}

/// The answer to steps of several sessions.
#[derive(Debug)]
pub(crate) struct ManyAnswer {
    /// Bytes that are sent before the observations.
    pub(crate) header: Vec<u8>,
    /// The observations, in order.
    pub(crate) frames: Vec<Arc<Observation>>,
}

/// A connection's exclusive access to a slot. Dropping it parks the session, or removes a closed
/// one.
pub(crate) struct SlotGuard {
    registry: Arc<SessionRegistry>,
    name: String,
    /// The outcome of the episode if the guard is dropped and no client resumes the session.
    pub(crate) outcome: Outcome,
    /// Notified when another connection is resuming the session.
    pub(crate) release: Arc<Notify>,
    newest: Newest,
    slot: OwnedMutexGuard<SessionSlot>,
}

impl SessionRegistry {
    pub(crate) fn new(limit: usize, resume_grace: Duration) -> Arc<Self> {
        Arc::new(Self {
            limit,
            resume_grace,
            is_ending: AtomicBool::default(),
            entries: Mutex::default(),
            closed: Mutex::default(),
        })
    }

    /// Refuses new sessions from now on.
    pub(crate) fn open_no_more(&self) {
        self.is_ending.store(true, Ordering::SeqCst);
    }

    /// Whether new sessions are refused because the server will stop.
    pub(crate) fn is_ending(&self) -> bool {
        self.is_ending.load(Ordering::SeqCst)
    }

    /// Adds an empty slot under a new name, for the client's token.
    ///
    /// # Errors
    /// The server will stop, the name is in use, or there are too many sessions, of all tokens or
    /// of this one.
    pub(crate) fn reserve(
        self: &Arc<Self>,
        name: String,
        grant: &Grant,
    ) -> Result<SlotGuard, Fault> {
        if self.is_ending() {
            return Err(Fault::Ending);
        }
        let mut entries = self.entries.lock();
        // Names are unique over all tokens, because they also name the files of episodes.
        if entries.contains_key(&name) {
            return Err(Fault::SessionExists { name });
        }
        if entries.len() >= self.limit {
            return Err(Fault::Busy { what: "sessions", limit: self.limit });
        }
        // There are at most some hundred sessions.
        let own = entries.values().filter(|entry| entry.owner == grant.name).count();
        let share = || limits::share_of_token(&grant.name, self.limit);
        let limit = grant.limits.sessions.unwrap_or_else(share);
        if own >= limit {
            return Err(Fault::Busy { what: "sessions of this token", limit });
        }
        let slot = Arc::new(AsyncMutex::new(SessionSlot::default()));
        let release = Arc::new(Notify::new());
        // The lock is free, because no other reference to it exists yet.
        let guard = slot
            .clone()
            .try_lock_owned()
            .map_err(|_| Fault::Internal("a new slot is locked".to_owned()))?;
        let newest = Newest::new();
        let entry = Entry {
            slot,
            owner: grant.name.clone(),
            snapshots: Snapshots::default(),
            view: None,
            newest: newest.clone(),
            release: release.clone(),
            parked: None,
        };
        entries.insert(name.clone(), entry);
        // `remember_closed` takes the two locks in the other order, so that they must not be held
        // together here.
        drop(entries);
        self.closed.lock().remove(&name);
        Ok(self.guard(name, release, newest, guard))
    }

    /// Watches a session of the client's own token, or any session as an administrator.
    ///
    /// # Errors
    /// There is no such session that the client may see.
    pub(crate) fn watch(&self, name: &str, grant: &Grant) -> Result<Watch, Fault> {
        let entries = self.entries.lock();
        let may_see = |entry: &&Entry| {
            let is_own = entry.owner == grant.name;
            let twin = entry.view.as_ref().map(|view| view.twin.as_str());
            (is_own || grant.has(Role::Admin)) && twin.is_none_or(|twin| grant.allows_twin(twin))
        };
        // Other clients must not learn that the session exists.
        let entry = entries.get(name).filter(may_see);
        let unknown = || Fault::NothingToWatch { name: name.to_owned() };
        Ok(entry.ok_or_else(unknown)?.newest.watch())
    }

    /// The snapshots of a session, whichever connection holds it.
    ///
    /// # Errors
    /// There is no such session of this owner.
    pub(crate) fn snapshots(&self, name: &str, owner: &str) -> Result<Snapshots, Fault> {
        let entries = self.entries.lock();
        // Other clients must not learn that the session exists.
        let entry = entries.get(name).filter(|entry| entry.owner == owner);
        let unknown = || Fault::NoSuchSession { field: "from.session", name: name.to_owned() };
        Ok(entry.ok_or_else(unknown)?.snapshots.clone())
    }

    /// Keeps the answer to `close` for a client that did not get it, as long as a session waits for
    /// `resume`.
    pub(crate) fn remember_closed(
        &self,
        name: String,
        owner: &str,
        last: AnsweredRequest,
        summary: &EpisodeSummary,
    ) {
        // Held while the entries are looked at: `reserve` removes what is inserted below, as it
        // comes after.
        let mut closed = self.closed.lock();
        // While the session was closing, its name was free: it may be another session's by now.
        if self.entries.lock().contains_key(&name) {
            return;
        }
        // Clients can open and close as often as they like, so the map has a bound.
        if closed.len() >= self.limit {
            // Of the token that has the most, so that a token with few loses none to one with many.
            let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
            for session in closed.values() {
                *counts.entry(&session.owner).or_default() += 1;
            }
            let most = counts.values().max().copied();
            let of_most =
                closed.iter().filter(|(_, session)| counts.get(&*session.owner).copied() == most);
            let oldest = of_most.min_by_key(|(_, session)| session.since);
            if let Some(name) = oldest.map(|(name, _)| name.clone()) {
                closed.remove(&name);
            }
        }
        let EpisodeSummary { steps, time_us, .. } = *summary;
        let owner = owner.to_owned();
        closed.insert(name, ClosedSession { owner, since: Instant::now(), last, steps, time_us });
    }

    /// The closed session of that name and owner.
    pub(crate) fn closed(&self, name: &str, owner: &str) -> Option<ClosedSession> {
        self.closed.lock().get(name).filter(|session| session.owner == owner).cloned()
    }

    /// Takes over the slot of a session, which `field` of a request names, even if its old
    /// connection still holds it: after a network failure, the client detects long before the
    /// server that the old connection is dead.
    ///
    /// # Errors
    /// There is no such session of this owner, or its last step runs for longer than `max_wait`.
    pub(crate) async fn resume(
        self: &Arc<Self>,
        field: &str,
        name: &str,
        owner: &str,
        max_wait: Duration,
    ) -> Result<SlotGuard, Fault> {
        let unknown = || Fault::UnknownSession { field: field.to_owned(), name: name.to_owned() };
        // The connection that has the session may be within a step, which it finishes first.
        let give_up = Instant::now() + max_wait;
        loop {
            let slot = {
                let entries = self.entries.lock();
                // Other clients must not learn that the session exists.
                let entry =
                    entries.get(name).filter(|entry| entry.owner == owner).ok_or_else(unknown)?;
                // Without a holder the permit of `notify_one` would be stored, and would hit the
                // next one.
                if entry.parked.is_none() {
                    entry.release.notify_one();
                }
                entry.slot.clone()
            };
            // Each attempt asks again: another client may have taken the slot in between.
            if let Ok(guard) = timeout(TAKEOVER_ATTEMPT, slot.lock_owned()).await {
                if guard.session.is_none() {
                    return Err(unknown());
                }
                // A signal of its own: one that was meant for the old connection must not end this
                // one.
                let release = Arc::new(Notify::new());
                let mut entries = self.entries.lock();
                let entry = entries.get_mut(name).ok_or_else(unknown)?;
                entry.release = release.clone();
                entry.parked = None;
                let newest = entry.newest.clone();
                drop(entries);
                return Ok(self.guard(name.to_owned(), release, newest, guard));
            }
            if Instant::now() >= give_up {
                return Err(Fault::SessionState("the session's last step is still running"));
            }
        }
    }

    fn guard(
        self: &Arc<Self>,
        name: String,
        release: Arc<Notify>,
        newest: Newest,
        slot: OwnedMutexGuard<SessionSlot>,
    ) -> SlotGuard {
        let registry = self.clone();
        // The outcome if the guard is dropped without more being known.
        SlotGuard { registry, name, outcome: Outcome::AgentLost, release, newest, slot }
    }

    /// Number of sessions, connected and parked.
    pub(crate) fn count(&self) -> usize {
        self.entries.lock().len()
    }

    /// All sessions that were opened, in order of name.
    pub(crate) fn list(&self) -> Vec<ListedSession> {
        let listed = |(name, entry): (&String, &Entry)| {
            let view = entry.view.clone()?;
            Some(ListedSession { name: name.clone(), view, connected: entry.parked.is_none() })
        };
        self.entries.lock().iter().filter_map(listed).collect()
    }

    /// For each session that drives on a twin, the viewpoints of its next frame.
    pub(crate) fn viewpoints_on(&self, twin: &str) -> Vec<Vec<Viewpoint>> {
        let entries = self.entries.lock();
        let views = entries.values().filter_map(|entry| entry.view.as_ref());
        views.filter(|view| view.twin == twin).map(|view| view.viewpoints.clone()).collect()
    }

    /// Ends sessions that were not resumed in time, until dropped.
    pub(crate) async fn end_expired(&self) {
        let shortest = Duration::from_millis(10);
        let longest = Duration::from_secs(5);
        // A session ends at most a quarter of the grace period late. Tests have short ones.
        let period = (self.resume_grace / 4).clamp(shortest, longest);
        loop {
            tokio::time::sleep(period).await;
            let now = Instant::now();
            let expired =
                |parked: Parked| now.saturating_duration_since(parked.since) >= self.resume_grace;
            self.end_parked(|parked| expired(parked).then_some(parked.outcome)).await;
            let is_new = |session: &ClosedSession| {
                now.saturating_duration_since(session.since) < self.resume_grace
            };
            self.closed.lock().retain(|_, session| is_new(session));
        }
    }

    /// Ends all sessions that no connection holds, because the server stops.
    pub(crate) async fn end_all_parked(&self) {
        self.end_parked(|_| Some(Outcome::ServerError)).await;
    }

    /// Ends the parked sessions that `end` gives an outcome for.
    async fn end_parked(&self, end: impl Fn(Parked) -> Option<Outcome>) {
        struct Chosen {
            name: String,
            slot: Arc<AsyncMutex<SessionSlot>>,
            since: Instant,
            outcome: Outcome,
        }
        let choose = |(name, entry): (&String, &Entry)| {
            let parked = entry.parked?;
            let outcome = end(parked)?;
            let slot = entry.slot.clone();
            Some(Chosen { name: name.clone(), slot, since: parked.since, outcome })
        };
        // Chosen under the lock and ended without it: closing a session writes to disk, and awaits.
        let chosen: Vec<Chosen> = self.entries.lock().iter().filter_map(choose).collect();
        for Chosen { name, slot, since, outcome } in chosen {
            // A locked slot is being resumed right now.
            let Ok(mut slot) = slot.try_lock_owned() else { continue };
            {
                let mut entries = self.entries.lock();
                let parked = entries.get(&name).and_then(|entry| entry.parked);
                // It was resumed, and perhaps parked again, since it was chosen.
                if parked.is_none_or(|parked| parked.since != since) {
                    continue;
                }
                // Removed before it is closed, while the slot is locked: a client that resumes it
                // now finds nothing.
                entries.remove(&name);
            }
            if let Some(session) = slot.session.take() {
                let summary = session.close(outcome).await;
                tracing::info!(session = name, ?summary, "session ended without its agent");
            }
        }
    }
}

impl SlotGuard {
    /// Name of the session.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Lets other sessions be opened from the snapshots of this slot's new session.
    pub(crate) fn share_snapshots(&self, session: &Session) {
        if let Some(entry) = self.registry.entries.lock().get_mut(&self.name) {
            entry.snapshots = session.snapshots().clone();
        }
    }

    /// Sends an observation to the watchers of the session, if there are any.
    pub(crate) fn show(&self, observation: &Arc<Observation>) {
        self.newest.show(observation);
    }

    /// Updates the part of the session's state that is visible to the rest of the server.
    pub(crate) fn update_view(&self) {
        // Copied, because others must not wait for the slot, which is locked as long as a step
        // runs.
        let Some(session) = &self.slot.session else { return };
        let version = &session.resident().version;
        let view = SessionView {
            twin: version.manifest.twin.clone(),
            version: version.number,
            step: session.episode().step(),
            world_from_rig: session.episode().world_from_rig(),
            viewpoints: session.viewpoints(),
        };
        if let Some(entry) = self.registry.entries.lock().get_mut(&self.name) {
            entry.view = Some(view);
        }
    }
}

impl std::ops::Deref for SlotGuard {
    type Target = SessionSlot;

    fn deref(&self) -> &SessionSlot {
        &self.slot
    }
}

impl std::ops::DerefMut for SlotGuard {
    fn deref_mut(&mut self) -> &mut SessionSlot {
        &mut self.slot
    }
}

impl Drop for SlotGuard {
    fn drop(&mut self) {
        // The slot is unlocked after this function, when its fields are dropped: whichever client
        // waits for it finds the entry parked or gone.
        let mut entries = self.registry.entries.lock();
        if self.slot.session.is_none() {
            entries.remove(&self.name);
        } else if let Some(entry) = entries.get_mut(&self.name) {
            entry.parked = Some(Parked { since: Instant::now(), outcome: self.outcome });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The answer to `close` is not kept under a name that another session has taken in the
    /// meantime: a client that resumes this name must get the open session.
    #[test]
    fn a_closed_session_gives_way_to_an_open_one() {
        let registry = SessionRegistry::new(8, Duration::from_secs(60));
        let grant = Grant::everything();
        let summary = EpisodeSummary {
            outcome: Outcome::Completed,
            steps: 1,
            time_us: 100_000,
            distance_m: 1.0,
            least_trust: None,
        };
        let remember = || {
            let last = AnsweredRequest { seq: 3, answer: Answer::Text("closed".into()) };
            registry.remember_closed("a".to_owned(), &grant.name, last, &summary);
        };
        let is_kept = || registry.closed("a", &grant.name).is_some();
        // Closed, opened again under its name, closed late by the first client, and gone.
        remember();
        assert!(is_kept());
        let open = registry.reserve("a".to_owned(), &grant).unwrap();
        assert!(!is_kept(), "the name is used again");
        remember();
        assert!(!is_kept(), "and was so before the other session had closed");
        drop(open);
        remember();
        assert!(is_kept());
    }

    /// A token that closes many sessions loses its own answers to `close`, and not those of others.
    #[test]
    fn answers_to_close_give_way_to_those_of_the_same_token() {
        let registry = SessionRegistry::new(4, Duration::from_secs(60));
        let summary = EpisodeSummary {
            outcome: Outcome::Completed,
            steps: 1,
            time_us: 100_000,
            distance_m: 1.0,
            least_trust: None,
        };
        let remember = |name: &str, owner: &str| {
            let last = AnsweredRequest { seq: 3, answer: Answer::Text("closed".into()) };
            registry.remember_closed(name.to_owned(), owner, last, &summary);
        };
        remember("anns", "ann");
        for index in 0..9 {
            remember(&format!("bobs-{index}"), "bob");
        }
        assert!(registry.closed("anns", "ann").is_some());
        assert!(registry.closed("bobs-8", "bob").is_some());
        assert!(registry.closed("bobs-0", "bob").is_none(), "the oldest of its token");
    }
}
