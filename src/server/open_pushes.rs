//! How many pushes and edits of each token wait or run.

use std::collections::BTreeMap;
use std::sync::Arc;

use parking_lot::Mutex;

use crate::auth::Grant;
use crate::fault::Fault;

/// The numbers of pushes by token.
#[derive(Clone, Debug, Default)]
pub(crate) struct OpenPushes(Arc<Mutex<BTreeMap<String, usize>>>);

/// A push that counts until it is dropped.
#[derive(Debug)]
pub(crate) struct OpenPush {
    counts: OpenPushes,
    token: String,
}

impl OpenPushes {
    /// Counts one more push of a token.
    ///
    /// # Errors
    /// [`Fault::Busy`]: the token has as many as it may.
    pub(crate) fn begin(&self, grant: &Grant) -> Result<OpenPush, Fault> {
        let mut counts = self.0.lock();
        let count = counts.get(&grant.name).copied().unwrap_or(0);
        if let Some(limit) = grant.limits.pushes
            && count >= limit
        {
            return Err(Fault::Busy { what: "pushes of this token", limit });
        }
        counts.insert(grant.name.clone(), count + 1);
        Ok(OpenPush { counts: self.clone(), token: grant.name.clone() })
    }
}

impl Drop for OpenPush {
    fn drop(&mut self) {
        let mut counts = self.counts.0.lock();
        if let Some(count) = counts.get_mut(&self.token) {
            *count -= 1;
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
        let pushes = OpenPushes::default();
        let first = pushes.begin(&a).unwrap();
        let _second = pushes.begin(&a).unwrap();
        assert!(matches!(pushes.begin(&a), Err(Fault::Busy { limit: 2, .. })));
        let _others: Vec<OpenPush> = (0..9).map(|_| pushes.begin(&b).unwrap()).collect();
        drop(first);
        assert!(pushes.begin(&a).is_ok());
    }
}
