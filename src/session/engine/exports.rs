//! MCAP files of episodes that ended, written next to their records by a separate thread, so that
//! no request waits for an export.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, SystemTime};

use parking_lot::Mutex;
use tokio::sync::watch;
use tokio::time::timeout;

use wildcity_episode::{
    EpisodeFile, ExportError, export_file, mcap_path, record_bytes, remove_leftovers,
};

use crate::error::SessionError;
use crate::limits;

/// The exports of an engine, one at a time.
pub(crate) struct Exports {
    records: Sender<PathBuf>,
    shared: Arc<Shared>,
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    /// Number of exports that have ended.
    ended: watch::Sender<u64>,
}

#[derive(Default)]
struct State {
    /// Names of the episodes that wait or are being exported, the oldest first.
    waiting: VecDeque<String>,
    /// The last episodes that were not exported, each with the reason, the oldest first.
    failed: VecDeque<(String, String)>,
}

impl Exports {
    /// Starts the thread. It first removes from the directory of the records the files of exports
    /// that were killed, and ends after the last export when this is dropped.
    ///
    /// # Errors
    /// [`SessionError::Thread`].
    pub(crate) fn start(episodes: PathBuf) -> Result<Self, SessionError> {
        let (records, to_export) = channel();
        let shared = Arc::new(Shared::default());
        let of_thread = shared.clone();
        std::thread::Builder::new()
            .name("export".to_owned())
            .spawn(move || {
                // In the thread, so that a directory of many files does not delay the start.
                if let Err(error) = remove_leftovers(&episodes, SystemTime::now()) {
                    let dir = episodes.display();
                    tracing::warn!("{dir}: leftovers of exports were not removed: {error}");
                }
                of_thread.run(&to_export);
            })
            .map_err(|error| SessionError::Thread { reason: error.to_string() })?;
        Ok(Self { records, shared })
    }

    /// Queues a record for export, unless too many wait already.
    pub(crate) fn add(&self, record: PathBuf) {
        let name = EpisodeFile::episode_name(&record);
        // The lock is held until the record is sent: names and records enter their queues in one
        // order, and `run` can take the first name for each record.
        let mut state = self.shared.state.lock();
        if state.waiting.len() >= limits::WAITING_EXPORTS {
            let reason = format!("{} others waited", limits::WAITING_EXPORTS);
            state.fail(name, Failure::Bad(reason));
            return;
        }
        state.waiting.push_back(name);
        // The thread lives as long as this does.
        let _ = self.records.send(record);
    }

    /// Waits until the export of `episode` has ended, or all exports if it is `None`; at most
    /// `longest`. Returns whether they have ended.
    pub(crate) async fn wait(&self, episode: Option<&str>, longest: Duration) -> bool {
        let is_over = |_: &u64| !self.shared.state.lock().is_waiting(episode);
        // `wait_for` looks at the state first and then after each export. The subscription is older
        // than the first look, so that no end is missed.
        let mut ended = self.shared.ended.subscribe();
        timeout(longest, ended.wait_for(is_over)).await.is_ok_and(|waited| waited.is_ok())
    }

    /// Why an episode was not exported.
    pub(crate) fn failure(&self, episode: &str) -> Option<String> {
        let state = self.shared.state.lock();
        let found = state.failed.iter().rev().find(|(name, _)| name == episode);
        found.map(|(_, reason)| reason.clone())
    }
}

impl Shared {
    fn run(&self, records: &Receiver<PathBuf>) {
        for record in records {
            // A panic must not end the thread: all later records would wait forever.
            let exported = catch_unwind(AssertUnwindSafe(|| export(&record)))
                .unwrap_or_else(|_| Err(Failure::Bad("the export crashed".to_owned())));
            let mut state = self.state.lock();
            let name = state.waiting.pop_front().unwrap_or_default();
            if let Err(reason) = exported {
                state.fail(name, reason);
            }
            // A waiter locks the state within the lock of the channel. To notify it while the state
            // is locked would take the two in the other order, and could deadlock.
            drop(state);
            self.ended.send_modify(|ended| *ended += 1);
        }
    }
}

/// Why an episode was not exported.
enum Failure {
    Bad(String),
    /// The ego was never driven: the record has only frames of `observe`.
    Empty(String),
}

impl State {
    fn is_waiting(&self, episode: Option<&str>) -> bool {
        match episode {
            Some(episode) => self.waiting.iter().any(|name| name == episode),
            None => !self.waiting.is_empty(),
        }
    }

    fn fail(&mut self, episode: String, failure: Failure) {
        let reason = match failure {
            Failure::Bad(reason) => {
                tracing::error!(episode, "no MCAP file: {reason}");
                reason
            }
            Failure::Empty(reason) => {
                tracing::debug!(episode, "no MCAP file: {reason}");
                reason
            }
        };
        // The oldest reason makes room for the newest.
        if self.failed.len() >= limits::FAILED_EXPORTS {
            self.failed.pop_front();
        }
        self.failed.push_back((episode, reason));
    }
}

fn export(record: &Path) -> Result<(), Failure> {
    let bytes = record_bytes(record);
    if bytes > limits::EXPORTED_RECORD_BYTES {
        let most = limits::EXPORTED_RECORD_BYTES;
        return Err(Failure::Bad(format!(
            "the record has {bytes} bytes; at most {most} are exported by themselves"
        )));
    }
    match export_file(record, &mcap_path(record)) {
        Ok(_) => Ok(()),
        Err(error @ ExportError::Empty) => Err(Failure::Empty(error.to_string())),
        Err(error) => Err(Failure::Bad(error.to_string())),
    }
}
