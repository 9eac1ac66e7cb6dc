//! Which version of each twin is the latest, as far as is known without waiting: sessions ask after
//! every step.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

use super::Engine;
use crate::blocking::run_blocking;
use crate::limits;

/// The last look at each twin, by its name.
#[derive(Default)]
pub(super) struct LatestVersions(Mutex<BTreeMap<String, Look>>);

struct Look {
    begun: Instant,
    is_over: bool,
    number: Option<u64>,
}

impl LatestVersions {
    /// The number that the last look found, and whether the caller has to look again, after `age`:
    /// one caller at a time has to.
    fn ask(&self, twin: &str, now: Instant, age: Duration) -> (Option<u64>, bool) {
        let mut looks = self.0.lock();
        let look = looks.entry(twin.to_owned());
        let mut is_old = false;
        let look = look.or_insert_with(|| {
            is_old = true;
            Look { begun: now, is_over: false, number: None }
        });
        // A look that is under way is not repeated, however long it takes.
        if look.is_over && now.saturating_duration_since(look.begun) >= age {
            is_old = true;
            look.begun = now;
            look.is_over = false;
        }
        (look.number, is_old)
    }

    /// What a look found; nothing if the twin cannot be read now.
    fn found(&self, twin: &str, number: Option<u64>) {
        if let Some(look) = self.0.lock().get_mut(twin) {
            look.is_over = true;
            // A look that failed leaves the number that is known.
            look.number = number.or(look.number);
        }
    }
}

impl Engine {
    /// The latest version of a twin that is known; `None` before the first look is over. Returns at
    /// once: a look at the store runs beside the caller, and later calls have its result.
    pub(crate) fn known_latest(self: &Arc<Self>, twin: &str) -> Option<u64> {
        if let Some(pinned) = self.pinned_latest(twin) {
            return Some(pinned);
        }
        // A look at an object store is a request over the network, so its result is used for
        // longer.
        let is_remote = self.cache.catalog().traffic().is_some();
        let age = if is_remote { limits::REMOTE_LATEST_AGE } else { limits::LATEST_AGE };
        let (number, is_old) = self.latest.ask(twin, Instant::now(), age);
        if is_old {
            let engine = self.clone();
            let twin = twin.to_owned();
            tokio::spawn(async move {
                let store = engine.clone();
                let name = twin.clone();
                let latest = run_blocking(move || store.cache.catalog().latest(&name)).await;
                // Also after a panic: otherwise the twin would never be looked at again.
                engine.latest.found(&twin, latest.ok().and_then(Result::ok));
            });
        }
        number
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_caller_looks_at_a_time_and_not_too_often() {
        let latest = LatestVersions::default();
        let ask = |twin: &str, now: Instant| latest.ask(twin, now, limits::LATEST_AGE);
        let begin = Instant::now();
        let old = begin + limits::LATEST_AGE;
        assert_eq!(ask("a", begin), (None, true));
        // The look is still under way.
        assert_eq!(ask("a", old), (None, false));
        latest.found("a", Some(3));
        assert_eq!(ask("a", begin), (Some(3), false));
        assert_eq!(ask("a", old), (Some(3), true));
        // A store that cannot be read changes nothing.
        latest.found("a", None);
        assert_eq!(ask("a", old), (Some(3), false));
        assert_eq!(ask("b", old), (None, true));
    }
}
