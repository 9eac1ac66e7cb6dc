//! Stopping without losing what runs.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use super::{Server, listen};

/// A server that listens. Dropping it stops it without waiting.
pub struct Running {
    server: Arc<Server>,
    address: SocketAddr,
    stop: watch::Sender<bool>,
    listening: JoinHandle<()>,
}

/// Throws away uploads that nobody came back for, until dropped.
async fn reap_uploads(server: &Server) {
    let Ok(spool) = &server.spool else { return std::future::pending().await };
    let period = (spool.age() / 4).clamp(Duration::from_millis(10), Duration::from_secs(60));
    loop {
        tokio::time::sleep(period).await;
        let spool = spool.clone();
        if tokio::task::spawn_blocking(move || spool.reap()).await.is_err() {
            tracing::error!("old uploads were not thrown away: a task crashed");
        }
    }
}

/// Keeps what sessions use from garbage collection, until dropped.
async fn renew_leases(server: &Server) {
    loop {
        tokio::time::sleep(wildcity_session::limits::LEASE_RENEWAL).await;
        if let Err(error) = server.engine.renew_leases().await {
            tracing::warn!("leases were not renewed: {error}");
        }
    }
}

impl Running {
    pub(super) fn new(
        server: Arc<Server>,
        listener: TcpListener,
        address: SocketAddr,
        stop: watch::Sender<bool>,
    ) -> Self {
        let listening = tokio::spawn(listen::listen(server.clone(), listener));
        let reaping = server.clone();
        tokio::spawn(async move {
            tokio::select! {
                () = reaping.sessions.reap() => {}
                () = reap_uploads(&reaping) => {}
                () = renew_leases(&reaping) => {}
                () = reaping.stopped() => {}
            }
        });
        Self { server, address, stop, listening }
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// What agents dial.
    pub fn url(&self) -> String {
        format!("ws://{}/v1/session", self.address)
    }

    /// Sessions at this moment: connected, and waiting to be resumed.
    pub fn sessions(&self) -> usize {
        self.server.sessions.count()
    }

    /// WebSocket connections at this moment.
    pub fn connections(&self) -> usize {
        self.server.limits.connections - self.server.agents.available_permits()
    }

    /// Accepts nobody any more, lets running steps finish, tells every client, ends every session.
    pub async fn stop(self) {
        // Every receiver may be gone already: nobody is left to be told.
        let _ = self.stop.send(true);
        if let Err(error) = self.listening.await {
            tracing::error!("the listener ended badly: {error}");
        }
        let Server { agents, limits, sessions, .. } = &*self.server;
        // A connection holds one permit, so that all of them are there when all have ended.
        let all = agents.acquire_many(limits.connections as u32);
        if timeout(limits.drain, all).await.is_err() {
            tracing::warn!("some clients did not leave within {:?}", limits.drain);
        }
        sessions.end_all_parked().await;
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
