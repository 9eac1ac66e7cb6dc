//! Who exists, who is connected, who waits to be resumed.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{Mutex as AsyncMutex, Notify, OwnedMutexGuard};
use tokio::time::{Instant, timeout};

use wildcity_scene::geometry::Pose;
use wildcity_session::{Observation, Outcome, Session};
use wildcity_twin::residency::Viewpoint;

use super::fault::Fault;

/// All sessions of a server, by name.
pub(super) struct Sessions {
    limit: usize,
    grace: Duration,
    entries: Mutex<BTreeMap<String, Entry>>,
}

struct Entry {
    seat: Arc<AsyncMutex<Seat>>,
    /// Name of the token that opened it.
    owner: String,
    /// As it was after the last request; none before the first.
    about: Option<About>,
    /// Asks the connection that holds the seat to give it up.
    leave: Arc<Notify>,
    /// Since when nobody holds the seat, and what that means for the session.
    parked: Option<(Instant, Outcome)>,
}

/// What others are told of a session.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct About {
    pub(super) twin: String,
    pub(super) version: u64,
    pub(super) step: u64,
    pub(super) world_from_rig: Pose,
    /// What its next frame needs, if it stays where it is.
    pub(super) eyes: Vec<Viewpoint>,
}

/// A session with what a lost connection must not lose.
#[derive(Default)]
pub(super) struct Seat {
    /// `None` while it is opened, and once it is closed.
    pub(super) session: Option<Session>,
    /// The last request that the session carried out, and its answer, for when it is repeated.
    pub(super) last: Option<(u64, Answer)>,
    /// The last request that was answered, refusals included.
    pub(super) answered: u64,
}

/// What was sent, and can be sent again.
#[derive(Clone)]
pub(super) enum Answer {
    /// A control message.
    Text(Arc<str>),
    /// An observation.
    Observation(Arc<Observation>),
}

/// A connection's hold on a seat. Dropping it parks the session, or forgets a closed one.
pub(super) struct Place {
    sessions: Arc<Sessions>,
    name: String,
    /// What the session is if nobody resumes it.
    pub(super) outcome: Outcome,
    /// Somebody else wants to resume the session.
    pub(super) leave: Arc<Notify>,
    seat: OwnedMutexGuard<Seat>,
}

impl Sessions {
    pub(super) fn new(limit: usize, grace: Duration) -> Arc<Self> {
        Arc::new(Self { limit, grace, entries: Mutex::default() })
    }

    /// Takes an empty seat under a new name, for whoever a token names.
    pub(super) fn reserve(self: &Arc<Self>, name: String, owner: &str) -> Result<Place, Fault> {
        let mut entries = self.lock();
        if entries.contains_key(&name) {
            return Err(Fault::SessionExists { name });
        }
        if entries.len() >= self.limit {
            return Err(Fault::Busy { what: "sessions", limit: self.limit });
        }
        let (seat, leave) = (Arc::new(AsyncMutex::new(Seat::default())), Arc::new(Notify::new()));
        let taken = seat.clone().try_lock_owned();
        let guard = taken.map_err(|_| Fault::Internal("a new seat is taken".to_owned()))?;
        let owner = owner.to_owned();
        let entry = Entry { seat, owner, about: None, leave: leave.clone(), parked: None };
        entries.insert(name.clone(), entry);
        drop(entries);
        Ok(Place { sessions: self.clone(), name, outcome: Outcome::AgentLost, leave, seat: guard })
    }

