//! Accepts connections, a bounded number of them.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use socket2::{SockRef, TcpKeepalive};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;

use crate::admission::{ConnectionSlot, ConnectionSlots};
use crate::idle_deadline::IdleDeadline;
use crate::limits;
use crate::state::ServerState;
use crate::stream::Stream;
use crate::tls::Tls;

/// A socket that listens, and its address.
pub(crate) struct Listener {
    pub(crate) socket: TcpListener,
    pub(crate) address: SocketAddr,
}

/// Serves connections until the server stops.
pub(crate) async fn listen(
    state: Arc<ServerState>,
    listener: TcpListener,
    tls: Option<Arc<Tls>>,
    app: Router,
) {
    let acceptor = Acceptor::new(state.clone(), app);
    let hello = state.limits.hello;
    loop {
        // The slot is a part of accepting: while there is none, connections wait in the kernel's
        // queue.
        let accepted = async {
            let (stream, address) = listener.accept().await?;
            Ok::<_, std::io::Error>((stream, acceptor.admit(address.ip()).await))
        };
        let (stream, slot) = tokio::select! {
            accepted = accepted => match accepted {
                Ok(accepted) => accepted,
                Err(error) => {
                    // Most likely no file descriptors are left; connections that end will free
                    // some.
                    tracing::warn!("cannot accept a connection: {error}");
                    tokio::time::sleep(Duration::from_millis(100)).await;
                    continue;
                }
            },
            () = state.stopped() => return,
        };
        // The handshake of TLS runs in the connection's own task, so that a slow client holds up no
        // other.
        set_options(&stream);
        let tls = tls.clone();
        acceptor.serve(slot, async move { Stream::accept(stream, tls.as_deref(), hello).await });
    }
}

/// Serves connections, whatever carries their bytes.
pub(crate) struct Acceptor {
    state: Arc<ServerState>,
    connections: Arc<ConnectionSlots>,
    app: Router,
}

impl Acceptor {
    pub(crate) fn new(state: Arc<ServerState>, app: Router) -> Self {
        let connections =
            // All WebSockets, and some more for HTTP, or nothing could be asked while all are in
            // use.
            ConnectionSlots::new(state.limits.connections + limits::SPARE_CONNECTIONS);
        Self { state, connections, app }
    }

    /// A slot for a connection from an address.
    pub(crate) async fn admit(&self, address: IpAddr) -> ConnectionSlot {
        self.connections.admit(address).await
    }

    /// Serves a connection until it ends or becomes a WebSocket.
    pub(crate) fn serve(
        &self,
        slot: ConnectionSlot,
        stream: impl Future<Output = Option<Stream>> + Send + 'static,
    ) -> JoinHandle<()> {
        let state = self.state.clone();
        let hello = state.limits.hello;
        // A client may take `hello` to send its request, and `send` to read the answer.
        let deadline = Arc::new(IdleDeadline::new(hello + state.limits.send));
        // A WebSocket outlives its HTTP request, and keeps the slot that came with it.
        let slot = Arc::new(slot);
        let app = self
            .app
            .clone()
            .layer(axum::Extension(slot.clone()))
            .layer(axum::Extension(deadline.clone()));
        let connection = async move {
            let Some(stream) = stream.await else { return };
            // Errors are caused by the client, which disconnected or sent no HTTP, and are not
            // logged.
            let _ = http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(hello)
                .max_buf_size(limits::HEAD_BYTES)
                .serve_connection(TokioIo::new(stream), TowerToHyperService::new(app))
                .with_upgrades()
                .await;
        };
        self.state.engine.polls().spawn("connection", async move {
            tokio::select! {
                () = connection => {}
                () = deadline.passed() => {}
                // Each of these drops the connection. A WebSocket has been moved to a task of its
                // own by then, and is not ended by the deadline.
                () = slot.closed() => {}
                () = state.stopped() => {}
            }
        })
    }
}

/// Disables Nagle's algorithm, so that small messages are sent at once, and enables TCP keepalive,
/// so that the kernel detects dead peers.
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
