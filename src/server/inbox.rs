//! The messages of a client, which are read even while its last request is carried out.
//!
//! A request may take a minute. Meanwhile, a client that sends a ping, to check the server, gets
//! its pong at once, and a client that closes the connection gets its Close frame. A request that
//! arrives too early waits in the inbox.

use std::collections::VecDeque;
use std::pin::pin;

use crate::limits;
use crate::socket::{Disconnect, Incoming, Socket};

/// A socket, and the messages that were received too early.
pub(crate) struct Inbox {
    pub(crate) socket: Socket,
    /// Messages that were received while a request was carried out, in order.
    early: VecDeque<Result<Incoming, Disconnect>>,
    early_bytes: usize,
    /// Whether nothing more will be received.
    ended: bool,
}

impl Inbox {
    pub(crate) fn new(socket: Socket) -> Self {
        Self { socket, early: VecDeque::new(), early_bytes: 0, ended: false }
    }

    /// Waits for the next message. Dropping the future loses no message.
    pub(crate) async fn next(&mut self) -> Result<Incoming, Disconnect> {
        // In order of arrival: the socket is read only when nothing waits.
        let Some(early) = self.early.pop_front() else { return self.socket.receive().await };
        if let Ok(Incoming::Text(text)) = &early {
            self.early_bytes -= text.len();
        }
        early
    }

    /// Whether a part of a message has arrived, of which the rest has not.
    pub(crate) fn is_within_message(&mut self) -> bool {
        self.socket.is_within_message()
    }

    /// Carries out a request, and keeps the messages that are received meanwhile. If a client sends
    /// too many messages ahead, no more are read until the request is done, so that its pings wait
    /// as well.
    pub(crate) async fn during<T>(&mut self, request: impl Future<Output = T>) -> T {
        let mut request = pin!(request);
        loop {
            let has_room = self.early.len() < limits::EARLY_MESSAGES
                && self.early_bytes < wildcity_protocol::limits::INBOUND_MESSAGE_BYTES;
            // Without reading, TCP's window fills, and the client has to wait.
            if self.ended || !has_room {
                return request.await;
            }
            tokio::select! {
                // The request first: when it is done, nothing more is read, and the next call of
                // `next` gets it.
                biased;
                done = &mut request => return done,
                received = self.socket.receive() => self.keep(received),
            }
        }
    }

    fn keep(&mut self, received: Result<Incoming, Disconnect>) {
        match &received {
            // A ping was answered already, and a request that is carried out has no idle deadline
            // to extend.
            Ok(Incoming::Alive) => return,
            Ok(Incoming::Text(text)) => self.early_bytes += text.len(),
            // A mistake in one message is answered in its turn, after the request that runs now.
            Err(Disconnect::Fault(fault)) if !fault.is_fatal() => {}
            Err(_) => self.ended = true,
        }
        self.early.push_back(received);
    }
}
