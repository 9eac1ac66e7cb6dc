//! Starts a server.

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use tokio::net::TcpListener;
use tokio::sync::{Semaphore, watch};

use wildcity_push::PushQueue;
use wildcity_session::{Engine, EngineSettings, Scenarios, SessionError};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, StoreError};

use crate::audit::Audit;
use crate::auth::{CurrentTokens, Tokens};
use crate::config::{Config, Directories};
use crate::listen::Listener;
use crate::metrics::Metrics;
use crate::readiness::Readiness;
use crate::sessions::SessionRegistry;
use crate::shutdown::Running;
use crate::spool::{Spool, SpoolMedium};
use crate::state::ServerState;
use crate::tickets::Tickets;
use crate::tls::{Tls, TlsError};
use crate::token_counts::TokenCounts;

/// Why a server did not start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The address is not a loopback address, and there are no tokens: any machine of the network
    /// could open sessions and read the twins.
    #[error(
        "{address} is not a loopback address, and without tokens only 127.0.0.1 and [::1] are \
         safe: give --tokens FILE, or reach them from elsewhere through an SSH tunnel"
    )]
    PublicAddress { address: SocketAddr },
    /// The address cannot be used.
    #[error(
        "cannot listen on {address}: {cause}; stop the program that uses it, or give another {option}"
    )]
    Listen {
        /// The option that has the address.
        option: &'static str,
        address: SocketAddr,
        /// The operating system's error.
        cause: io::Error,
    },
    /// The directory for episodes cannot be made.
    #[error("cannot record episodes in {}: {cause}", path.display())]
    Episodes {
        path: PathBuf,
        /// The operating system's error.
        cause: io::Error,
    },
    /// The audit log cannot be opened.
    #[error("cannot write the audit log {}: {cause}", path.display())]
    Audit {
        path: PathBuf,
        /// The operating system's error.
        cause: io::Error,
    },
    /// The certificate or the key cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
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
/// The address is not a loopback address and there are no tokens, or the address or a directory
/// cannot be used. A directory for uploads that cannot be used is only logged: the server starts
/// and refuses uploads.
pub async fn start(config: Config) -> Result<Running, ServerError> {
    let Config {
        listen,
        directories: Directories { twins, episodes, scenarios, uploads },
        cache,
        metrics_listen,
        tokens,
        origins,
        tls,
        audit,
        mcap,
        backend,
        repairs,
        profile,
        shared_memory,
        limits,
    } = config;
    // First, so that a refused configuration makes no directory.
    if tokens.is_none() && !listen.ip().is_loopback() {
        return Err(ServerError::PublicAddress { address: listen });
    }

    // The engine: twins, renderer, recordings.
    std::fs::create_dir_all(&episodes)
        .map_err(|cause| ServerError::Episodes { path: episodes.clone(), cause })?;
    let catalog = Catalog::open_cached(&twins, cache.as_ref())?;
    let tls = tls.map(Tls::load).transpose()?;
    let audit_error = |cause| ServerError::Audit { path: audit.clone().unwrap_or_default(), cause };
    let audit = Audit::open(audit.as_deref()).map_err(audit_error)?;
    let cache = Cache::limited(catalog, limits.resident_bytes);
    let engine = Engine::start(EngineSettings {
        cache,
        episodes: episodes.clone(),
        scenarios: Scenarios::in_dir(scenarios),
        backend,
        step_timeout: limits.step,
        repairs,
        mcap,
    })?;

    engine.limit_records(limits.records);

    // The socket.
    let listener = bind("--listen", listen).await?;
    let metrics_listener = match metrics_listen {
        Some(address) => Some(bind("--metrics-listen", address).await?),
        None => None,
    };

    // Uploads. Agents can drive without them.
    // All clients of a server without tokens share one owner, the empty name.
    let uploaders = tokens.as_ref().map_or(1, Tokens::uploaders);
    let own_bytes = tokens.as_ref().map(Tokens::upload_bytes).unwrap_or_default();
    let spool = Spool::open(SpoolMedium::directory(&uploads), limits.spool, uploaders, own_bytes)
        .map(Arc::new)
        .map_err(|error| {
            let reason = format!("{}: {error}", uploads.display());
            tracing::warn!("uploads are refused: {reason}");
            reason
        });

    let mut disks = vec![("episodes", episodes.clone()), ("uploads", uploads)];
    // A twin at a URL has no disk here.
    if !twins.to_string_lossy().contains("://") {
        disks.push(("twins", twins));
    }
    // A watch and not a notification: a task that asks later sees the value, too.
    let (stop, stopping) = watch::channel(false);
    let state = Arc::new(ServerState {
        metrics: Metrics::new(engine.clone(), disks),
        engine,
        sessions: SessionRegistry::new(limits.sessions, limits.resume_grace),
        websocket_permits: Arc::new(Semaphore::new(limits.connections)),
        unfinished: Arc::default(),
        parse_turns: Arc::new(Semaphore::new(crate::limits::PARSED_AT_ONCE)),
        drive_turns: Arc::new(Semaphore::new(crate::limits::DRIVES_AT_ONCE)),
        scenario_listing: Arc::default(),
        stopping,
        limits,
        profile,
        shares_memory: shared_memory,
        tokens: tokens.map(CurrentTokens::new),
        tickets: Tickets::default(),
        audit: Arc::new(audit),
        open_pushes: TokenCounts::default(),
        open_connections: TokenCounts::default(),
        readiness: Readiness::default(),
        origins,
        episodes,
        spool,
        pushes: PushQueue::new(limits.queue()),
    });
    Ok(Running::new(state, listener, metrics_listener, tls, stop))
}

async fn bind(option: &'static str, address: SocketAddr) -> Result<Listener, ServerError> {
    let listen_error = |cause| ServerError::Listen { option, address, cause };
    let socket = TcpListener::bind(address).await.map_err(listen_error)?;
    let address = socket.local_addr().map_err(listen_error)?;
    Ok(Listener { socket, address })
}
