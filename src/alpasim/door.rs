//! Which connections are open: a bounded number, and none for good without a request.
//!
//! AlpaSim's clients send no tokens, so that connections are told apart by what they do. While all
//! places are taken, the one that has been idle for longest gives its own to the next, first among
//! those that have never sent a request. So silent connections cannot close the door.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Instant;

use parking_lot::Mutex;
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore, TryAcquireError};
use tonic::Status;

use crate::limits;

/// The connections that are open, and the memory of their requests.
#[derive(Debug)]
pub(crate) struct Door {
    begin: Instant,
    open: Mutex<Vec<Arc<Connection>>>,
    most: usize,
    /// Bytes of the requests of all connections.
    bytes: Arc<Semaphore>,
    /// Signalled when a connection ends.
    ended: Notify,
}

/// A connection, as the door knows it.
#[derive(Debug)]
pub(crate) struct Connection {
    begin: Instant,
    /// Requests that are being received or answered.
    running: AtomicUsize,
    /// When the last request ended, or the connection was opened, in milliseconds since `begin`.
    idle_since_ms: AtomicU64,
    has_asked: std::sync::atomic::AtomicBool,
    close: Notify,
    /// Bytes of its own requests, and of all.
    own_bytes: Arc<Semaphore>,
    all_bytes: Arc<Semaphore>,
}

/// A place, until it is dropped.
#[derive(Debug)]
pub(crate) struct Place {
    door: Arc<Door>,
    pub(crate) connection: Arc<Connection>,
}

/// A request that is being received or answered, until it is dropped.
#[derive(Debug)]
pub(crate) struct RunningRequest(Arc<Connection>);

/// The reserved memory of a request, until it is dropped.
#[derive(Debug, Default)]
pub(crate) struct RequestBytes(Vec<OwnedSemaphorePermit>);

impl Door {
    pub(crate) fn new(most: usize) -> Arc<Self> {
        Arc::new(Self {
            begin: Instant::now(),
            open: Mutex::default(),
            most,
            bytes: Arc::new(Semaphore::new(limits::REQUESTS_KIB)),
            ended: Notify::new(),
        })
    }

    /// A place for a new connection; `None` if all others have requests. May close another one.
    pub(crate) fn admit(self: &Arc<Self>) -> Option<Place> {
        let mut open = self.open.lock();
        if open.len() >= self.most {
            let idle = open.iter().enumerate().filter(|(_, other)| !other.is_running());
            let (index, _) = idle.min_by_key(|(_, other)| {
                (
                    other.has_asked.load(Ordering::Relaxed),
                    other.idle_since_ms.load(Ordering::Relaxed),
                )
            })?;
            open.swap_remove(index).close.notify_one();
        }
        let connection = Arc::new(Connection {
            begin: self.begin,
            running: AtomicUsize::new(0),
            idle_since_ms: AtomicU64::new(self.begin.elapsed().as_millis() as u64),
            has_asked: false.into(),
            close: Notify::new(),
            own_bytes: Arc::new(Semaphore::new(limits::CONNECTION_KIB)),
            all_bytes: self.bytes.clone(),
        });
        open.push(connection.clone());
        Some(Place { door: self.clone(), connection })
    }

    /// Waits until no connection is left.
    pub(crate) async fn emptied(&self) {
        loop {
            let ended = self.ended.notified();
            if self.open.lock().is_empty() {
                return;
            }
            ended.await;
        }
    }
}

impl Connection {
    fn is_running(&self) -> bool {
        self.running.load(Ordering::Relaxed) > 0
    }

    /// Notes a request, until the result is dropped.
    pub(crate) fn request(self: &Arc<Self>) -> RunningRequest {
        self.has_asked.store(true, Ordering::Relaxed);
        self.running.fetch_add(1, Ordering::Relaxed);
        RunningRequest(self.clone())
    }

    /// Waits until the connection has to end: its place is needed, or it has sent no request in
    /// [`limits::HELLO`], or has been idle for [`limits::CONNECTION_IDLE`].
    pub(crate) async fn to_close(&self) {
        let silent = async {
            loop {
                let most = if self.has_asked.load(Ordering::Relaxed) {
                    limits::CONNECTION_IDLE
                } else {
                    limits::HELLO
                };
                let since_ms = self.idle_since_ms.load(Ordering::Relaxed);
                let now_ms = self.begin.elapsed().as_millis() as u64;
                let left_ms =
                    (most.as_millis() as u64).saturating_sub(now_ms - since_ms.min(now_ms));
                if left_ms == 0 && !self.is_running() {
                    return;
                }
                tokio::time::sleep(std::time::Duration::from_millis(left_ms.max(100))).await;
            }
        };
        tokio::select! {
            () = self.close.notified() => {}
            () = silent => {}
        }
    }

