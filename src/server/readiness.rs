//! Whether sessions can be opened, looked up once for all that ask within a second.

use std::time::Instant;

use serde_json::Value;
use tokio::sync::Mutex;

use wildcity_session::Engine;

use crate::fault::Fault;
use crate::limits;

/// The last look at the list of twins.
#[derive(Default)]
pub(crate) struct Readiness(Mutex<Option<Look>>);

struct Look {
    at: Instant,
    refusal: Option<Value>,
}

impl Readiness {
    /// The body of a refusal if the twins cannot be listed. A request that arrives during a check
    /// waits for its result.
    pub(crate) async fn refusal(&self, engine: &Engine) -> Option<Value> {
        // A future and not a result: it is polled only if the last look is too old.
        let check = async {
            let error = engine.check_twins().await.err()?;
            Some(Fault::from(error).report().json())
        };
        self.look(Instant::now(), check).await
    }

    async fn look(
        &self,
        now: Instant,
        check: impl Future<Output = Option<Value>>,
    ) -> Option<Value> {
        // Held during the check, so that one check runs at a time.
        let mut last = self.0.lock().await;
        if let Some(Look { at, refusal }) = &*last
            && now < *at + limits::READY_AGE
        {
            return refusal.clone();
        }
        let refusal = check.await;
        *last = Some(Look { at: now, refusal: refusal.clone() });
        refusal
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    #[tokio::test]
    async fn many_questions_within_a_second_are_one_look() {
        let readiness = Readiness::default();
        let looks = Cell::new(0);
        let ask = async |now: Instant| {
            let look = async {
                looks.set(looks.get() + 1);
                Some(looks.get().into())
            };
            readiness.look(now, look).await
        };
        let begin = Instant::now();
        // Ten questions from 0 to 0.9 of the age of a look. The one at the full age looks again.
        for part in 0..10_u32 {
            assert_eq!(ask(begin + part * limits::READY_AGE / 10).await, Some(1.into()));
        }
        assert_eq!(ask(begin + limits::READY_AGE).await, Some(2.into()));
    }
}
