//! How many pushes or connections each token has at this moment.

use std::collections::BTreeMap;
use std::sync::Arc;

use parking_lot::Mutex;

use crate::auth::Grant;
use crate::fault::Fault;
use crate::limits;

/// Number of operations of one kind, by token.
#[derive(Clone, Debug, Default)]
pub(crate) struct TokenCounts(Arc<Mutex<BTreeMap<String, usize>>>);

/// One thing that counts until it is dropped.
#[derive(Debug)]
pub(crate) struct Counted {
    counts: TokenCounts,
    token: String,
}

impl TokenCounts {
    /// Counts one more push, edit or search for the ground of a token.
    ///
    /// # Errors
    /// [`Fault::Busy`]: the token's limit is reached.
    pub(crate) fn push(&self, grant: &Grant) -> Result<Counted, Fault> {
        self.begin(grant, grant.limits.pushes, "pushes of this token")
    }

    /// Counts one more WebSocket connection of a token, of `all` that there may be. One without a
    /// limit of its own leaves some of them to others.
    ///
    /// # Errors
    /// [`Fault::Busy`]: the token's limit is reached.
    pub(crate) fn connection(&self, grant: &Grant, all: usize) -> Result<Counted, Fault> {
        let share = || limits::share_of_token(&grant.name, all);
        let limit = grant.limits.connections.unwrap_or_else(share);
        self.begin(grant, Some(limit), "connections of this token")
    }

    fn begin(
        &self,
        grant: &Grant,
        limit: Option<usize>,
        what: &'static str,
    ) -> Result<Counted, Fault> {
        let mut counts = self.0.lock();
        let count = counts.get(&grant.name).copied().unwrap_or(0);
        if let Some(limit) = limit
            && count >= limit
        {
            return Err(Fault::Busy { what, limit });
        }
        // Tokens without a limit are counted, too: a limit may be added while they run.
        counts.insert(grant.name.clone(), count + 1);
        Ok(Counted { counts: self.clone(), token: grant.name.clone() })
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        let mut counts = self.counts.0.lock();
        if let Some(count) = counts.get_mut(&self.token) {
            *count -= 1;
            // Names of tokens that were removed from the file do not stay.
            if *count == 0 {
                counts.remove(&self.token);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::auth::Tokens;

    #[test]
    fn a_token_has_as_many_pushes_as_it_may() {
        let text = r#"{"tokens": [
            {"name": "a", "role": "push", "token": "0123456789abcdef", "limits": {"pushes": 2}},
            {"name": "b", "role": "push", "token": "0123456789abcdeg"}]}"#;
        let tokens = Tokens::parse(text.as_bytes()).unwrap();
        let [a, b] = ["f", "g"].map(|end| {
            tokens.grant(Some(format!("Bearer 0123456789abcde{end}").as_bytes())).unwrap()
        });
        let pushes = TokenCounts::default();
        let first = pushes.push(&a).unwrap();
        let _second = pushes.push(&a).unwrap();
        assert!(matches!(pushes.push(&a), Err(Fault::Busy { limit: 2, .. })));
        let _others: Vec<Counted> = (0..9).map(|_| pushes.push(&b).unwrap()).collect();
        drop(first);
        assert!(pushes.push(&a).is_ok());
        // A token leaves a quarter of all connections to others; without tokens there are none.
        let connections = TokenCounts::default();
        let _own: Vec<Counted> = (0..6).map(|_| connections.connection(&a, 8).unwrap()).collect();
        assert!(matches!(connections.connection(&a, 8), Err(Fault::Busy { limit: 6, .. })));
        assert!(connections.connection(&b, 8).is_ok());
        let mut anyone = (*a).clone();
        anyone.name.clear();
        let _all: Vec<Counted> =
            (0..8).map(|_| connections.connection(&anyone, 8).unwrap()).collect();
    }
}
