//! Accepts connections, a bounded number of them.

use std::sync::Arc;
use std::time::Duration;

use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use socket2::{SockRef, TcpKeepalive};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;

use crate::idle_deadline::IdleDeadline;
use crate::limits;
use crate::routes;
use crate::state::ServerState;

/// Serves connections until the server stops. At the maximum number of connections, further ones wait
/// in the kernel's backlog.
pub(crate) async fn listen(state: Arc<ServerState>, listener: TcpListener) {
    let permits = Arc::new(Semaphore::new(state.limits.connections + limits::SPARE_CONNECTIONS));
    let app = routes::router(state.clone());
    loop {
        let accepted = async {
            // The semaphore is never closed.
            let permit = permits.clone().acquire_owned().await.ok()?;
            Some((permit, listener.accept().await))
        };
        let (permit, stream) = tokio::select! {
            Some((permit, accepted)) = accepted => match accepted {
                Ok((stream, _)) => (permit, stream),
                Err(error) => {
                    // Most likely there are no file descriptors left; some will be closed.
                    tracing::warn!("cannot accept a connection: {error}");
                    tokio::time::sleep(Duration::from_millis(100)).await;
                    continue;
                }
            },
            () = state.stopped() => return,
        };
        set_options(&stream);
        let deadline = Arc::new(IdleDeadline::new(state.limits.hello + state.limits.send));
        // A WebSocket outlives its HTTP request, and keeps the permit that came with it.
        let app = app
            .clone()
            .layer(axum::Extension(Arc::new(permit)))
            .layer(axum::Extension(deadline.clone()));
        let connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(state.limits.hello)
            .serve_connection(TokioIo::new(stream), TowerToHyperService::new(app))
            .with_upgrades();
        let state = state.clone();
        tokio::spawn(async move {
            tokio::select! {
                // Errors are caused by the client, which disconnected or sent no HTTP, and are not logged.
                _ = connection => {}
                () = deadline.passed() => {}
                () = state.stopped() => {}
            }
        });
    }
}

/// Disables Nagle's algorithm, so that small messages are sent at once, and enables TCP keepalive, so that
/// the kernel detects dead peers.
fn set_options(stream: &TcpStream) {
    let keepalive = TcpKeepalive::new()
        .with_time(limits::KEEPALIVE_IDLE)
        .with_interval(limits::KEEPALIVE_INTERVAL)
        .with_retries(limits::KEEPALIVE_PROBES);
    let set =
        stream.set_nodelay(true).and_then(|()| SockRef::from(stream).set_tcp_keepalive(&keepalive));
    if let Err(error) = set {
        tracing::warn!("cannot set socket options: {error}");
    }
}
