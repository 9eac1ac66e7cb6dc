//! Accepts connections, and calls a method by its path.

use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use hyper::rt::Executor;
use hyper::server::conn::http2;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use wildcity_session::{Engine, Polls};

use super::methods::{Sensorsim, stopped};
use crate::door::{Connection, Door};
use crate::grpc::{unary, unimplemented};
use crate::limits;
use crate::wire::common::Empty;

/// Paths of the services' methods.
const SERVICE: &str = "/nre.grpc.protos.sensorsim.SensorsimService/";
const PHYSICS: &str = "/physics.PhysicsService/";

/// Why the service did not start.
#[derive(Debug, thiserror::Error)]
pub enum AlpasimError {
    /// The address is not a loopback address.
    #[error(
        "{address} is not a loopback address, and AlpaSim sends no tokens: any machine of the network could \
         read the twins; give --alpasim-open if that is intended"
    )]
    PublicAddress { address: SocketAddr },
    /// The address cannot be used.
    #[error("cannot listen on {address}: {cause}")]
    Listen {
        address: SocketAddr,
        /// The operating system's error.
        cause: io::Error,
    },
}

/// A service that listens. Dropping it stops it.
#[derive(Debug)]
pub struct Running {
    address: SocketAddr,
    stop: watch::Sender<bool>,
    listening: JoinHandle<()>,
    door: Arc<Door>,
}

/// Starts the service within the running tokio runtime, and returns once it listens.
///
/// # Errors
/// The address cannot be used, or is not a loopback address and `open` is false.
pub async fn start(
    engine: Arc<Engine>,
    listen: SocketAddr,
    open: bool,
) -> Result<Running, AlpasimError> {
    // Before the socket is bound, so that a refused address is never open, not even for a moment.
    if !open && !listen.ip().is_loopback() {
        return Err(AlpasimError::PublicAddress { address: listen });
    }
    let failed = |cause| AlpasimError::Listen { address: listen, cause };
    let listener = TcpListener::bind(listen).await.map_err(failed)?;
    let address = listener.local_addr().map_err(failed)?;
    let (stop, stopping) = watch::channel(false);
    let polls = engine.polls().clone();
    let sensorsim = Arc::new(Sensorsim::new(engine, stopping.clone()));
    let door = Door::new(limits::CONNECTIONS);
    let entered = door.clone();
    let spawner = Spawner(polls.clone());
    let listening = polls.spawn("AlpaSim listener", async move {
        // All three run until the first ends, which is the stop: the other two never return. The
        // listener is closed as `accept` is dropped.
        tokio::select! {
            () = accept(sensorsim.clone(), spawner, listener, entered, stopping.clone()) => {}
            () = sensorsim.forget_idle() => {}
            () = stopped(stopping.clone()) => {}
        }
    });
    Ok(Running { address, stop, listening, door })
}

impl Running {
    /// The address that the service listens on.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Stops accepting connections. Running requests are answered with `UNAVAILABLE`.
    pub async fn stop(self) {
        // An error means that no task waits for the signal any more.
        let _ = self.stop.send(true);
        if let Err(error) = self.listening.await {
            tracing::error!("the AlpaSim listener crashed: {error}");
        }
        // All connections that have ended have sent their answers.
        if tokio::time::timeout(limits::DRAIN, self.door.emptied()).await.is_err() {
            tracing::warn!("some AlpaSim clients did not leave within {:?}", limits::DRAIN);
        }
    }
}

/// Spawns the tasks of a connection, which answer its requests.
#[derive(Clone)]
struct Spawner(Arc<Polls>);

impl<F: Future<Output: Send> + Send + 'static> Executor<F> for Spawner {
    fn execute(&self, task: F) {
        self.0.spawn("AlpaSim request", task);
    }
}

