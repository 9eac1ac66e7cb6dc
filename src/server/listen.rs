//! Accepts connections, a bounded number of them.

use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use socket2::{SockRef, TcpKeepalive};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::time::{Instant, timeout};

use crate::limits;

use super::{Server, router};

/// Serves connections until the server stops. When all places are taken, further connections wait
/// in the kernel's backlog.
pub(super) async fn listen(server: Arc<Server>, listener: TcpListener) {
    let places = Arc::new(Semaphore::new(server.limits.connections + limits::SPARE_CONNECTIONS));
    let app = router::router(server.clone());
    loop {
        let accepted = async {
            // The semaphore is never closed.
            let place = places.clone().acquire_owned().await.ok()?;
            Some((place, listener.accept().await))
        };
        let (place, stream) = tokio::select! {
            Some((place, accepted)) = accepted => match accepted {
                Ok((stream, _)) => (place, stream),
                Err(error) => {
                    // Out of file descriptors, most likely: some will come free.
                    tracing::warn!("cannot accept a connection: {error}");
                    tokio::time::sleep(Duration::from_millis(100)).await;
                    continue;
                }
            },
            () = server.stopped() => return,
        };
        prepare(&stream);
        // A WebSocket leaves HTTP behind but keeps its place, inside the request.
        let patience = Arc::new(Patience::new(server.limits.hello + server.limits.send));
        let app = app
            .clone()
            .layer(axum::Extension(Arc::new(place)))
            .layer(axum::Extension(patience.clone()));
        let connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(server.limits.hello)
            .serve_connection(TokioIo::new(stream), TowerToHyperService::new(app))
            .with_upgrades();
        let server = server.clone();
        tokio::spawn(async move {
            tokio::select! {
                // The client's fault, and of no interest: it went away, never spoke HTTP, or does
                // not read.
                _ = connection => {}
                () = patience.over() => {}
                () = server.stopped() => {}
            }
        });
    }
}

/// How long a connection may take for its requests and their answers, from the last time that one of
/// them showed that it goes on; what becomes a WebSocket is over here by then.
pub(super) struct Patience {
    until: Mutex<Instant>,
    period: Duration,
}

impl Patience {
    fn new(period: Duration) -> Self {
        Self { until: Mutex::new(Instant::now() + period), period }
    }

    /// A request goes on.
    pub(super) fn extend(&self) {
        *self.until.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now() + self.period;
    }

    /// Does what the client waits for, and whose time is not its own; the request goes on until then.
    pub(super) async fn during<T>(&self, work: impl Future<Output = T>) -> T {
        let mut work = pin!(work);
        loop {
            self.extend();
            if let Ok(done) = timeout(self.period / 2, &mut work).await {
                self.extend();
                return done;
            }
        }
    }

    async fn over(&self) {
        loop {
            let until = *self.until.lock().unwrap_or_else(PoisonError::into_inner);
            if until <= Instant::now() {
                return;
            }
            tokio::time::sleep_until(until).await;
        }
    }
}

/// Small messages at once, and dead peers noticed.
fn prepare(stream: &TcpStream) {
    let (idle, interval, retries) = limits::KEEPALIVE;
    let keepalive =
        TcpKeepalive::new().with_time(idle).with_interval(interval).with_retries(retries);
    let set =
        stream.set_nodelay(true).and_then(|()| SockRef::from(stream).set_tcp_keepalive(&keepalive));
    if let Err(error) = set {
        tracing::warn!("cannot set socket options: {error}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_client_is_not_cut_off_while_it_waits_for_the_server() {
        let patience = Patience::new(Duration::from_millis(400));
        tokio::select! {
            biased;
            () = patience.over() => panic!("cut off in the middle of it"),
            () = patience.during(tokio::time::sleep(Duration::from_millis(1200))) => {}
        }
        // Its own silence still is.
        let silent = timeout(Duration::from_secs(10), patience.over());
        silent.await.expect("over some time");
    }
}
