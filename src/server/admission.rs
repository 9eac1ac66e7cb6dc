//! Admission of connections, before and after authentication.
//!
//! A connection counts as unauthenticated until it sends a request that its token allows (any
//! request, on a server without tokens). Unauthenticated and authenticated connections have
//! separate slots, so that neither can take all. While all slots for unauthenticated connections
//! are in use, the oldest connection of the address with the most of them is closed for the next
//! one. So a client that opens connections without using them loses them, and a health check, which
//! sends its request at once, is answered.

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
pub(crate) struct ConnectionSlots {
    entries: Mutex<Entries>,
    /// Signalled when a connection is authenticated or ends.
    left: Notify,
    /// One permit per authenticated connection.
    authenticated: Arc<Semaphore>,
    authenticated_limit: usize,
}

#[derive(Default)]
struct Entries {
    /// Unauthenticated connections by the order of their arrival.
    waiting: BTreeMap<u64, UnauthenticatedConnection>,
    /// Number of unauthenticated connections of each address.
    by_address: BTreeMap<IpAddr, usize>,
    /// Number of connections ever admitted.
    admitted: u64,
}

struct UnauthenticatedConnection {
    address: IpAddr,
    arrived: Instant,
    close: Arc<Notify>,
}

/// The slot of one connection, until it is dropped.
pub(crate) struct ConnectionSlot {
    connections: Arc<ConnectionSlots>,
    number: u64,
    close: Arc<Notify>,
    /// Held once the connection is authenticated.
    permit: Mutex<Option<OwnedSemaphorePermit>>,
}

impl ConnectionSlots {
    /// `authenticated_limit` slots for authenticated connections, and
    /// [`limits::UNAUTHENTICATED_CONNECTIONS`] others.
    pub(crate) fn new(authenticated_limit: usize) -> Arc<Self> {
        Arc::new(Self {
            entries: Mutex::default(),
            left: Notify::new(),
            authenticated: Arc::new(Semaphore::new(authenticated_limit)),
            authenticated_limit,
        })
    }

    /// Returns a slot for a connection from an address. May first close another unauthenticated
    /// connection, or wait until that is allowed.
    pub(crate) async fn admit(self: &Arc<Self>, address: IpAddr) -> ConnectionSlot {
        // A client with a network of its own could otherwise take a slot for each of its addresses.
        let address = client_network(address);
        loop {
            // The permit of `notify_one` is stored, so that a slot that becomes free before the
            // wait below is not missed.
            let left = self.left.notified();
            let wait = match self.entries.lock().make_room(address) {
                Ok(()) => break,
                Err(wait) => wait,
            };
            // Until another connection is authenticated or ends, or the grace period of the oldest
            // is over.
            let _ = tokio::time::timeout(wait, left).await;
        }
        let close = Arc::new(Notify::new());
        // Only the accept loop admits connections, one at a time, so the room that was made is
        // still there.
        let mut entries = self.entries.lock();
        entries.admitted += 1;
        let number = entries.admitted;
        let arrived = Instant::now();
        let connection = UnauthenticatedConnection { address, arrived, close: close.clone() };
        entries.waiting.insert(number, connection);
        *entries.by_address.entry(address).or_default() += 1;
        drop(entries);
        ConnectionSlot { connections: self.clone(), number, close, permit: Mutex::new(None) }
    }
}

impl Entries {
    /// Makes room for a connection from an address; or returns how long to wait before the next
    /// try.
    fn make_room(&mut self, address: IpAddr) -> Result<(), Duration> {
        let of_address = self.by_address.get(&address).copied().unwrap_or_default();
        // Two limits: of all, and of one address, which is half of it, so that one address cannot
        // fill the slots alone.
        let is_full = self.waiting.len() >= limits::UNAUTHENTICATED_CONNECTIONS;
        if !is_full && of_address < limits::UNAUTHENTICATED_OF_ADDRESS {
            return Ok(());
        }
        // The keys are numbers that rise, so that the first match in the map is the oldest. Both
        // searches go over 512 entries at most.
        let most = self.by_address.iter().max_by_key(|(_, count)| **count).map(|(most, _)| *most);
        let from = if is_full { most } else { Some(address) };
        let oldest = self.waiting.iter().find(|(_, connection)| Some(connection.address) == from);
        let Some((&number, connection)) = oldest else { return Ok(()) };
        // Many clients may connect at once: each has this long to send its request.
        let age = connection.arrived.elapsed();
        match limits::UNAUTHENTICATED_GRACE.checked_sub(age) {
            // There is no slot until the grace period is over. A wait of 0 would spin.
            Some(left) if is_full => return Err(left.max(Duration::from_millis(1))),
            // Only the address has too many: there is room for now, and a later connection finds
            // them older.
            Some(_) => return Ok(()),
            None => {}
        }
        connection.close.notify_one();
        self.remove(number);
        Ok(())
    }

