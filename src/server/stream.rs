//! A connection, with or without TLS.

use std::io::{self, IoSlice};
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::tls::Tls;
use crate::unfinished::OwnUnfinished;

/// A connection: the bytes of a socket, of TLS, or of a simulated network.
pub(crate) struct Stream {
    bytes: Box<dyn ByteStream>,
    same_machine: Result<(), &'static str>,
    /// What was received of a WebSocket message; `None` while the connection is one of HTTP.
    unfinished: Option<OwnUnfinished>,
}

/// Bytes in both directions.
pub(crate) trait ByteStream: AsyncRead + AsyncWrite + Unpin + Send {}

impl<T: AsyncRead + AsyncWrite + Unpin + Send> ByteStream for T {}

impl Stream {
    /// A connection over these bytes; `same_machine` is an error with the reason if the other end
    /// is not on this machine, or if this is unknown.
    pub(crate) fn new(
        bytes: impl ByteStream + 'static,
        same_machine: Result<(), &'static str>,
    ) -> Self {
        Self { bytes: Box::new(bytes), same_machine, unfinished: None }
    }

    /// The stream of a new connection; none if its handshake of TLS fails or takes too long.
    pub(crate) async fn accept(tcp: TcpStream, tls: Option<&Tls>, limit: Duration) -> Option<Self> {
        let Some(tls) = tls else {
            let same_machine = match tcp.peer_addr() {
                // A loopback address may still be the end of a tunnel; the proof of the shared
                // memory decides.
                Ok(peer) if peer.ip().to_canonical().is_loopback() => Ok(()),
                _ => Err("the client is not connected through the loopback interface"),
            };
            return Some(Self::new(tcp, same_machine));
        };
        // A client that begins no handshake would hold its slot for ever.
        match timeout(limit, tls.accept(tcp)).await {
            Ok(Ok(stream)) => {
                let reason = "the connection has TLS, and may come through another machine";
                Some(Self::new(stream, Err(reason)))
            }
            Ok(Err(error)) => {
                tracing::debug!("a TLS handshake failed: {error}");
                None
            }
            Err(_) => None,
        }
    }

    /// Counts what is received from now on as that of WebSocket messages.
    pub(crate) fn count_messages(&mut self, unfinished: OwnUnfinished) {
        self.unfinished = Some(unfinished);
    }

    /// Counts nothing any more: what is received is discarded.
    pub(crate) fn stop_counting(&mut self) {
        self.unfinished = None;
    }

    /// What was received of a message that has not ended.
    pub(crate) fn unfinished(&mut self) -> Option<&mut OwnUnfinished> {
        self.unfinished.as_mut()
    }

    /// Whether the other end is on this machine. An error has the reason if it is not, or if this
    /// is unknown.
    pub(crate) fn same_machine(&self) -> Result<(), &'static str> {
        self.same_machine
    }
}

impl AsyncRead for Stream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        ready!(Pin::new(&mut self.bytes).poll_read(cx, buffer))?;
        let received = buffer.filled().len() - before;
        let counted = self.unfinished.as_mut().map(|unfinished| unfinished.received(received));
        Poll::Ready(counted.unwrap_or(Ok(())))
    }
}

impl AsyncWrite for Stream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.bytes).poll_write(cx, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.bytes).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.bytes).poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        parts: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.bytes).poll_write_vectored(cx, parts)
    }

    fn is_write_vectored(&self) -> bool {
        // Passed on, because the default is no, and hyper would then copy the parts of an answer
        // together.
        self.bytes.is_write_vectored()
    }
}
