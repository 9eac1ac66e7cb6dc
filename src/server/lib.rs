//! WebSocket and HTTP.
//!
//! ```text
//! listen      accepts connections, a bounded number
//! router      HTTP routes, and the upgrade to WebSocket
//! auth        who may do what
//! uploads     files on their way in; spool: where they lie
//! push        new versions of uploaded files; publish: making one; report: what was found
//! twins       what there is, and rollback
//! metrics     numbers for Prometheus
//! refusal     faults as answers of HTTP
//! socket      WebSocket messages, with a time-out on every wait
//! connection  one agent, in lock step: read a request, answer it
//! sessions    who exists, who is connected, who waits to be resumed
//! convert     wire to session and back
//! shutdown    stopping without losing what runs
//! ```

mod auth;
mod connection;
mod convert;
mod fault;
pub mod limits;
mod listen;
mod metrics;
mod publish;
mod push;
mod refusal;
mod report;
mod router;
mod sessions;
mod shutdown;
mod socket;
mod spool;
mod twins;
mod uploads;

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::Semaphore;

use wildcity_render::Backend;
use wildcity_scene::ProfileOverrides;
use wildcity_session::{Engine, EngineSettings, SessionError};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, DiskCacheSettings, StoreError};

use spool::Spool;

pub use auth::{Role, Tokens, TokensError};
pub use shutdown::{Running, stop_signal};
pub use spool::SpoolLimits;

/// What a server is made of.
#[derive(Clone)]
pub struct Config {
    /// Where to listen; port 0 takes a free one. Without tokens, a loopback address.
    pub listen: SocketAddr,
    /// Directory of twins, or their URL.
    pub twins: PathBuf,
    /// Where parts of twins at a URL are kept on disk.
    pub cache: Option<DiskCacheSettings>,
    /// Directory where episodes are recorded.
    pub episodes: PathBuf,
    /// Directory where uploads are kept until they are pushed. One server uses it at a time.
    pub uploads: PathBuf,
    /// Who may do what; everybody everything if none are said.
    pub tokens: Option<Tokens>,
    /// What renders.
    pub backend: Arc<dyn Backend>,
    /// What of every twin's render profile is otherwise, unless a session says more.
    pub profile: ProfileOverrides,
    /// How long the server waits, and for how many.
    pub limits: Limits,
}

/// How long the server waits for what, and how many it serves; see the constants in
/// [`crate::limits`] that are the defaults.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// For the first message of a connection.
    pub hello: Duration,
    /// For the next request.
    pub idle: Duration,
    /// For a client to read an answer.
    pub send: Duration,
    /// For one step, waiting for other sessions included.
    pub step: Duration,
    /// For a lost client to resume its session.
    pub resume_grace: Duration,
    /// For running steps when the server stops.
    pub drain: Duration,
    /// WebSocket connections at once.
    pub connections: usize,
    /// Sessions at once.
    pub sessions: usize,
    /// Bytes of memory that all twins in use may take; if none is said, three quarters of the
    /// machine's.
    pub resident_bytes: Option<u64>,
    /// How much is kept of uploads.
    pub spool: SpoolLimits,
}

