//! WebSocket messages, with a time-out on every wait.

use std::io::{self, IoSlice};
use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::error::{CapacityError, ProtocolError};
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{Role, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Error, Message};

use crate::fault::{CloseStatus, Fault};
use crate::limits;
use crate::stream::Stream;
use crate::unfinished::OwnUnfinished;

pub(crate) struct Socket {
    stream: WebSocketStream<Stream>,
    send_timeout: Duration,
    /// Status of the client's Close frame, after which it reads nothing.
    peer_closed: Option<CloseCode>,
    /// Whether a frame was begun and not ended. If that was given up, nothing can follow it.
    is_within_frame: bool,
}

/// A message that arrived.
pub(crate) enum Incoming {
    Text(String),
    /// A ping, a pong or a part of a message: no request, but the client is alive.
    Alive,
}

/// Why no more messages can be received or sent.
#[derive(Debug)]
pub(crate) enum Disconnect {
    /// The client closed the connection, or the network failed. It may come back.
    PeerLeft,
    /// The client closed the connection as one that goes away (status 1001), as a browser does when
    /// its page is left: it does not come back.
    PeerGone,
    /// The client did not read in time. A part of a message may have been sent, so that nothing
    /// else can be sent.
    SendTimedOut,
    /// The client made a mistake. It gets an answer, and the connection may end.
    Fault(Fault),
}

impl Socket {
    /// Takes over a connection from HTTP; `read_ahead` has the bytes that HTTP has already read
    /// from it. Messages that are not whole yet count among `unfinished`.
    pub(crate) async fn new(
        mut stream: Stream,
        read_ahead: Vec<u8>,
        send_timeout: Duration,
        unfinished: OwnUnfinished,
    ) -> Self {
        stream.count_messages(unfinished);
        let config = WebSocketConfig::default()
            .max_message_size(Some(wildcity_protocol::limits::INBOUND_MESSAGE_BYTES))
            .max_frame_size(Some(wildcity_protocol::limits::INBOUND_MESSAGE_BYTES))
            // Requests are short, and each of 1,000 connections has a buffer.
            .read_buffer_size(4 << 10)
            // Answers bypass this buffer: only pongs and the close frame go through it.
            .write_buffer_size(0)
            .max_write_buffer_size(limits::PONGS_BYTES);
        let stream =
            WebSocketStream::from_partially_read(stream, read_ahead, Role::Server, Some(config));
        Self { stream: stream.await, send_timeout, peer_closed: None, is_within_frame: false }
    }

