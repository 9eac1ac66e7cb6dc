//! State that all connections of a server share.

use std::path::PathBuf;
use std::sync::Arc;

use tokio::sync::{Semaphore, watch};

use wildcity_push::PushQueue;
use wildcity_scene::ProfileOverrides;
use wildcity_session::Engine;

use crate::audit::Audit;
use crate::auth::CurrentTokens;
use crate::config::Limits;
use crate::fault::Fault;
use crate::metrics::Metrics;
use crate::origins::Origins;
use crate::readiness::Readiness;
use crate::sessions::SessionRegistry;
use crate::spool::Spool;
use crate::tickets::Tickets;
use crate::token_counts::TokenCounts;
use crate::unfinished::Unfinished;

/// State that all connections of a server share.
pub(crate) struct ServerState {
    pub(crate) engine: Arc<Engine>,
    pub(crate) sessions: Arc<SessionRegistry>,
    /// One permit per WebSocket connection.
    pub(crate) websocket_permits: Arc<Semaphore>,
    /// Becomes true when the server stops.
    pub(crate) stopping: watch::Receiver<bool>,
    pub(crate) limits: Limits,
    /// Changes of the render profile of every twin.
    pub(crate) profile: ProfileOverrides,
    /// Whether clients on this machine may ask for shared memory.
    pub(crate) shares_memory: bool,
    pub(crate) tokens: Option<CurrentTokens>,
    pub(crate) tickets: Tickets,
    pub(crate) audit: Arc<Audit>,
    pub(crate) open_pushes: TokenCounts,
    pub(crate) open_connections: TokenCounts,
    pub(crate) readiness: Readiness,
    pub(crate) origins: Origins,
    /// Directory where episodes are recorded.
    pub(crate) episodes: PathBuf,
    /// The spool, or the reason for its absence.
    pub(crate) spool: Result<Arc<Spool>, String>,
    pub(crate) pushes: PushQueue,
    pub(crate) metrics: Metrics,
    /// Bytes of messages that were begun on all WebSockets.
    pub(crate) unfinished: Arc<Unfinished>,
    /// Turns of messages that are parsed on threads that may block.
    pub(crate) parse_turns: Arc<Semaphore>,
    /// Turns of requests for parts of drives.
    pub(crate) drive_turns: Arc<Semaphore>,
    /// Held by the work that lists the scenarios of a twin, which may outlive its request.
    pub(crate) scenario_listing: Arc<tokio::sync::Mutex<()>>,
}

impl ServerState {
    /// The spool of uploads.
    ///
    /// # Errors
    /// [`Fault::NoUploads`].
    pub(crate) fn spool(&self) -> Result<&Arc<Spool>, Fault> {
        self.spool.as_ref().map_err(|reason| Fault::NoUploads { reason: reason.clone() })
    }

    /// Returns when the server stops.
    pub(crate) async fn stopped(&self) {
        // An error means that the sender was dropped, which stops the server as well.
        let _ = self.stopping.clone().wait_for(|&stop| stop).await;
    }
}
