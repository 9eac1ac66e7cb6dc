//! The client's end of a connection that is cut at a byte.

use std::io::{self, ErrorKind};
use std::pin::Pin;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, DuplexStream, ReadBuf};

/// When a connection is cut, in bytes of one direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Cut {
    Never,
    /// After this number of bytes to the server.
    Sent(u64),
    /// After this number of bytes from the server.
    Received(u64),
}

/// A connection that is cut.
pub(super) struct CutStream {
    stream: DuplexStream,
    cut: Cut,
}

impl CutStream {
    pub(super) fn new(stream: DuplexStream, cut: Cut) -> Self {
        Self { stream, cut }
    }

    /// The end that no client uses any more. Until it is dropped, the server is not notified of the
    /// cut.
    pub(super) fn into_unclosed(self) -> DuplexStream {
        self.stream
    }
}

/// Number of the next `bytes` bytes that pass before the cut.
fn passing(left: Option<u64>, bytes: usize) -> usize {
    left.map_or(bytes, |left| usize::try_from(left).unwrap_or(bytes).min(bytes))
}

impl AsyncRead for CutStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let left = match self.cut {
            Cut::Received(left) => Some(left),
            Cut::Never | Cut::Sent(_) => None,
        };
        if left == Some(0) {
            return Poll::Ready(Err(ErrorKind::ConnectionReset.into()));
        }
        let mut bytes = vec![0; passing(left, buffer.remaining().min(4096))];
        let mut part = ReadBuf::new(&mut bytes);
        let read = Pin::new(&mut self.stream).poll_read(cx, &mut part);
        let filled = part.filled();
        buffer.put_slice(filled);
        if let Some(left) = left {
            self.cut = Cut::Received(left - filled.len() as u64);
        }
        read
    }
}

impl AsyncWrite for CutStream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let left = match self.cut {
            Cut::Sent(left) => Some(left),
            Cut::Never | Cut::Received(_) => None,
        };
        if left == Some(0) {
            return Poll::Ready(Err(ErrorKind::BrokenPipe.into()));
        }
        let passing = passing(left, bytes.len());
        let written = Pin::new(&mut self.stream).poll_write(cx, &bytes[..passing]);
        if let (Some(left), Poll::Ready(Ok(bytes))) = (left, &written) {
            self.cut = Cut::Sent(left - *bytes as u64);
        }
        written
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}
