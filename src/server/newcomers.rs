//! Connections before authentication.
//!
//! A connection is a *newcomer* until it sends a request that a token allows (any request, on a server without
//! tokens). Newcomers have slots of their own, and clients that are known have theirs, so that neither can take all.
//! While newcomers have no slot left, the oldest connection of the address with the most newcomers is closed for the
//! next one: a client that opens connections without using them loses them, and a health check, which comes and asks at once,
//! gets its answer.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};
use tokio::time::Instant;

use crate::fault::Fault;
use crate::limits;

/// The slots of a server's connections.
pub(crate) struct Newcomers {
    entries: Mutex<Entries>,
    /// Signalled when a newcomer leaves.
    left: Notify,
    /// One permit per connection that is no newcomer any more.
    known: Arc<Semaphore>,
    known_limit: usize,
}

#[derive(Default)]
struct Entries {
    /// Newcomers by the order of their arrival.
    waiting: BTreeMap<u64, Newcomer>,
    /// Number of newcomers of each address.
    by_address: BTreeMap<IpAddr, usize>,
    /// Number of connections ever admitted.
    admitted: u64,
}

struct Newcomer {
    address: IpAddr,
    arrived: Instant,
    close: Arc<Notify>,
}

/// The slot of one connection, until it is dropped.
pub(crate) struct ConnectionSlot {
    newcomers: Arc<Newcomers>,
    number: u64,
    close: Arc<Notify>,
    /// Held once the connection is no newcomer any more.
    permit: Mutex<Option<OwnedSemaphorePermit>>,
}

impl Newcomers {
    /// Slots for so many connections of clients that are known, and for [`limits::NEWCOMERS`] others.
    pub(crate) fn new(known_limit: usize) -> Arc<Self> {
        Arc::new(Self {
            entries: Mutex::default(),
            left: Notify::new(),
            known: Arc::new(Semaphore::new(known_limit)),
            known_limit,
        })
    }

    /// A slot for a connection from an address. May close another newcomer for it, or wait until it may.
    pub(crate) async fn admit(self: &Arc<Self>, address: IpAddr) -> ConnectionSlot {
        let address = network_of(address);
        loop {
            let left = self.left.notified();
            let wait = match self.entries.lock().make_room(address) {
                Ok(()) => break,
                Err(wait) => wait,
            };
            // Another newcomer leaves or becomes known, or the oldest has had its time.
            let _ = tokio::time::timeout(wait, left).await;
        }
        let close = Arc::new(Notify::new());
        let mut entries = self.entries.lock();
        entries.admitted += 1;
        let number = entries.admitted;
        let newcomer = Newcomer { address, arrived: Instant::now(), close: close.clone() };
        entries.waiting.insert(number, newcomer);
        *entries.by_address.entry(address).or_default() += 1;
        drop(entries);
        ConnectionSlot { newcomers: self.clone(), number, close, permit: Mutex::new(None) }
    }
}

impl Entries {
    /// Makes room for a newcomer from an address; or says how long to wait until it can.
    fn make_room(&mut self, address: IpAddr) -> Result<(), Duration> {
        let of_address = self.by_address.get(&address).copied().unwrap_or_default();
        let is_full = self.waiting.len() >= limits::NEWCOMERS;
        if !is_full && of_address < limits::NEWCOMERS_OF_ADDRESS {
            return Ok(());
        }
        let most = self.by_address.iter().max_by_key(|(_, count)| **count).map(|(most, _)| *most);
        let from = if is_full { most } else { Some(address) };
        let oldest = self.waiting.iter().find(|(_, newcomer)| Some(newcomer.address) == from);
        let Some((&number, newcomer)) = oldest else { return Ok(()) };
        // Many clients may come at once: each has this long to send its request.
        let age = newcomer.arrived.elapsed();
        match limits::NEWCOMER_GRACE.checked_sub(age) {
            Some(left) if is_full => return Err(left.max(Duration::from_millis(1))),
            Some(_) => return Ok(()),
            None => {}
        }
        newcomer.close.notify_one();
        self.remove(number);
        Ok(())
    }

    fn remove(&mut self, number: u64) -> bool {
        let Some(Newcomer { address, .. }) = self.waiting.remove(&number) else { return false };
        if let Some(count) = self.by_address.get_mut(&address) {
            *count -= 1;
            if *count == 0 {
                self.by_address.remove(&address);
            }
        }
        true
    }
}

impl ConnectionSlot {
    /// Notes that the connection sent a request that a token allows.
    ///
    /// # Errors
    /// [`Fault::Busy`] if there are too many connections of clients that are known.
    pub(crate) fn become_known(&self) -> Result<(), Fault> {
        let mut permit = self.permit.lock();
        if permit.is_some() {
            return Ok(());
        }
        let Ok(taken) = self.newcomers.known.clone().try_acquire_owned() else {
            let limit = self.newcomers.known_limit;
            return Err(Fault::Busy { what: "connections", limit });
        };
        *permit = Some(taken);
        drop(permit);
        self.leave();
        Ok(())
    }

    /// Returns when the slot is needed for another newcomer.
    pub(crate) async fn closed(&self) {
        self.close.notified().await;
    }

    /// Ends being a newcomer.
    fn leave(&self) {
        if self.newcomers.entries.lock().remove(self.number) {
            self.newcomers.left.notify_one();
        }
    }
}

impl Drop for ConnectionSlot {
    fn drop(&mut self) {
        self.leave();
    }
}

/// The network that one client may be assumed to have to itself: an IPv4 address, or the /64 of an IPv6 address.
fn network_of(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(v6) => {
            let [a, b, c, d, ..] = v6.segments();
            IpAddr::from([a, b, c, d, 0, 0, 0, 0])
        }
        v4 => v4,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);

    async fn is_closed(slot: &ConnectionSlot) -> bool {
        tokio::time::timeout(Duration::from_millis(1), slot.closed()).await.is_ok()
    }

    #[tokio::test]
    async fn who_opens_most_connections_loses_the_oldest() {
        let newcomers = Newcomers::new(1);
        let elsewhere = IpAddr::from([10, 0, 0, 1]);
        let other = newcomers.admit(elsewhere).await;
        let begun = Instant::now();
        let mut idle = Vec::new();
        for _ in 1..limits::NEWCOMERS {
            idle.push(newcomers.admit(HERE).await);
        }
        // They came at once, so none of them has had the time to send a request.
        let next = newcomers.admit(HERE).await;
        assert!(begun.elapsed() >= limits::NEWCOMER_GRACE);
        assert!(is_closed(&idle[0]).await && !is_closed(&idle[1]).await);
        assert!(!is_closed(&other).await, "it is older, but the only one of its address");
        tokio::time::sleep(limits::NEWCOMER_GRACE).await;
        let health = newcomers.admit(elsewhere).await;
        assert!(is_closed(&idle[1]).await && !is_closed(&health).await && !is_closed(&next).await);
    }

    #[tokio::test]
    async fn clients_that_are_known_have_slots_of_their_own() {
        let newcomers = Newcomers::new(1);
        let first = newcomers.admit(HERE).await;
        let second = newcomers.admit(HERE).await;
        first.become_known().unwrap();
        first.become_known().unwrap();
        assert!(matches!(second.become_known(), Err(Fault::Busy { limit: 1, .. })));
        drop(first);
        second.become_known().unwrap();
        drop(second);
        let entries = newcomers.entries.lock();
        assert_eq!((entries.waiting.len(), entries.by_address.len()), (0, 0));
    }
}