/// Why a server did not start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// Anybody in the network could drive, and read the twins.
    #[error(
        "{address} is not a loopback address, and without tokens only 127.0.0.1 and [::1] are \
         safe: give --tokens FILE, or reach them from elsewhere through an SSH tunnel"
    )]
    PublicAddress {
        /// The refused address.
        address: SocketAddr,
    },
    /// The address cannot be used.
    #[error("cannot listen on {address}: {cause}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// What the operating system says.
        cause: io::Error,
    },
    /// The directory for episodes cannot be made.
    #[error("cannot record episodes in {}: {cause}", path.display())]
    Episodes {
        /// The directory.
        path: PathBuf,
        /// What the operating system says.
        cause: io::Error,
    },
    /// The directory of twins cannot be read.
    #[error(transparent)]
    Twins(#[from] StoreError),
    /// The renderer cannot be started.
    #[error(transparent)]
    Engine(#[from] SessionError),
}

/// Starts a server within the running tokio runtime and returns once it listens.
///
/// # Errors
/// The address is not a loopback address and there are no tokens, or it cannot be used, or a directory
/// cannot. One for uploads that cannot be used is logged: whoever uploads is told.
pub async fn start(config: Config) -> Result<Running, ServerError> {
    let Config { listen, twins, cache, episodes, uploads, tokens, backend, profile, limits } =
        config;
    if tokens.is_none() && !listen.ip().is_loopback() {
        return Err(ServerError::PublicAddress { address: listen });
    }
    std::fs::create_dir_all(&episodes)
        .map_err(|cause| ServerError::Episodes { path: episodes.clone(), cause })?;
    let cache =
        Cache::limited(Catalog::open_cached(&twins, cache.as_ref())?, limits.resident_bytes);
    let settings = EngineSettings { cache, episodes, backend, step_timeout: limits.step };
    let engine = Engine::start(settings)?;
    let failed = |cause| ServerError::Listen { address: listen, cause };
    let listener = TcpListener::bind(listen).await.map_err(failed)?;
    let address = listener.local_addr().map_err(failed)?;
    let spool = Spool::open(&uploads, limits.spool).map(Arc::new).map_err(|error| {
        let reason = format!("{}: {error}", uploads.display());
        tracing::warn!("no uploads are taken: {reason}");
        reason
    });
    let (stop, stopping) = tokio::sync::watch::channel(false);
    let server = Arc::new(Server {
        metrics: metrics::Metrics::new(engine.clone()),
        engine,
        sessions: sessions::Sessions::new(limits.sessions, limits.resume_grace),
        agents: Arc::new(Semaphore::new(limits.connections)),
        stopping,
        limits,
        profile,
        tokens,
        spool,
        pushes: push::Pushes::new(),
    });
    Ok(Running::new(server, listener, address, stop))
}

/// What all connections share.
struct Server {
    engine: Arc<Engine>,
    sessions: Arc<sessions::Sessions>,
    /// One permit per WebSocket connection.
    agents: Arc<Semaphore>,
    /// Becomes true when the server stops.
    stopping: tokio::sync::watch::Receiver<bool>,
    limits: Limits,
    profile: ProfileOverrides,
    tokens: Option<Tokens>,
    /// Or why there is none.
    spool: Result<Arc<Spool>, String>,
    pushes: push::Pushes,
    metrics: metrics::Metrics,
}

impl Server {
    /// Where uploads lie.
    fn spool(&self) -> Result<&Arc<Spool>, fault::Fault> {
        self.spool.as_ref().map_err(|reason| fault::Fault::NoUploads { reason: reason.clone() })
    }

    /// Returns when the server stops.
    async fn stopped(&self) {
        // An error means that whoever could say so is gone, which says the same.
        let _ = self.stopping.clone().wait_for(|&stop| stop).await;
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            hello: wildcity_protocol::limits::HELLO_TIMEOUT,
            idle: limits::IDLE_TIMEOUT,
            send: wildcity_protocol::limits::SEND_TIMEOUT,
            step: wildcity_protocol::limits::STEP_TIMEOUT,
            resume_grace: limits::RESUME_GRACE,
            drain: limits::DRAIN_TIMEOUT,
            connections: limits::CONNECTIONS,
            sessions: wildcity_session::limits::SESSIONS,
            resident_bytes: None,
            spool: SpoolLimits::default(),
        }
    }
}

impl std::fmt::Debug for Config {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { listen, twins, cache, episodes, uploads, tokens, backend, profile, limits } =
            self;
        f.debug_struct("Config")
            .field("listen", listen)
            .field("twins", twins)
            .field("cache", cache)
            .field("episodes", episodes)
            .field("uploads", uploads)
            .field("tokens", &tokens.is_some())
            .field("backend", &backend.name())
            .field("profile", profile)
            .field("limits", limits)
            .finish()
    }
}
