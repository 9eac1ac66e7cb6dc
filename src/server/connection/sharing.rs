//! Sharing memory with a client on the same machine, and messages in that memory.

use super::Connection;
use crate::convert;
use crate::fault::Fault;
use crate::memory::SharedMemory;
use crate::sessions::Answer;

impl Connection {
    /// Creates memory for the client, and returns its location.
    pub(super) fn offer_memory(&mut self, seq: u64) -> Result<Answer, Fault> {
        let unavailable = |reason: &str| {
            let reason = format!("{reason}; connect without it");
            Err(Fault::NoSharedMemory { field: "type", reason })
        };
        // The reasons that the client cannot change come first.
        if !self.state.shares_memory {
            return unavailable("the server was started with --no-shared-memory");
        }
        if let Err(reason) = self.same_machine {
            return unavailable(reason);
        }
        if self.memory.as_ref().is_some_and(SharedMemory::is_open) {
            return Err(Fault::SessionState("this connection shares memory already"));
        }
        if !self.slots.is_empty() {
            return Err(Fault::SessionState("share_memory comes before open and resume"));
        }
        // An offer that was not opened is replaced, and its memory freed.
        let memory = SharedMemory::new()?;
        let text = convert::shared_memory(seq, &memory)?;
        self.memory = Some(memory);
        Ok(Answer::Text(text.into()))
    }

    /// Begins to use the memory that was offered.
    pub(super) fn open_memory(&mut self, seq: u64, proof: &str) -> Result<Answer, Fault> {
        let nothing = Fault::SessionState("no memory was offered; send share_memory without proof");
        self.memory.as_mut().filter(|memory| !memory.is_open()).ok_or(nothing)?.open(proof)?;
        tracing::debug!("shares memory");
        Ok(Answer::Text(convert::ok(seq)?.into()))
    }

    /// Returns the message to send for an answer: with shared memory, the location of a binary
    /// message that was written into it.
    pub(super) async fn delivered(&mut self, seq: u64, answer: Answer) -> Result<Answer, Fault> {
        // Texts stay on the socket: they are short, and say where in the memory the rest is.
        let memory = self.memory.as_mut().filter(|memory| memory.is_open());
        let Some(memory) = memory else { return Ok(answer) };
        if matches!(answer, Answer::Text(_)) {
            return Ok(answer);
        }
        match memory.write(&self.state.engine, &answer).await {
            Ok(place) => {
                self.state.metrics.shared_memory_bytes.inc_by(place.bytes);
                Ok(Answer::Text(convert::in_memory(seq, place)?.into()))
            }
            Err(error) => {
                // The client reads either form, so that a full budget costs time and no step.
                tracing::warn!("no room in shared memory, sent through the socket: {error}");
                Ok(answer)
            }
        }
    }
}
