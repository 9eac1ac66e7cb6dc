//! Clients that look at a session without taking part in it.
//!
//! A session publishes its newest observation in a cell that holds one. Without watchers nothing is
//! stored, and a slow watcher misses observations, so that the session never waits.

use std::sync::{Arc, Weak};

use tokio::sync::watch;
use tokio::time::{Instant, sleep_until};

use wildcity_session::Observation;

use crate::fault::Fault;
use crate::limits;
use crate::socket::{Disconnect, Incoming, Socket};

type Cell = watch::Sender<Option<Arc<Observation>>>;

/// Where a session puts its newest observation.
#[derive(Clone)]
pub(crate) struct Newest(Arc<Cell>);

/// The end at which a watcher waits for observations.
pub(crate) struct Watch {
    receiver: watch::Receiver<Option<Arc<Observation>>>,
    /// Weak, so that the end of the session is noticed.
    cell: Weak<Cell>,
}

impl Newest {
    pub(crate) fn new() -> Self {
        Self(Arc::new(watch::channel(None).0))
    }

    /// Sends an observation to the watchers, if there are any.
    pub(crate) fn show(&self, observation: &Arc<Observation>) {
        if self.0.receiver_count() > 0 {
            // Replaced and not queued: a watcher that is slow sees the newest one, and the memory
            // of one observation is held.
            self.0.send_replace(Some(observation.clone()));
        }
    }

    pub(crate) fn watch(&self) -> Watch {
        Watch { receiver: self.0.subscribe(), cell: Arc::downgrade(&self.0) }
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        // The last watcher takes the observation with it.
        if let Some(cell) = self.cell.upgrade()
            && cell.receiver_count() == 1
        {
            cell.send_replace(None);
        }
    }
}

/// Sends a session's observations to a watcher, until the session or the watcher ends, or the
/// server (`stopped`).
pub(crate) async fn serve(stopped: impl Future<Output = ()>, mut socket: Socket, mut watch: Watch) {
    let reason = tokio::select! {
        reason = send_all(&mut socket, &mut watch) => reason,
        () = stopped => Disconnect::Fault(Fault::ShuttingDown),
    };
    // The observation is released before the socket lingers.
    drop(watch);
    match reason {
        Disconnect::Fault(fault) => {
            socket.close(Some(fault.close_status())).await;
        }
        Disconnect::PeerLeft | Disconnect::PeerGone => socket.close(None).await,
        Disconnect::SendTimedOut => {}
    }
}

async fn send_all(socket: &mut Socket, watch: &mut Watch) -> Disconnect {
    let mut next = Instant::now();
    loop {
        // The wait comes before the look, so that what is sent is the newest at that moment.
        let changed = async {
            sleep_until(next).await;
            watch.receiver.changed().await
        };
        tokio::select! {
            changed = changed => {
                if changed.is_err() {
                    return Disconnect::Fault(Fault::SessionEnded);
                }
                // Cloned, because a borrow would hold up the session until the watcher has read.
                let newest = watch.receiver.borrow_and_update().clone();
                let Some(observation) = newest else { continue };
                if let Err(reason) = socket.send_binary(&[observation.buffer.bytes()]).await {
                    return reason;
                }
                next = Instant::now() + limits::WATCH_PERIOD;
            }
            received = socket.receive() => match received {
                Ok(Incoming::Alive) => {}
                Ok(Incoming::Text(_)) => return Disconnect::Fault(Fault::WatcherSent),
                Err(reason) => return reason,
            },
        }
    }
}
