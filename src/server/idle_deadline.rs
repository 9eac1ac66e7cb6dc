//! A deadline that is extended whenever a request makes progress.

use std::pin::pin;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::time::{Instant, timeout};

/// The time by which an HTTP connection must make progress with a request or its answer; otherwise
/// it is closed. It does not apply to a connection that has become a WebSocket.
pub(crate) struct IdleDeadline {
    deadline: Mutex<Instant>,
    period: Duration,
}

impl IdleDeadline {
    /// A deadline one period from now.
    pub(crate) fn new(period: Duration) -> Self {
        Self { deadline: Mutex::new(Instant::now() + period), period }
    }

    /// Moves the deadline to one period from now: the request makes progress.
    pub(crate) fn extend(&self) {
        *self.deadline.lock() = Instant::now() + self.period;
    }

    /// Runs work of the server that the client waits for. The deadline is extended meanwhile,
    /// because the delay is not caused by the client.
    pub(crate) async fn extend_during<T>(&self, work: impl Future<Output = T>) -> T {
        let mut work = pin!(work);
        loop {
            // Twice in each period, so that the deadline never passes while the work runs.
            self.extend();
            if let Ok(done) = timeout(self.period / 2, &mut work).await {
                self.extend();
                return done;
            }
        }
    }

    /// Returns when the deadline has passed.
    pub(crate) async fn passed(&self) {
        loop {
            let deadline = *self.deadline.lock();
            // The deadline may have moved while this slept. A request that makes progress costs no
            // wake-up: only the end of the old deadline does.
            if deadline <= Instant::now() {
                return;
            }
            tokio::time::sleep_until(deadline).await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_client_is_not_cut_off_while_it_waits_for_the_server() {
        // The work takes three periods of silence.
        let deadline = IdleDeadline::new(Duration::from_millis(400));
        tokio::select! {
            biased;
            () = deadline.passed() => panic!("cut off while the server worked"),
            () = deadline.extend_during(tokio::time::sleep(Duration::from_millis(1200))) => {}
        }
        // The client's own silence still ends the connection.
        let silent = timeout(Duration::from_secs(10), deadline.passed());
        silent.await.expect("the deadline passes");
    }
}
