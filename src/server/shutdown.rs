//! A running server, and stopping it without losing running steps.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use wildcity_episode::prune;
use wildcity_session::Engine;

use crate::limits;
use crate::listen::{Listener, listen};
use crate::reload::reload;
use crate::routes;
use crate::state::ServerState;
use crate::tls::Tls;

/// Time between two looks at the sessions that are left.
const SESSIONS_LOOK: Duration = Duration::from_millis(100);

/// A server that listens. Dropping it stops it without waiting; the last of its tasks to end waits
/// for the frames that are being rendered.
pub struct Running {
    state: Arc<ServerState>,
    address: SocketAddr,
    metrics_address: Option<SocketAddr>,
    has_tls: bool,
    stop: watch::Sender<bool>,
    listening: JoinHandle<()>,
}

/// Removes uploads that are too old, until dropped.
async fn remove_old_uploads(state: &ServerState) {
    let Ok(spool) = &state.spool else { return std::future::pending().await };
    // An upload is at most a quarter of its age too old, or a minute.
    let period = (spool.age() / 4).clamp(Duration::from_millis(10), Duration::from_secs(60));
    loop {
        tokio::time::sleep(period).await;
        let spool = spool.clone();
        if tokio::task::spawn_blocking(move || spool.remove_old()).await.is_err() {
            tracing::error!("old uploads were not removed: a task crashed");
        }
    }
}

/// Removes records that are beyond a limit, until dropped.
async fn remove_old_records(state: &ServerState) {
    let keep = state.limits.keep_records;
    if keep.keeps_all() {
        return std::future::pending().await;
    }
    loop {
        let dir = state.episodes.clone();
        let pruned =
            tokio::task::spawn_blocking(move || prune(&dir, keep, SystemTime::now(), false)).await;
        match pruned {
            Ok(Ok(pruned)) => {
                if !pruned.removed.is_empty() {
                    tracing::info!(
                        "removed {} old records of {} bytes",
                        pruned.removed.len(),
                        pruned.bytes
                    );
                }
                for (path, error) in pruned.failed {
                    tracing::warn!(path = %path.display(), "an old record was not removed: {error}");
                }
            }
            Ok(Err(error)) => tracing::warn!("old records were not removed: {error}"),
            Err(_) => tracing::error!("old records were not removed: a task crashed"),
        }
        tokio::time::sleep(limits::PRUNE_PERIOD).await;
    }
}

/// Keeps the versions that sessions use from garbage collection, until dropped.
async fn renew_leases(state: &ServerState) {
    loop {
        tokio::time::sleep(wildcity_session::limits::LEASE_RENEWAL).await;
        if let Err(error) = state.engine.renew_leases().await {
            tracing::warn!("leases were not renewed: {error}");
        }
    }
}

/// Gives memory that evicted sections, pushes and sessions no longer need back to the operating
/// system, until dropped.
async fn release_memory(state: &ServerState) {
    // Each release walks the whole heap, so it is done only if something was freed since the last
    // one.
    let changes = || {
        let sessions = state.engine.session_changes();
        (state.engine.residency().evictions, state.pushes.changes(), sessions)
    };
    let mut before = changes();
    // The last change may be counted while its memory is being freed, so that one more release
    // follows.
    let mut is_due = false;
    loop {
        tokio::time::sleep(state.limits.memory_release).await;
        let now = changes();
        let has_changed = now != before || state.pushes.open_count() > 0;
        if !has_changed && !is_due {
            continue;
        }
        is_due = has_changed;
        before = now;
        let began = Instant::now();
        match tokio::task::spawn_blocking(wildcity_heap::release_free_memory).await {
            Ok(()) => tracing::debug!(took = ?began.elapsed(), "released free memory"),
            Err(_) => tracing::error!("free memory was not released: a task crashed"),
        }
    }
}

impl Running {
    /// Starts the tasks of a server.
    pub(crate) fn new(
        state: Arc<ServerState>,
        listener: Listener,
        metrics_listener: Option<Listener>,
        tls: Option<Arc<Tls>>,
        stop: watch::Sender<bool>,
    ) -> Self {
        let has_tls = tls.is_some();
        let reloading = reload(tls.clone(), state.clone());
        // A task of its own, because `stop` waits for it: afterwards no connection is accepted.
        let app = routes::router(state.clone());
        let polls = state.engine.polls().clone();
        let listening = polls.spawn("listener", listen(state.clone(), listener.socket, tls, app));
        let metrics_address = metrics_listener.as_ref().map(|listener| listener.address);
        if let Some(listener) = metrics_listener {
            let app = routes::open_router(state.clone());
            polls.spawn("metrics listener", listen(state.clone(), listener.socket, None, app));
        }
        let periodic = state.clone();
        polls.spawn("periodic", async move {
            // One task for all: none of them ends before the server, and each spends its time
            // waiting.
            tokio::select! {
                () = periodic.sessions.end_expired() => {}
                () = remove_old_uploads(&periodic) => {}
                () = remove_old_records(&periodic) => {}
                () = renew_leases(&periodic) => {}
                () = release_memory(&periodic) => {}
                () = reloading => {}
                () = periodic.stopped() => {}
            }
        });
        let address = listener.address;
        Self { state, address, metrics_address, has_tls, stop, listening }
    }