    /// Removes an unauthenticated connection. Returns whether it was there.
    fn remove(&mut self, number: u64) -> bool {
        let Some(UnauthenticatedConnection { address, .. }) = self.waiting.remove(&number) else {
            return false;
        };
        if let Some(count) = self.by_address.get_mut(&address) {
            *count -= 1;
            // Addresses without connections are forgotten, or the map would grow with every client
            // there ever was.
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
    /// [`Fault::Busy`] if there are too many authenticated connections.
    pub(crate) fn mark_authenticated(&self) -> Result<(), Fault> {
        // The lock covers the check and the take, so that two requests of one connection take one
        // permit.
        let mut permit = self.permit.lock();
        if permit.is_some() {
            return Ok(());
        }
        let Ok(taken) = self.connections.authenticated.clone().try_acquire_owned() else {
            let limit = self.connections.authenticated_limit;
            return Err(Fault::Busy { what: "connections", limit });
        };
        *permit = Some(taken);
        // The permit is stored before the connection leaves the others, so it always counts in one
        // of the two.
        drop(permit);
        self.leave();
        Ok(())
    }

    /// Returns when the slot is needed for another connection.
    pub(crate) async fn closed(&self) {
        self.close.notified().await;
    }

    /// Removes the connection from the unauthenticated ones.
    fn leave(&self) {
        if self.connections.entries.lock().remove(self.number) {
            self.connections.left.notify_one();
        }
    }
}

impl Drop for ConnectionSlot {
    fn drop(&mut self) {
        self.leave();
    }
}

/// The network that is assumed to belong to one client: an IPv4 address, or the /64 of an IPv6
/// address.
fn client_network(address: IpAddr) -> IpAddr {
    // An IPv4 address that is mapped to IPv6 counts as IPv4, or its /64 would be that of all IPv4
    // clients.
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
    async fn the_address_with_most_connections_loses_the_oldest() {
        let connections = ConnectionSlots::new(1);
        let elsewhere = IpAddr::from([10, 0, 0, 1]);
        let other = connections.admit(elsewhere).await;
        let begun = Instant::now();
        let mut idle = Vec::new();
        // One slot is taken by the other address, so this fills the rest.
        for _ in 1..limits::UNAUTHENTICATED_CONNECTIONS {
            idle.push(connections.admit(HERE).await);
        }
        // They came at once, so none of them has had the time to send a request.
        let next = connections.admit(HERE).await;
        assert!(begun.elapsed() >= limits::UNAUTHENTICATED_GRACE);
        assert!(is_closed(&idle[0]).await && !is_closed(&idle[1]).await);
        assert!(!is_closed(&other).await, "it is older, but the only one of its address");
        tokio::time::sleep(limits::UNAUTHENTICATED_GRACE).await;
        let health = connections.admit(elsewhere).await;
        assert!(is_closed(&idle[1]).await && !is_closed(&health).await && !is_closed(&next).await);
    }

    #[tokio::test]
    async fn authenticated_connections_have_slots_of_their_own() {
        let connections = ConnectionSlots::new(1);
        let first = connections.admit(HERE).await;
        let second = connections.admit(HERE).await;
        first.mark_authenticated().unwrap();
        first.mark_authenticated().unwrap();
        assert!(matches!(second.mark_authenticated(), Err(Fault::Busy { limit: 1, .. })));
        drop(first);
        second.mark_authenticated().unwrap();
        drop(second);
        let entries = connections.entries.lock();
        assert_eq!((entries.waiting.len(), entries.by_address.len()), (0, 0));
    }
}