    /// Whether the other end is on this machine; if not, why.
    pub(crate) fn same_machine(&self) -> Result<(), &'static str> {
        self.stream.get_ref().same_machine()
    }

    /// Whether a part of a message has arrived.
    pub(crate) fn is_within_message(&mut self) -> bool {
        self.stream.get_mut().unfinished().is_some_and(|own| own.is_within_message())
    }

    /// Waits for the next message. Dropping the future loses no request.
    pub(crate) async fn receive(&mut self) -> Result<Incoming, Disconnect> {
        let received = self.stream.next().await;
        if let (Some(Ok(message)), Some(own)) = (&received, self.stream.get_mut().unfinished()) {
            match message {
                Message::Ping(payload) | Message::Pong(payload) => own.control_frame(payload.len()),
                _ => own.message_ended(),
            }
        }
        match received {
            Some(Ok(Message::Text(text))) => Ok(Incoming::Text(text.as_str().to_owned())),
            Some(Ok(Message::Binary(_))) => Err(Disconnect::Fault(Fault::UnexpectedBinary)),
            // The pong is sent before more is read: a client that pings and never reads is not
            // alive.
            Some(Ok(Message::Ping(_))) => self.flush().await.map(|()| Incoming::Alive),
            Some(Ok(Message::Pong(_) | Message::Frame(_))) => Ok(Incoming::Alive),
            // tungstenite has prepared the Close frame that answers it (RFC 6455, section 5.5.1).
            Some(Ok(Message::Close(frame))) => {
                self.peer_closed = Some(frame.map_or(CloseCode::Status, |frame| frame.code));
                self.flush().await.and(Err(self.left()))
            }
            // The end of the stream, and any error of the network: there is no peer to tell.
            None => Err(self.left()),
            Some(Err(error)) => Err(match error {
                Error::Capacity(CapacityError::MessageTooLong { size, max_size }) => {
                    Disconnect::Fault(Fault::MessageTooLarge { bytes: size, limit: max_size })
                }
                // tungstenite's name for the end of the TCP stream.
                Error::Protocol(ProtocolError::ResetWithoutClosingHandshake) => {
                    Disconnect::PeerLeft
                }
                Error::Utf8(_) => Disconnect::Fault(Fault::NotUtf8),
                Error::Io(error) if error.kind() == io::ErrorKind::QuotaExceeded => {
                    Disconnect::Fault(Fault::Unfinished)
                }
                Error::Protocol(_) | Error::Capacity(_) => {
                    Disconnect::Fault(Fault::BrokenFrame(error.to_string()))
                }
                _ => Disconnect::PeerLeft,
            }),
        }
    }

    /// Sends what tungstenite has prepared: pongs, and the answer to a Close frame.
    async fn flush(&mut self) -> Result<(), Disconnect> {
        match timeout(self.send_timeout, self.stream.flush()).await {
            // After the answer to a Close frame there is nothing more to send.
            Ok(Ok(()) | Err(Error::ConnectionClosed)) => Ok(()),
            Ok(Err(_)) => Err(self.left()),
            Err(_) => Err(Disconnect::SendTimedOut),
        }
    }

    /// How the client left.
    fn left(&self) -> Disconnect {
        match self.peer_closed {
            Some(CloseCode::Away) => Disconnect::PeerGone,
            _ => Disconnect::PeerLeft,
        }
    }

    /// Sends a text message.
    pub(crate) async fn send_text(&mut self, text: &str) -> Result<(), Disconnect> {
        self.send(FINAL_TEXT, &[text.as_bytes()]).await
    }

    /// Sends a binary message of these parts.
    pub(crate) async fn send_binary(&mut self, parts: &[&[u8]]) -> Result<(), Disconnect> {
        self.send(FINAL_BINARY, parts).await
    }

    /// Sends a message from the caller's memory. tungstenite would copy an observation of megabytes
    /// into its own buffer first. After an error the connection cannot be used.
    async fn send(&mut self, first_byte: u8, payload: &[&[u8]]) -> Result<(), Disconnect> {
        // After either, a frame would be read as something else, or not at all.
        if self.peer_closed.is_some() || self.is_within_frame {
            return Err(self.left());
        }
        // Set before the first byte: if this future is dropped at any point, the mark stays.
        self.is_within_frame = true;
        let send = async {
            // A pong may still be in the library's buffer; it must be sent whole before this frame
            // begins.
            self.stream.flush().await.map_err(io::Error::other)?;
            let header = frame_header(first_byte, payload.iter().map(|part| part.len()).sum());
            let stream = self.stream.get_mut();
            let all = std::iter::once(&*header).chain(payload.iter().copied());
            let mut all: Vec<IoSlice<'_>> = all.map(IoSlice::new).collect();
            let mut rest = &mut all[..];
            // One system call for header and parts, as a rule; a full socket takes a part and
            // continues.
            while !rest.is_empty() {
                let written = stream.write_vectored(rest).await?;
                if written == 0 {
                    return Err(io::ErrorKind::WriteZero.into());
                }
                IoSlice::advance_slices(&mut rest, written);
            }
            io::Result::Ok(())
        };
        match timeout(self.send_timeout, send).await {
            Ok(Ok(())) => {
                self.is_within_frame = false;
                Ok(())
            }
            Ok(Err(_)) => {
                self.read_close().await;
                Err(self.left())
            }
            Err(_) => Err(Disconnect::SendTimedOut),
        }
    }

    /// Reads to the client's Close frame, which may have come before the connection ended. Nothing
    /// is read while something is sent.
    async fn read_close(&mut self) {
        self.stream.get_mut().stop_counting();
        let read = async {
            while let Some(Ok(message)) = self.stream.next().await {
                if let Message::Close(frame) = message {
                    return Some(frame.map_or(CloseCode::Status, |frame| frame.code));
                }
            }
            None
        };
        let found = timeout(limits::LINGER, read).await;
        self.peer_closed = self.peer_closed.or(found.unwrap_or_default());
    }

    /// Closes the connection, with a Close frame of this status unless the client has closed it
    /// already.
    ///
    /// Bytes that the client still sends are read for a while: closing a socket with unread bytes
    /// resets the connection, and the client would never see the last answer. Its own Close frame
    /// is among these bytes.
    pub(crate) async fn close(mut self, status: Option<CloseStatus>) {
        let closing = async {
            if let Some(CloseStatus { code, reason }) = status {
                let payload = [&code.to_be_bytes(), reason.as_bytes()].concat();
                // Sending fails if the client has left, or has sent its own Close frame.
                let _ = self.send(FINAL_CLOSE, &[&payload]).await;
            }
            let mut stream = self.stream.into_inner();
            stream.stop_counting();
            // The client reads the end of the stream after the last message, while its own bytes
            // are still read.
            stream.shutdown().await?;
            let mut discarded = vec![0; 64 << 10];
            while stream.read(&mut discarded).await? > 0 {}
            io::Result::Ok(())
        };
        // It does not matter whether the client took part in the closing handshake.
        let _ = timeout(limits::LINGER, closing).await;
    }
}

