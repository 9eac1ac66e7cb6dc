//! One-time tickets, which stand for a token in the address of a WebSocket: browsers cannot send a
//! token in a handshake.

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
    /// By the BLAKE3 of the ticket, so that the time of a look-up reveals nothing about tickets.
    entries: Mutex<BTreeMap<[u8; 32], Entry>>,
}

struct Entry {
    grant: Arc<Grant>,
    issued: Instant,
}

impl Tickets {
    /// A new ticket with the rights of a token. It replaces the token's oldest ticket if there are
    /// [`limits::TOKEN_TICKETS`].
    ///
    /// # Errors
    /// All tokens together have too many unused tickets.
    pub(crate) fn issue(&self, grant: Arc<Grant>) -> Result<String, Fault> {
        self.issue_at(grant, Instant::now())
    }

    fn issue_at(&self, grant: Arc<Grant>, now: Instant) -> Result<String, Fault> {
        let mut entries = self.entries.lock();
        // All entries are looked at for each ticket: 2,048 at most, and pages ask seldom.
        entries.retain(|_, entry| entry.is_good(now));
        let own = entries.iter().filter(|(_, entry)| entry.grant.name == grant.name);
        let own: Vec<([u8; 32], Instant)> = own.map(|(key, entry)| (*key, entry.issued)).collect();
        if own.len() >= limits::TOKEN_TICKETS
            && let Some((oldest, _)) = own.iter().min_by_key(|(_, issued)| *issued)
        {
            entries.remove(oldest);
        }
        // After the removal above, so that a token with many tickets can always have a new one.
        if entries.len() >= limits::TICKETS {
            return Err(Fault::Busy { what: "unused tickets", limit: limits::TICKETS });
        }
        // 244 random bits of the operating system.
        let ticket =
            [uuid::Uuid::new_v4(), uuid::Uuid::new_v4()].map(|id| id.simple().to_string()).concat();
        entries.insert(key(&ticket), Entry { grant, issued: now });
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
        // Removed before it is checked: a ticket that is too old is used up, too.
        let entry = self.entries.lock().remove(&key(ticket)).filter(|entry| entry.is_good(now));
        Ok(entry.ok_or(Fault::UnknownTicket)?.grant)
    }
}

impl Entry {
    fn is_good(&self, now: Instant) -> bool {
        now < self.issued + limits::TICKET_AGE
    }
}

fn key(ticket: &str) -> [u8; 32] {
    *blake3::hash(ticket.as_bytes()).as_bytes()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::auth::Tokens;

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

    /// The grants of `count` tokens.
    fn grants(count: usize) -> Vec<Arc<Grant>> {
        let token = |index: usize| {
            format!(r#"{{"name": "{index}", "role": "drive", "token": "token-token-{index:06}"}}"#)
        };
        let list: Vec<String> = (0..count).map(token).collect();
        let tokens =
            Tokens::parse(format!(r#"{{"tokens": [{}]}}"#, list.join(",")).as_bytes()).unwrap();
        let grant =
            |index: usize| tokens.grant(Some(format!("Bearer token-token-{index:06}").as_bytes()));
        (0..count).map(|index| grant(index).unwrap()).collect()
    }

    #[test]
    fn unused_tickets_are_bounded_and_forgotten() {
        let tickets = Tickets::default();
        let now = Instant::now();
        // 2,048 / 32 = 64 tokens fill the table, and one more gets none.
        let grants = grants(limits::TICKETS / limits::TOKEN_TICKETS + 1);
        let (last, others) = grants.split_last().unwrap();
        for grant in others {
            for _ in 0..limits::TOKEN_TICKETS {
                tickets.issue_at(grant.clone(), now).unwrap();
            }
        }
        assert_eq!(tickets.entries.lock().len(), limits::TICKETS);
        let refused = tickets.issue_at(last.clone(), now);
        assert!(matches!(refused, Err(Fault::Busy { .. })));
        tickets.issue_at(last.clone(), now + limits::TICKET_AGE).unwrap();
        assert_eq!(tickets.entries.lock().len(), 1);
    }

    #[test]
    fn a_token_that_asks_for_many_tickets_loses_its_oldest_and_no_other_tokens() {
        let tickets = Tickets::default();
        let begin = Instant::now();
        let grants = grants(2);
        let at = |step: usize| begin + Duration::from_millis(step as u64);
        let others = tickets.issue_at(grants[1].clone(), begin).unwrap();
        // Two more than a token may have, so that its first two are gone.
        let issued: Vec<String> = (0..limits::TOKEN_TICKETS + 2)
            .map(|step| tickets.issue_at(grants[0].clone(), at(step)).unwrap())
            .collect();
        let now = at(issued.len());
        assert_eq!(tickets.entries.lock().len(), limits::TOKEN_TICKETS + 1);
        let is_good = issued.iter().map(|ticket| tickets.redeem_at(ticket, now).is_ok());
        let is_good: Vec<bool> = is_good.collect();
        assert_eq!(is_good[..2], [false, false]);
        assert!(is_good[2..].iter().all(|good| *good), "{is_good:?}");
        assert!(tickets.redeem_at(&others, now).is_ok());
    }
}
