//! Turns: how many long simulations run at once, how many records are read whole, how many
//! scenarios are resolved, and the overlays of how many rigs are decoded.

use std::sync::Arc;
use std::thread::available_parallelism;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, timeout_at};

use crate::error::SessionError;
use crate::limits;

/// A turn, until it is dropped.
#[derive(Debug)]
pub(crate) struct Turn {
    _permit: OwnedSemaphorePermit,
}

/// The turns of all sessions. The one that waits longest is next.
#[derive(Debug)]
pub(crate) struct Turns {
    simulations: Arc<Semaphore>,
    records: Arc<Semaphore>,
    overlays: Arc<Semaphore>,
    scenarios: Arc<Semaphore>,
}

impl Turns {
    pub(crate) fn new() -> Self {
        // Half of the processors: the rest renders and answers. A machine that does not say how
        // many it has counts as one with two.
        let processors = available_parallelism().map_or(2, usize::from);
        Self {
            simulations: Arc::new(Semaphore::new((processors / 2).max(1))),
            records: Arc::new(Semaphore::new(limits::RECORDS_AT_ONCE)),
            overlays: Arc::new(Semaphore::new(limits::OVERLAYS_AT_ONCE)),
            scenarios: Arc::new(Semaphore::new((processors / 2).max(limits::SCENARIOS_AT_ONCE))),
        }
    }

    /// # Errors
    /// [`SessionError::DeadlineExceeded`].
    pub(crate) async fn simulation(&self, deadline: Instant) -> Result<Turn, SessionError> {
        turn(&self.simulations, deadline).await
    }

    /// # Errors
    /// [`SessionError::DeadlineExceeded`].
    pub(crate) async fn overlay(&self, deadline: Instant) -> Result<Turn, SessionError> {
        turn(&self.overlays, deadline).await
    }

    /// # Errors
    /// [`SessionError::DeadlineExceeded`].
    pub(crate) async fn scenario(&self, deadline: Instant) -> Result<Turn, SessionError> {
        turn(&self.scenarios, deadline).await
    }

    /// # Errors
    /// [`SessionError::DeadlineExceeded`].
    pub(crate) async fn record(&self, deadline: Instant) -> Result<Turn, SessionError> {
        turn(&self.records, deadline).await
    }
}

async fn turn(turns: &Arc<Semaphore>, deadline: Instant) -> Result<Turn, SessionError> {
    match timeout_at(deadline, turns.clone().acquire_owned()).await {
        Ok(Ok(permit)) => Ok(Turn { _permit: permit }),
        // The semaphore is never closed.
        Ok(Err(_)) | Err(_) => Err(SessionError::DeadlineExceeded),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[tokio::test]
    async fn a_turn_ends_when_it_is_dropped() {
        let turns = Turns::new();
        let soon = || Instant::now() + Duration::from_millis(10);
        let mut held = Vec::new();
        for _ in 0..limits::RECORDS_AT_ONCE {
            held.push(turns.record(soon()).await.unwrap());
        }
        assert!(turns.record(soon()).await.is_err(), "all turns are taken");
        held.pop();
        turns.record(soon()).await.unwrap();
    }
}
