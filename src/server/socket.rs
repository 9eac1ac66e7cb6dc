//! WebSocket messages, with a time-out on every wait.

use std::io::{self, IoSlice};
use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::error::{CapacityError, ProtocolError};
use tokio_tungstenite::tungstenite::protocol::{Role, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Error, Message};

use crate::limits;

use super::fault::Fault;

/// A client's WebSocket.
pub(super) struct Socket {
    stream: WebSocketStream<TcpStream>,
    send_timeout: Duration,
}

/// What arrived.
pub(super) enum Incoming {
    /// A text message.
    Text(String),
    /// Something that is no request but shows that the client lives.
    SignOfLife,
}

/// Why nothing more will arrive, or can be sent.
#[derive(Debug)]
pub(super) enum Lost {
    /// The client left, or the network between.
    Gone,
    /// The client does not read. A part of a message may be sent: nothing else can be.
    Stuck,
    /// The client did something that it must be told about, and that may end its connection.
    Fault(Fault),
}

impl Socket {
    /// Takes a connection over from HTTP, with what HTTP read of it already.
    pub(super) async fn new(
        stream: TcpStream,
        read_ahead: Vec<u8>,
        send_timeout: Duration,
    ) -> Self {
        let limits = WebSocketConfig::default()
            .max_message_size(Some(wildcity_protocol::limits::INBOUND_MESSAGE_BYTES))
            .max_frame_size(Some(wildcity_protocol::limits::INBOUND_MESSAGE_BYTES))
            // Requests are short, and 1,000 connections hold a buffer each.
            .read_buffer_size(4 << 10)
            // Answers pass it by: only pongs and the goodbye go through it.
            .write_buffer_size(0)
            .max_write_buffer_size(limits::PONGS_BYTES);
        let (role, limits) = (Role::Server, Some(limits));
        let stream = WebSocketStream::from_partially_read(stream, read_ahead, role, limits).await;
        Self { stream, send_timeout }
    }

    /// Waits for the next message. Dropping the future loses no request.
    pub(super) async fn receive(&mut self) -> Result<Incoming, Lost> {
        match self.stream.next().await {
            Some(Ok(Message::Text(text))) => Ok(Incoming::Text(text.as_str().to_owned())),
            Some(Ok(Message::Binary(_))) => Err(Lost::Fault(Fault::UnexpectedBinary)),
            // Its pong must leave before more is read: who pings and never reads is no sign of life.
            Some(Ok(Message::Ping(_))) => {
                match timeout(self.send_timeout, self.stream.flush()).await {
                    Ok(Ok(())) => Ok(Incoming::SignOfLife),
                    Ok(Err(_)) => Err(Lost::Gone),
                    Err(_) => Err(Lost::Stuck),
                }
            }
            Some(Ok(Message::Pong(_) | Message::Frame(_))) => Ok(Incoming::SignOfLife),
            None | Some(Ok(Message::Close(_))) => Err(Lost::Gone),
            Some(Err(error)) => Err(match error {
                Error::Capacity(CapacityError::MessageTooLong { size, max_size }) => {
                    Lost::Fault(Fault::MessageTooLarge { bytes: size, limit: max_size })
                }
                // The end of the stream, in a library's words.
                Error::Protocol(ProtocolError::ResetWithoutClosingHandshake) => Lost::Gone,
                Error::Protocol(_) | Error::Utf8(_) | Error::Capacity(_) => {
                    Lost::Fault(Fault::BrokenFrame(error.to_string()))
                }
                _ => Lost::Gone,
            }),
        }
    }

    /// Sends a text message.
    pub(super) async fn send_text(&mut self, text: &str) -> Result<(), Lost> {
        self.send(FINAL_TEXT, text.as_bytes()).await
    }

    /// Sends a binary message.
    pub(super) async fn send_binary(&mut self, payload: &[u8]) -> Result<(), Lost> {
        self.send(FINAL_BINARY, payload).await
    }

    /// Sends a message straight from where it lies: a WebSocket library would copy the megabytes
    /// into its own buffer first. After an error the connection cannot be used.
    async fn send(&mut self, first_byte: u8, payload: &[u8]) -> Result<(), Lost> {
        let send = async {
            // A pong may be waiting; frames must not mix.
            self.stream.flush().await.map_err(io::Error::other)?;
            let header = frame_header(first_byte, payload.len());
            let stream = self.stream.get_mut();
            let parts = [IoSlice::new(&header), IoSlice::new(payload)];
            let written = stream.write_vectored(&parts).await?;
            if let Some(rest) = header.get(written..) {
                stream.write_all(rest).await?;
            }
            stream.write_all(&payload[written.saturating_sub(header.len())..]).await
        };
        match timeout(self.send_timeout, send).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err(Lost::Gone),
            Err(_) => Err(Lost::Stuck),
        }
    }

    /// Says goodbye, and reads for a while what the client still sends: closing a socket with
    /// unread bytes resets the connection, and the client would never see the last answer.
    pub(super) async fn close(mut self) {
        let goodbye = async {
            self.stream.close(None).await.map_err(io::Error::other)?;
            let mut stream = self.stream.into_inner();
            stream.shutdown().await?;
            let mut thrown_away = vec![0; 64 << 10];
            while stream.read(&mut thrown_away).await? > 0 {}
            io::Result::Ok(())
        };
        // Whether the client heard it does not matter.
        let _ = timeout(limits::LINGER, goodbye).await;
    }
}

/// First bytes of frames that are whole messages (RFC 6455, section 5.2).
const FINAL_TEXT: u8 = 0x81;
const FINAL_BINARY: u8 = 0x82;

/// The header of an unmasked frame (RFC 6455, section 5.2).
fn frame_header(first_byte: u8, len: usize) -> Vec<u8> {
    let mut header = vec![first_byte];
    match len {
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

    #[test]
    fn frame_headers_of_every_length() {
        assert_eq!(frame_header(FINAL_BINARY, 125), [0x82, 125]);
        assert_eq!(frame_header(FINAL_TEXT, 0), [0x81, 0]);
        assert_eq!(frame_header(FINAL_BINARY, 126), [0x82, 126, 0, 126]);
        assert_eq!(frame_header(FINAL_BINARY, 0xFFFF), [0x82, 126, 0xFF, 0xFF]);
        assert_eq!(frame_header(FINAL_BINARY, 0x1_0000), [0x82, 127, 0, 0, 0, 0, 0, 1, 0, 0]);
    }
}
