//! The spans of a request, as a collector of traces gets them.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Debug;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde_json::json;
use tokio::time::timeout;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing_subscriber::layer::{Context, Layer, SubscriberExt as _};
use tracing_subscriber::registry::LookupSpan;

use crate::support::{TEST_TIMEOUT, TestServer, pose};

/// A span that has begun.
#[derive(Clone, Debug, Default)]
struct Seen {
    name: &'static str,
    parent: Option<u64>,
    fields: BTreeMap<&'static str, String>,
    ended: bool,
}

/// Keeps all spans of the process.
#[derive(Clone, Default)]
struct Spans(Arc<Mutex<BTreeMap<u64, Seen>>>);

impl<S: tracing::Subscriber + for<'a> LookupSpan<'a>> Layer<S> for Spans {
    fn on_new_span(&self, attributes: &Attributes<'_>, id: &Id, context: Context<'_, S>) {
        let parent = context.span(id).and_then(|span| Some(span.parent()?.id().into_u64()));
        let name = attributes.metadata().name();
        let mut seen = Seen { name, parent, ..Seen::default() };
        attributes.record(&mut seen);
        // The registry reuses the ids of spans that ended; the parts of a request end before it
        // does.
        self.0.lock().unwrap().insert(id.into_u64(), seen);
    }

    fn on_record(&self, id: &Id, values: &Record<'_>, _: Context<'_, S>) {
        if let Some(seen) = self.0.lock().unwrap().get_mut(&id.into_u64()) {
            values.record(seen);
        }
    }

    fn on_close(&self, id: Id, _: Context<'_, S>) {
        if let Some(seen) = self.0.lock().unwrap().get_mut(&id.into_u64()) {
            seen.ended = true;
        }
    }
}

impl Visit for Seen {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        self.fields.insert(field.name(), format!("{value:?}"));
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.fields.insert(field.name(), value.to_owned());
    }
}

/// A step is one tree of spans, as a collector shows it.
#[tokio::test]
async fn a_step_is_traced_with_its_parts() {
    let spans = Spans::default();
    let subscriber = tracing_subscriber::registry().with(spans.clone());
    // It also receives the spans of tests that run at the same time.
    tracing::subscriber::set_global_default(subscriber).unwrap();
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    agent.open(json!({ "session": "traced", "outputs": { "encoding": "jpeg" } })).await;
    let step = json!({ "type": "step", "session": "traced", "pose": pose(1.0) });
    let seq = agent.look(step).await.meta["seq"].to_string();
    agent.ask(json!({ "type": "close" })).await;

    let is_step = |seen: &Seen| {
        seen.fields.get("type").is_some_and(|kind| kind == "step")
            && seen.fields.get("session").is_some_and(|session| session == "traced")
    };
    // The answer is sent before its span ends: a thread that rendered it may hold a part of it for
    // a moment.
    let has_ended = async {
        while !spans.0.lock().unwrap().values().any(|seen| is_step(seen) && seen.ended) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    timeout(TEST_TIMEOUT, has_ended).await.expect("the span of the step ends");
    let spans = spans.0.lock().unwrap().clone();
    let steps: Vec<u64> =
        spans.iter().filter(|(_, seen)| is_step(seen)).map(|(id, _)| *id).collect();
    let [step] = steps[..] else { panic!("one step: {spans:#?}") };
    assert!(spans[&step].parent.is_none() && spans[&step].ended, "{:?}", spans[&step]);
    assert_eq!(spans[&step].fields["seq"], seq);
    let parts = |of: u64| {
        let within = spans.iter().filter(move |(_, seen)| seen.parent == Some(of));
        within.map(|(id, seen)| (seen.name, *id)).collect::<Vec<_>>()
    };
    let names: BTreeSet<&str> = parts(step).into_iter().map(|(name, _)| name).collect();
    assert_eq!(names, BTreeSet::from(["load", "queue", "record", "render", "send"]));
    let (_, render) = *parts(step).iter().find(|(name, _)| *name == "render").unwrap();
    let encoded: Vec<String> =
        parts(render).iter().map(|(_, id)| spans[id].fields["camera"].clone()).collect();
    assert_eq!(BTreeSet::from_iter(encoded), BTreeSet::from(["front".into(), "rear".into()]));
    assert!(parts(render).iter().all(|(name, id)| *name == "encode" && spans[id].ended));
}