async fn accept(
    sensorsim: Arc<Sensorsim>,
    spawner: Spawner,
    listener: TcpListener,
    door: Arc<Door>,
    stopping: watch::Receiver<bool>,
) {
    loop {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                // Most likely no file descriptors are left; connections that end will free some.
                tracing::warn!("cannot accept a connection: {error}");
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            }
        };
        // After accepting: a connection that has no place is refused, and does not stay in the
        // kernel's queue.
        let Some(place) = door.admit() else { continue };
        if let Err(error) = stream.set_nodelay(true) {
            tracing::warn!("cannot set socket options: {error}");
        }
        let sensorsim = sensorsim.clone();
        let stopping = stopping.clone();
        let requests = spawner.clone();
        spawner.0.spawn("AlpaSim connection", async move {
            // A closure for each connection, and a clone for each request: requests of one
            // connection run at once.
            let own = place.connection.clone();
            let service = service_fn(move |request| {
                let sensorsim = sensorsim.clone();
                let own = own.clone();
                async move { Ok::<_, Infallible>(call(sensorsim, &own, request).await) }
            });
            let connection = http2::Builder::new(requests)
                .timer(TokioTimer::new())
                // The default window of 64 KiB would stop at each part of a large batch. What is
                // in the windows is not counted yet.
                .initial_stream_window_size(1 << 20)
                .initial_connection_window_size(2 << 20)
                .max_concurrent_streams(64)
                .max_header_list_size(16 << 10)
                // A peer that is gone without a word.
                .keep_alive_interval(Some(Duration::from_secs(30)))
                .keep_alive_timeout(Duration::from_secs(30))
                .serve_connection(TokioIo::new(stream), service);
            tokio::pin!(connection);
            tokio::select! {
                // Errors are caused by the client, which disconnected or sent no HTTP/2, and are
                // not logged.
                _ = &mut connection => {}
                () = place.connection.to_close() => {}
                () = stopped(stopping) => {
                    // Running requests see the same signal, and are answered.
                    connection.as_mut().graceful_shutdown();
                    let _ = tokio::time::timeout(limits::DRAIN, connection).await;
                }
            }
            // The place ends with the connection, and not with the last request: `stop` waits for
            // it.
            drop(place);
        });
    }
}

/// Calls the method that the path names.
async fn call(
    sensorsim: Arc<Sensorsim>,
    own: &Arc<Connection>,
    request: http::Request<hyper::body::Incoming>,
) -> http::Response<tonic::body::Body> {
    // HTTP/2 names a method by `/package.Service/method`.
    let path = request.uri().path().to_owned();
    if let Some(method) = path.strip_prefix(PHYSICS) {
        return call_physics(&sensorsim, own, method, &path, request).await;
    }
    match path.strip_prefix(SERVICE) {
        Some("get_version") => {
            unary(own, request, |_: Empty| async { sensorsim.get_version() }).await
        }
        Some("get_available_scenes") => {
            unary(own, request, |_: Empty| async { sensorsim.get_available_scenes().await }).await
        }
        Some("get_loaded_scenes") => {
            unary(own, request, |_: Empty| async { sensorsim.get_loaded_scenes().await }).await
        }
        Some("get_available_cameras") => {
            unary(own, request, |asked| async { sensorsim.get_available_cameras(asked).await })
                .await
        }
        Some("get_available_trajectories") => {
            unary(own, request, |asked| async { sensorsim.get_available_trajectories(asked).await })
                .await
        }
        Some("get_available_ego_masks") => {
            unary(own, request, |_: Empty| async { sensorsim.get_available_ego_masks().await })
                .await
        }
        Some("render_rgb") => {
            unary(own, request, |asked| async { sensorsim.render_rgb(asked).await }).await
        }
        Some("batch_render_rgb") => {
            unary(own, request, |asked| async { sensorsim.batch_render_rgb(asked).await }).await
        }
        Some("render_aggregated") => {
            unary(own, request, |asked| async { sensorsim.render_aggregated(asked).await }).await
        }
        Some("render_lidar") => {
            unary(own, request, |asked| async { sensorsim.render_lidar(asked).await }).await
        }
        _ => unimplemented(&path),
    }
}

/// Calls a method of AlpaSim's physics. Its scenes and its version are those of the renderer.
async fn call_physics(
    sensorsim: &Sensorsim,
    own: &Arc<Connection>,
    method: &str,
    path: &str,
    request: http::Request<hyper::body::Incoming>,
) -> http::Response<tonic::body::Body> {
    match method {
        "get_version" => unary(own, request, |_: Empty| async { sensorsim.get_version() }).await,
        "get_available_scenes" => {
            unary(own, request, |_: Empty| async { sensorsim.get_available_scenes().await }).await
        }
        "ground_intersection" => {
            unary(own, request, |asked| async { sensorsim.ground_intersection(asked).await }).await
        }
        _ => unimplemented(path),
    }
}
