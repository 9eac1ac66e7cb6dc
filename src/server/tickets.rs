//! One-time tickets, which stand for a token in the address of a WebSocket: browsers cannot send a token with one.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use parking_lot::Mutex;

use crate::auth::Grant;
use crate::fault::Fault;
use crate::limits;

/// The tickets that were not used yet.
#[derive(Default)]
pub(crate) struct Tickets {
    /// By the BLAKE3 of the ticket: how long a look-up takes then says nothing about a ticket.
    entries: Mutex<BTreeMap<[u8; 32], Entry>>,
}

struct Entry {
    grant: Arc<Grant>,
    expires: Instant,
}

impl Tickets {
    /// A new ticket with the rights of a token.
    ///
    /// # Errors
    /// There are too many that were not used.
    pub(crate) fn issue(&self, grant: Arc<Grant>) -> Result<String, Fault> {
        self.issue_at(grant, Instant::now())
    }

    fn issue_at(&self, grant: Arc<Grant>, now: Instant) -> Result<String, Fault> {
        let mut entries = self.entries.lock();
        entries.retain(|_, entry| entry.expires > now);
        if entries.len() >= limits::TICKETS {
            return Err(Fault::Busy { what: "unused tickets", limit: limits::TICKETS });
        }
        // 244 random bits of the operating system.
        let ticket =
            [uuid::Uuid::new_v4(), uuid::Uuid::new_v4()].map(|id| id.simple().to_string()).concat();
        entries.insert(key(&ticket), Entry { grant, expires: now + limits::TICKET_AGE });
        Ok(ticket)
    }

    /// Uses a ticket up.
    ///
    /// # Errors
    /// It was used before, is too old, or was never issued.
    pub(crate) fn redeem(&self, ticket: &str) -> Result<Arc<Grant>, Fault> {
        self.redeem_at(ticket, Instant::now())
    }

    fn redeem_at(&self, ticket: &str, now: Instant) -> Result<Arc<Grant>, Fault> {
        let entry = self.entries.lock().remove(&key(ticket));
        let entry = entry.filter(|entry| entry.expires > now);
        Ok(entry.ok_or(Fault::UnknownTicket)?.grant)
    }
}

fn key(ticket: &str) -> [u8; 32] {
    *blake3::hash(ticket.as_bytes()).as_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ticket_is_good_once_and_for_a_while() {
        let tickets = Tickets::default();
        let now = Instant::now();
        let first = tickets.issue_at(Grant::everything(), now).unwrap();
        let second = tickets.issue_at(Grant::everything(), now).unwrap();
        assert_ne!(first, second);
        assert_eq!(tickets.redeem_at(&first, now).unwrap(), Grant::everything());
        assert!(matches!(tickets.redeem_at(&first, now), Err(Fault::UnknownTicket)));
        assert!(matches!(tickets.redeem_at("", now), Err(Fault::UnknownTicket)));
        let later = now + limits::TICKET_AGE;
        assert!(matches!(tickets.redeem_at(&second, later), Err(Fault::UnknownTicket)));
    }

    #[test]
    fn unused_tickets_are_bounded_and_forgotten() {
        let tickets = Tickets::default();
        let now = Instant::now();
        for _ in 0..limits::TICKETS {
            tickets.issue_at(Grant::everything(), now).unwrap();
        }
        let refused = tickets.issue_at(Grant::everything(), now);
        assert!(matches!(refused, Err(Fault::Busy { .. })));
        tickets.issue_at(Grant::everything(), now + limits::TICKET_AGE).unwrap();
        assert_eq!(tickets.entries.lock().len(), 1);
    }
}