    /// Takes the seat of a session, from its connection if that still holds it: after a network
    /// failure the client knows long before the server that the old connection is dead.
    pub(super) async fn resume(
        self: &Arc<Self>,
        name: &str,
        owner: &str,
        patience: Duration,
    ) -> Result<Place, Fault> {
        let unknown = || Fault::UnknownSession { name: name.to_owned() };
        let give_up = Instant::now() + patience;
        loop {
            let seat = {
                let entries = self.lock();
                // To others than its owner there is no such session.
                let entry = entries.get(name).filter(|entry| entry.owner == owner);
                let entry = entry.ok_or_else(unknown)?;
                if entry.parked.is_none() {
                    entry.leave.notify_one();
                }
                entry.seat.clone()
            };
            // Again and again: another client may have taken the seat in between.
            if let Ok(guard) = timeout(Duration::from_millis(100), seat.lock_owned()).await {
                if guard.session.is_none() {
                    return Err(unknown());
                }
                let leave = Arc::new(Notify::new());
                let mut entries = self.lock();
                let entry = entries.get_mut(name).ok_or_else(unknown)?;
                (entry.leave, entry.parked) = (leave.clone(), None);
                drop(entries);
                let (sessions, name) = (self.clone(), name.to_owned());
                return Ok(Place {
                    sessions,
                    name,
                    outcome: Outcome::AgentLost,
                    leave,
                    seat: guard,
                });
            }
            if Instant::now() >= give_up {
                return Err(Fault::SessionState("the session's last step is still running"));
            }
        }
    }

    /// How many there are, connected and parked.
    pub(super) fn count(&self) -> usize {
        self.lock().len()
    }

    /// All that see something, in order of name, and whether a client is connected to each.
    pub(super) fn list(&self) -> Vec<(String, About, bool)> {
        let told = |(name, entry): (&String, &Entry)| {
            Some((name.clone(), entry.about.clone()?, entry.parked.is_none()))
        };
        self.lock().iter().filter_map(told).collect()
    }

    /// Ends sessions whose grace is over, until dropped.
    pub(super) async fn reap(&self) {
        let period = (self.grace / 4).clamp(Duration::from_millis(10), Duration::from_secs(5));
        loop {
            tokio::time::sleep(period).await;
            let now = Instant::now();
            let overdue = |since: Instant| now.saturating_duration_since(since) >= self.grace;
            self.end_parked(|since, outcome| overdue(since).then_some(outcome)).await;
        }
    }

    /// Ends all sessions that no connection holds, because the server stops.
    pub(super) async fn end_all_parked(&self) {
        self.end_parked(|_, _| Some(Outcome::ServerError)).await;
    }

    async fn end_parked(&self, end: impl Fn(Instant, Outcome) -> Option<Outcome>) {
        let chosen: Vec<_> = self
            .lock()
            .iter()
            .filter_map(|(name, entry)| {
                let (since, outcome) = entry.parked?;
                Some((name.clone(), entry.seat.clone(), since, end(since, outcome)?))
            })
            .collect();
        for (name, seat, since, outcome) in chosen {
            // Whoever resumes it right now has it.
            let Ok(mut seat) = seat.try_lock_owned() else { continue };
            {
                let mut entries = self.lock();
                let parked = entries.get(&name).and_then(|entry| entry.parked);
                if parked.is_none_or(|(parked, _)| parked != since) {
                    continue;
                }
                entries.remove(&name);
            }
            if let Some(session) = seat.session.take() {
                let summary = session.close(outcome).await;
                tracing::info!(session = name, ?summary, "session ended without its agent");
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Entry>> {
        // A panic elsewhere leaves nothing half-done behind this lock.
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Place {
    /// Lets others know how it stands with the session.
    pub(super) fn tell(&self) {
        let Some(session) = &self.seat.session else { return };
        let version = &session.resident().version;
        let about = About {
            twin: version.manifest.twin.clone(),
            version: version.number,
            step: session.episode().step(),
            world_from_rig: session.episode().world_from_rig(),
            eyes: session.viewpoints(),
        };
        if let Some(entry) = self.sessions.lock().get_mut(&self.name) {
            entry.about = Some(about);
        }
    }
}

impl std::ops::Deref for Place {
    type Target = Seat;

    fn deref(&self) -> &Seat {
        &self.seat
    }
}

impl std::ops::DerefMut for Place {
    fn deref_mut(&mut self) -> &mut Seat {
        &mut self.seat
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut entries = self.sessions.lock();
        if self.seat.session.is_none() {
            entries.remove(&self.name);
        } else if let Some(entry) = entries.get_mut(&self.name) {
            entry.parked = Some((Instant::now(), self.outcome));
        }
    }
}