/// First bytes of frames that are whole messages (RFC 6455, section 5.2).
const FINAL_TEXT: u8 = 0x81;
const FINAL_BINARY: u8 = 0x82;
const FINAL_CLOSE: u8 = 0x88;

/// The header of an unmasked frame (RFC 6455, section 5.2): the length takes 7, 16 or 64 bits.
fn frame_header(first_byte: u8, len: usize) -> Vec<u8> {
    let mut header = vec![first_byte];
    match len {
        // 126 and 127 announce longer lengths. The match arms bound each cast.
        0..=125 => header.push(len as u8),
        126..=0xFFFF => {
            header.push(126);
            header.extend((len as u16).to_be_bytes());
        }
        _ => {
            header.push(127);
            header.extend((len as u64).to_be_bytes());
        }
    }
    header
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A server that stops while a watcher reads slowly must not put its Close frame into an
    /// observation.
    #[tokio::test]
    async fn no_frame_begins_within_another() {
        // The pipe holds 64 bytes: the header of 4 bytes and 60 of the payload are sent when the
        // sender gives up.
        let (mut client, server) = tokio::io::duplex(64);
        let stream = Stream::new(server, Err("a test"));
        let timeout_s = Duration::from_secs(5);
        let unfinished = OwnUnfinished::new(Default::default(), String::new());
        let mut socket = Socket::new(stream, Vec::new(), timeout_s, unfinished).await;
        let payload = [7; 1000];
        let given_up = timeout(Duration::from_millis(20), socket.send_binary(&[&payload])).await;
        assert!(given_up.is_err(), "it does not fit");
        let closing =
            tokio::spawn(socket.close(Some(CloseStatus { code: 1001, reason: "x".into() })));
        let mut sent = Vec::new();
        client.read_to_end(&mut sent).await.unwrap();
        assert_eq!(sent, [&[FINAL_BINARY, 126, 3, 232][..], &[7; 60]].concat());
        drop(client);
        closing.await.unwrap();
    }

    #[test]
    fn frame_headers_of_every_length() {
        // Both sides of each border between 7, 16 and 64 bits.
        assert_eq!(frame_header(FINAL_BINARY, 125), [0x82, 125]);
        assert_eq!(frame_header(FINAL_TEXT, 0), [0x81, 0]);
        assert_eq!(frame_header(FINAL_BINARY, 126), [0x82, 126, 0, 126]);
        assert_eq!(frame_header(FINAL_BINARY, 0xFFFF), [0x82, 126, 0xFF, 0xFF]);
        assert_eq!(frame_header(FINAL_BINARY, 0x1_0000), [0x82, 127, 0, 0, 0, 0, 0, 1, 0, 0]);
    }
}
