//! Numbers for Prometheus, of one server: nothing here is global.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use axum::Extension;
use axum::extract::{Request, State};
use axum::http::header;
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use prometheus_client::collector::Collector;
use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric as _};
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::{Registry, Unit};

use wildcity_session::Engine;

use super::Server;
use super::auth::{Grant, Role};
use super::convert::WireCode;
use super::fault::Fault;
use super::refusal::Answered;

/// A counter for each value of one label.
type By = Family<[(&'static str, String); 1], Counter>;

/// What a server counts.
pub(super) struct Metrics {
    registry: Registry,
    pub(super) steps: Counter,
    pub(super) step_seconds: Histogram,
    pub(super) queue_seconds: Histogram,
    pub(super) uploads_begun: Counter,
    pub(super) uploaded_bytes: Counter,
    pub(super) observation_bytes: Counter,
    pub(super) versions_switched: Counter,
    refusals: By,
    pushes: By,
    sessions: Gauge,
    connections: Gauge,
    frames_queued: Gauge,
    uploads: Gauge,
    spool_bytes: Gauge<u64, AtomicU64>,
    pushes_open: Gauge,
}

impl Metrics {
    pub(super) fn new(engine: Arc<Engine>) -> Self {
        let mut registry = Registry::with_prefix("wildcity");
        // 1 ms to 33 s, each twice the one before: a step takes 0.1 s, and at most 60.
        let seconds = || Histogram::new(exponential_buckets(1e-3, 2.0, 16));
        let metrics = Self {
            registry: Registry::default(),
            steps: Counter::default(),
            step_seconds: seconds(),
            queue_seconds: seconds(),
            uploads_begun: Counter::default(),
            uploaded_bytes: Counter::default(),
            observation_bytes: Counter::default(),
            versions_switched: Counter::default(),
            refusals: By::default(),
            pushes: By::default(),
            sessions: Gauge::default(),
            connections: Gauge::default(),
            frames_queued: Gauge::default(),
            uploads: Gauge::default(),
            spool_bytes: Gauge::default(),
            pushes_open: Gauge::default(),
        };
        let m = &metrics;
        registry.register("steps", "Steps carried out", m.steps.clone());
        let help = "From a step's arrival to its observation, waiting included";
        registry.register_with_unit("step", help, Unit::Seconds, m.step_seconds.clone());
        let help = "How long the frames of a step waited for other sessions' frames";
        registry.register_with_unit("queue", help, Unit::Seconds, m.queue_seconds.clone());
        registry.register("refusals", "Requests refused, by code", m.refusals.clone());
        registry.register("uploads_begun", "Uploads announced", m.uploads_begun.clone());
        registry.register("uploaded_bytes", "Bytes of uploads", m.uploaded_bytes.clone());
        let help = "Bytes of observations sent";
        registry.register("observation_bytes", help, m.observation_bytes.clone());
        let help = "Sessions that switched to another version";
        registry.register("versions_switched", help, m.versions_switched.clone());
        registry.register("pushes", "Pushes that ended, by outcome", m.pushes.clone());
        let help = "Sessions, connected or waiting to be resumed";
        registry.register("sessions", help, m.sessions.clone());
        registry.register("connections", "WebSocket connections", m.connections.clone());
        registry.register("frames_queued", "Frames in the queue", m.frames_queued.clone());
        registry.register("uploads", "Uploads on disk", m.uploads.clone());
        registry.register("spool_bytes", "Bytes announced of those", m.spool_bytes.clone());
        registry.register("pushes_open", "Pushes that wait or run", m.pushes_open.clone());
        registry.register_collector(Box::new(Residency(engine)));
        Self { registry, ..metrics }
    }

    /// A request was refused, of whatever kind.
    pub(super) fn refused(&self, code: &WireCode) {
        self.refusals.get_or_create(&[("code", code.0.clone())]).inc();
    }

    /// A push ended.
    pub(super) fn pushed(&self, outcome: &str) {
        self.pushes.get_or_create(&[("outcome", outcome.to_owned())]).inc();
    }
}

/// What the pager counts by itself, read when it is asked for.
#[derive(Debug)]
struct Residency(Arc<Engine>);

impl Collector for Residency {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), std::fmt::Error> {
        let stats = self.0.residency();
        let failed = "Loads that failed because";
        for (name, help, count) in [
            ("hits", "Sections that frames found in memory".to_owned(), stats.hits),
            ("misses", "Sections that frames had to wait for".to_owned(), stats.misses),
            ("loads", "Sections that were loaded".to_owned(), stats.loads),
            ("failed_damaged", format!("{failed} the bytes are damaged"), stats.failed_damaged),
            ("failed_unreadable", format!("{failed} they cannot be read"), stats.failed_unreadable),
            ("failed_crashed", format!("{failed} of a defect"), stats.failed_crashed),
            ("retries", "Loads that were tried again".to_owned(), stats.retries),
            ("evictions", "Sections that made room for others".to_owned(), stats.evictions),
            ("prefetches_dropped", "Prefetches without room".to_owned(), stats.prefetches_dropped),
            ("waits", "Frames that had to wait".to_owned(), stats.waits),
            (
                "waits_given_up",
                "Frames not complete in time, or for a section that failed".to_owned(),
                stats.waits_given_up,
            ),
        ] {
            let counter = ConstCounter::new(count);
            let name = format!("residency_{name}");
            let kind = counter.metric_type();
            counter.encode(encoder.encode_descriptor(&name, &help, None, kind)?)?;
        }
        if let Some(traffic) = self.0.catalog().traffic() {
            for (name, help, count) in [
                ("requests", "Requests to the object store", traffic.requests),
                ("retries", "Requests that were tried again", traffic.retries),
                ("failures", "Requests that failed for good", traffic.failures),
                ("cache_hits", "Parts of objects found in the disk cache", traffic.cache_hits),
                ("cache_misses", "Parts of objects that were fetched", traffic.cache_misses),
            ] {
                let counter = ConstCounter::new(count);
                let name = format!("store_{name}");
                let kind = counter.metric_type();
                counter.encode(encoder.encode_descriptor(&name, help, None, kind)?)?;
            }
        }
        let seconds = |duration: std::time::Duration| duration.as_secs_f64();
        let (name, help) = ("residency_wait_seconds", "How long frames waited, together");
        let counter = ConstCounter::new(seconds(stats.wait_time));
        let kind = counter.metric_type();
        counter.encode(encoder.encode_descriptor(name, help, None, kind)?)?;
        for (name, help, value) in [
            ("held_bytes", "Memory in use", stats.held_bytes as f64),
            ("limit_bytes", "Memory there is", stats.limit_bytes as f64),
            ("reserved_bytes", "Memory set aside for sessions", stats.reserved_bytes as f64),
            ("held_sections", "Sections in memory", stats.held_sections as f64),
            ("load_p50_seconds", "Median time of the last loads", seconds(stats.load_p50)),
            ("load_p99_seconds", "99th percentile of the last loads", seconds(stats.load_p99)),
        ] {
            let gauge = ConstGauge::new(value);
            let name = format!("residency_{name}");
            let kind = gauge.metric_type();
            gauge.encode(encoder.encode_descriptor(&name, help, None, kind)?)?;
        }
        Ok(())
    }
}

/// `GET /metrics`, in OpenMetrics' text.
pub(super) async fn show(
    State(server): State<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> Answered {
    grant.may(Role::Admin)?;
    let metrics = &server.metrics;
    metrics.sessions.set(server.sessions.count() as i64);
    let free = server.agents.available_permits();
    metrics.connections.set((server.limits.connections - free) as i64);
    metrics.frames_queued.set(server.engine.queued_frames() as i64);
    let (uploads, spool_bytes) = server.spool.as_ref().map_or((0, 0), |spool| spool.load());
    metrics.uploads.set(uploads as i64);
    metrics.spool_bytes.set(spool_bytes);
    metrics.pushes_open.set(server.pushes.open() as i64);
    let mut text = String::new();
    encode(&mut text, &metrics.registry).map_err(|error| Fault::Internal(error.to_string()))?;
    let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    Ok(([(header::CONTENT_TYPE, kind)], text).into_response())
}

/// Counts what HTTP refuses.
pub(super) async fn count(
    State(server): State<Arc<Server>>,
    request: Request,
    next: Next,
) -> Response {
    let response = next.run(request).await;
    if let Some(code) = response.extensions().get::<WireCode>() {
        server.metrics.refused(code);
    }
    response
}
