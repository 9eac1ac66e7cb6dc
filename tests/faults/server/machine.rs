//! A machine that runs servers: a runtime, a renderer, and one twin on a simulated disk.

use std::cell::RefCell;
use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::DuplexStream;
use tokio::runtime::Runtime;
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinHandle;

use wildcity_push::PushQueue;
use wildcity_repair::Models;
use wildcity_session::{BudgetShare, Engine, EngineSettings, Scenarios, SessionError};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::Catalog;

use crate::audit::Audit;
use crate::auth::{CurrentTokens, Tokens};
use crate::config::Limits;
use crate::listen::Acceptor;
use crate::metrics::Metrics;
use crate::origins::Origins;
use crate::readiness::Readiness;
use crate::sessions::SessionRegistry;
use crate::spool::Spool;
use crate::state::ServerState;
use crate::stream::Stream;
use crate::tickets::Tickets;
use crate::token_counts::TokenCounts;

use super::disk::{ROOT, SimClock, SimDisk};
use super::support::{Painter, commit_twin_to};

/// How long a simulated client waits before the history fails.
pub(super) const CLIENT_TIMEOUT: Duration = Duration::from_secs(20);

/// Memory for twins: enough for the only one.
const RESIDENT_BYTES: u64 = 64 << 20;

/// Parts that the servers of many histories share.
pub(super) struct Machine {
    pub(super) runtime: Runtime,
    engine: Arc<Engine>,
    painter: Arc<Painter>,
    episodes: tempfile::TempDir,
}

/// A server without sockets.
pub(super) struct SimServer {
    pub(super) state: Arc<ServerState>,
    acceptor: Acceptor,
    /// The backend of the server.
    pub(super) painter: Arc<Painter>,
    /// Memory of answers that a planted fault keeps.
    kept: RefCell<Vec<BudgetShare>>,
    _stop: watch::Sender<bool>,
}

impl Machine {
    pub(super) fn new() -> Self {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let clock = Arc::new(SimClock::new());
        let disk = Arc::new(SimDisk::new(clock.clone(), None));
        let catalog = Catalog::on(Path::new(ROOT), disk, clock).expect("a catalog");
        commit_twin_to(&catalog, 2.0);
        let painter = Arc::new(Painter::default());
        let episodes = tempfile::tempdir().expect("a temporary directory");
        let engine = Engine::start(EngineSettings {
            cache: Cache::limited(catalog, Some(RESIDENT_BYTES)),
            episodes: episodes.path().to_owned(),
            scenarios: Scenarios::in_dir(episodes.path().join("scenarios")),
            backend: painter.clone(),
            step_timeout: CLIENT_TIMEOUT,
            repairs: Arc::new(Models::default()),
            mcap: false,
        });
        let runtime = runtime.expect("a runtime");
        Self { runtime, engine: engine.expect("an engine"), painter, episodes }
    }

    /// A server with these limits.
    pub(super) fn server(
        &self,
        limits: Limits,
        tokens: Option<Tokens>,
        spool: Result<Arc<Spool>, String>,
    ) -> SimServer {
        let (stop, stopping) = watch::channel(false);
        let state = Arc::new(ServerState {
            metrics: Metrics::new(self.engine.clone(), Vec::new()),
            engine: self.engine.clone(),
            sessions: SessionRegistry::new(limits.sessions, limits.resume_grace),
            websocket_permits: Arc::new(Semaphore::new(limits.connections)),
            unfinished: Arc::default(),
            parse_turns: Arc::new(Semaphore::new(crate::limits::PARSED_AT_ONCE)),
            drive_turns: Arc::new(Semaphore::new(crate::limits::DRIVES_AT_ONCE)),
            scenario_listing: Arc::default(),
            stopping,
            limits,
            profile: Default::default(),
            shares_memory: false,
            tokens: tokens.map(CurrentTokens::new),
            tickets: Tickets::default(),
            audit: Arc::new(Audit::open(None).expect("no audit log")),
            open_pushes: TokenCounts::default(),
            open_connections: TokenCounts::default(),
            readiness: Readiness::default(),
            origins: Origins::default(),
            episodes: self.episodes.path().to_owned(),
            spool,
            pushes: PushQueue::new(limits.queue()),
        });
        SimServer {
            acceptor: Acceptor::new(state.clone(), crate::routes::router(state.clone())),
            painter: self.painter.clone(),
            kept: RefCell::default(),
            state,
            _stop: stop,
        }
    }
}

impl SimServer {
    /// Keeps the memory of an answer as long as the server.
    pub(super) fn keep(&self, share: Result<BudgetShare, SessionError>) {
        self.kept.borrow_mut().extend(share);
    }

    /// Connects a client. The task ends when the connection does, or becomes a WebSocket.
    pub(super) async fn connect(&self, buffer_bytes: usize) -> (DuplexStream, JoinHandle<()>) {
        let (client, server) = tokio::io::duplex(buffer_bytes);
        let slot = self.acceptor.admit(IpAddr::V4(Ipv4Addr::LOCALHOST)).await;
        let stream = Stream::new(server, Err("the network is simulated"));
        (client, self.acceptor.serve(slot, async { Some(stream) }))
    }
}
