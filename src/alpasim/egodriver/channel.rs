//! HTTP/2 to a driver.

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use hyper::client::conn::http2::{self, SendRequest};
use hyper_util::rt::{TokioExecutor, TokioIo};
use tokio::net::TcpStream;
use tokio::time::{Instant, sleep};
use tonic::body::Body;

/// Time between two attempts to connect.
const RETRY: Duration = Duration::from_millis(200);

/// A connection to a driver. Clones share it.
#[derive(Clone)]
pub(super) struct Channel(SendRequest<Body>);

type Sent = Result<http::Response<hyper::body::Incoming>, hyper::Error>;

impl Channel {
    /// Connects to `HOST:PORT`, and tries again until `max_wait` is over: a driver that loads a
    /// network starts to listen late.
    ///
    /// # Errors
    /// The last reason.
    pub(super) async fn connect(address: &str, max_wait: Duration) -> Result<Self, String> {
        let deadline = Instant::now() + max_wait;
        loop {
            match Self::try_connect(address).await {
                Ok(channel) => return Ok(channel),
                Err(reason) if Instant::now() + RETRY > deadline => return Err(reason),
                Err(_) => sleep(RETRY).await,
            }
        }
    }

    async fn try_connect(address: &str) -> Result<Self, String> {
        let stream = TcpStream::connect(address).await.map_err(|error| error.to_string())?;
        // Calls and answers alternate, so that Nagle's algorithm would delay each of them.
        stream.set_nodelay(true).map_err(|error| error.to_string())?;
        let handshake = http2::handshake(TokioExecutor::new(), TokioIo::new(stream)).await;
        let (sender, connection) = handshake.map_err(|error| error.to_string())?;
        // The task ends when the last clone of the sender is dropped, or the driver disconnects,
        // after which calls fail.
        tokio::spawn(connection);
        Ok(Self(sender))
    }
}

impl tower_service::Service<http::Request<Body>> for Channel {
    type Response = http::Response<hyper::body::Incoming>;
    type Error = hyper::Error;
    type Future = Pin<Box<dyn Future<Output = Sent> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), hyper::Error>> {
        self.0.poll_ready(context)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        Box::pin(self.0.send_request(request))
    }
}