    /// The address that the server listens on.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The address of the second listener, for metrics.
    pub fn metrics_address(&self) -> Option<SocketAddr> {
        self.metrics_address
    }

    /// The URL that agents connect to.
    pub fn url(&self) -> String {
        let scheme = if self.has_tls { "wss" } else { "ws" };
        format!("{scheme}://{}/v1/session", self.address)
    }

    /// The URL of the viewer.
    pub fn page(&self) -> String {
        let scheme = if self.has_tls { "https" } else { "http" };
        // All addresses are no place to go to; this machine's own is one of them.
        let ip = match self.address.ip() {
            IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
            IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
            ip => ip,
        };
        format!("{scheme}://{}/", SocketAddr::new(ip, self.address.port()))
    }

    /// The renderer and the twins, for other services of the same process.
    pub fn engine(&self) -> &Arc<Engine> {
        &self.state.engine
    }

    /// Number of sessions at this moment: connected, and waiting to be resumed.
    pub fn sessions(&self) -> usize {
        self.state.sessions.count()
    }

    /// How often a SIGHUP was carried out: certificate and tokens were read again, or stayed
    /// because they cannot be used.
    pub fn reloads(&self) -> u64 {
        self.state.metrics.reloads.get()
    }

    /// Number of WebSocket connections at this moment.
    pub fn connections(&self) -> usize {
        self.state.limits.connections - self.state.websocket_permits.available_permits()
    }

    /// Opens no session from now on, is not ready any more, and waits until the last session has
    /// ended, up to the limit of the configuration. Sessions without a connection can be resumed.
    pub async fn end_sessions(&self) {
        self.state.sessions.open_no_more();
        let longest = self.state.limits.sessions_end;
        let count = || self.sessions();
        if longest.is_zero() || count() == 0 {
            return;
        }
        tracing::info!("open sessions: {}; they may go on for {longest:?}", count());
        let end = Instant::now() + longest;
        while count() > 0 && Instant::now() < end {
            tokio::time::sleep(SESSIONS_LOOK).await;
        }
        match count() {
            0 => tracing::info!("no session is left"),
            count => tracing::warn!("open sessions at the end of the wait: {count}"),
        }
    }

    /// Stops accepting connections, lets running steps finish, notifies every client, and ends
    /// every session. Exports that have started are finished.
    pub async fn stop(self) {
        // An error means that no task waits for the signal any more.
        let _ = self.stop.send(true);
        if let Err(error) = self.listening.await {
            tracing::error!("the listener crashed: {error}");
        }
        let ServerState { websocket_permits, limits, sessions, .. } = &*self.state;
        // Each connection holds one permit: all permits are free when all connections have ended.
        // The signal above reaches every connection: it finishes its request, tells its client, and
        // ends.
        let all = websocket_permits.acquire_many(limits.connections as u32);
        if timeout(limits.drain, all).await.is_err() {
            tracing::warn!("some clients did not leave within {:?}", limits.drain);
        }
        // The connections that have ended in time have parked their sessions, which end here.
        sessions.end_all_parked().await;
        if !self.state.engine.wait_for_exports(None, limits.drain).await {
            tracing::warn!(
                "MCAP files of some episodes were not written within {:?}",
                limits.drain
            );
        }
    }
}

impl std::fmt::Debug for Running {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Running").field("address", &self.address).finish_non_exhaustive()
    }
}

/// A future that ends when the process is asked to stop: SIGTERM, or Ctrl-C. From the call on, a
/// signal no longer ends the process by itself.
///
/// # Errors
/// Signals cannot be received.
pub fn stop_signal() -> std::io::Result<impl Future<Output = ()>> {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        // Registered here and not in the future, so that a signal before the first poll is not
        // lost.
        let mut terminate = signal(SignalKind::terminate())?;
        let mut interrupt = signal(SignalKind::interrupt())?;
        Ok(async move {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = interrupt.recv() => {}
            }
        })
    }
    #[cfg(not(unix))]
    {
        let mut interrupt = tokio::signal::windows::ctrl_c()?;
        Ok(async move {
            // `None` would mean that no signal can come any more.
            let _ = interrupt.recv().await;
        })
    }
}