    /// Reserves memory for more bytes of a request.
    ///
    /// # Errors
    /// `RESOURCE_EXHAUSTED` if this connection has too many unfinished requests, and `UNAVAILABLE`
    /// if all together have.
    pub(crate) fn reserve(&self, bytes: usize) -> Result<RequestBytes, Status> {
        let kib = u32::try_from(bytes.div_ceil(1024)).unwrap_or(u32::MAX);
        let take = |of: &Arc<Semaphore>| of.clone().try_acquire_many_owned(kib);
        let own = take(&self.own_bytes).map_err(|_: TryAcquireError| {
            let most_mb = limits::CONNECTION_KIB >> 10;
            Status::resource_exhausted(format!(
                "the requests of this connection have more than {most_mb} MiB: send fewer at once"
            ))
        })?;
        let all = take(&self.all_bytes)
            .map_err(|_| Status::unavailable("too many requests are being received"))?;
        Ok(RequestBytes(vec![own, all]))
    }
}

impl RequestBytes {
    /// Adds the memory of more bytes.
    pub(crate) fn merge(&mut self, other: Self) {
        for permit in other.0 {
            // Of the same semaphore there is one permit, which grows.
            let same =
                self.0.iter_mut().find(|own| Arc::ptr_eq(own.semaphore(), permit.semaphore()));
            match same {
                Some(own) => own.merge(permit),
                None => self.0.push(permit),
            }
        }
    }
}

impl Drop for RunningRequest {
    fn drop(&mut self) {
        let now_ms = self.0.begin.elapsed().as_millis() as u64;
        self.0.idle_since_ms.store(now_ms, Ordering::Relaxed);
        self.0.running.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.door.open.lock().retain(|other| !Arc::ptr_eq(other, &self.connection));
        self.door.ended.notify_one();
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    async fn is_closed(place: &Place) -> bool {
        tokio::time::timeout(Duration::from_millis(5), place.connection.to_close()).await.is_ok()
    }

    #[tokio::test]
    async fn a_silent_connection_gives_its_place_to_the_next() {
        let door = Door::new(3);
        let [first, silent, busy] = [(); 3].map(|()| door.admit().unwrap());
        drop(first.connection.request());
        let _running = busy.connection.request();
        let next = door.admit().unwrap();
        assert!(is_closed(&silent).await, "it has never sent a request");
        assert!(!is_closed(&first).await && !is_closed(&busy).await && !is_closed(&next).await);
        let _last = door.admit().unwrap();
        // The new one is silent as well, and the first one has asked.
        assert!(is_closed(&next).await && !is_closed(&first).await);
    }

    #[tokio::test]
    async fn nobody_is_admitted_while_all_have_requests() {
        let door = Door::new(1);
        let busy = door.admit().unwrap();
        let running = busy.connection.request();
        assert!(door.admit().is_none());
        drop(running);
        let next = door.admit().unwrap();
        assert!(is_closed(&busy).await);
        drop((busy, next));
        tokio::time::timeout(Duration::from_secs(1), door.emptied()).await.unwrap();
    }

    #[tokio::test]
    async fn unfinished_requests_are_counted_for_the_connection_and_for_all() {
        let door = Door::new(300);
        let greedy = door.admit().unwrap();
        let mut held = greedy.connection.reserve(limits::CONNECTION_KIB * 1024 - 1024).unwrap();
        held.merge(greedy.connection.reserve(1).unwrap());
        let refused = greedy.connection.reserve(1).unwrap_err();
        assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
        let mut others = Vec::new();
        let refused = loop {
            let place = door.admit().unwrap();
            match place.connection.reserve(limits::CONNECTION_KIB * 1024) {
                Ok(bytes) => others.push((place, bytes)),
                Err(status) => break status,
            }
        };
        assert_eq!(refused.code(), tonic::Code::Unavailable);
        drop(held);
        let place = door.admit().unwrap();
        place.connection.reserve(limits::CONNECTION_KIB * 1024).unwrap();
    }
}
