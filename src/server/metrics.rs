//! Counters and gauges for Prometheus. Each server has its own; none is global.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric as _, NoLabelSet};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};

use wildcity_session::{Engine, Polls};

use crate::process::Process;

/// A counter for each value of one label.
type CountersByLabel = Family<[(&'static str, String); 1], Counter>;

/// The counters and gauges of a server.
pub(crate) struct Metrics {
    registry: Registry,
    pub(crate) steps: Counter,
    pub(crate) step_seconds: Histogram,
    pub(crate) queue_seconds: Histogram,
    pub(crate) uploads_begun: Counter,
    pub(crate) uploaded_bytes: Counter,
    pub(crate) observation_bytes: Counter,
    pub(crate) shared_memory_bytes: Counter,
    pub(crate) versions_switched: Counter,
    pub(crate) reloads: Counter,
    refusals: CountersByLabel,
    pushes: CountersByLabel,
    sessions: Gauge,
    connections: Gauge,
    frames_queued: Gauge,
    answer_bytes: Gauge<u64, AtomicU64>,
    uploads: Gauge,
    spool_bytes: Gauge<u64, AtomicU64>,
    pushes_open: Gauge,
}

/// The values of the gauges at one time.
pub(crate) struct GaugeValues {
    /// Sessions, connected or waiting to be resumed.
    pub(crate) sessions: usize,
    pub(crate) connections: usize,
    /// Frames that wait for the renderer.
    pub(crate) frames_queued: usize,
    /// Memory of answers, in bytes.
    pub(crate) answer_bytes: u64,
    pub(crate) uploads: usize,
    /// Their bytes, as announced.
    pub(crate) spool_bytes: u64,
    /// Pushes that wait or run.
    pub(crate) pushes_open: usize,
}

impl Metrics {
    /// `directories` are those whose free space is measured, each with its name.
    pub(crate) fn new(engine: Arc<Engine>, directories: Vec<(&'static str, PathBuf)>) -> Self {
        let mut all = Registry::default();
        // Names of the process have no prefix: dashboards for any program know them.
        all.register_collector(Box::new(Process::new(directories)));
        let registry = all.sub_registry_with_prefix("wildcity");
        let build = [("version", env!("CARGO_PKG_VERSION")), ("backend", engine.backend())];
        registry.register("build", "Version and backend of the server", Info::new(build));
        // 16 buckets from 1 ms to 33 s, each twice the previous one: most steps take 0.1 s.
        let seconds = || Histogram::new(exponential_buckets(1e-3, 2.0, 16));
        let metrics = Self {
            // The registry is filled below, with clones that share the values, and put in place at
            // the end.
            registry: Registry::default(),
            steps: Counter::default(),
            step_seconds: seconds(),
            queue_seconds: seconds(),
            uploads_begun: Counter::default(),
            uploaded_bytes: Counter::default(),
            observation_bytes: Counter::default(),
            shared_memory_bytes: Counter::default(),
            versions_switched: Counter::default(),
            reloads: Counter::default(),
            refusals: CountersByLabel::default(),
            pushes: CountersByLabel::default(),
            sessions: Gauge::default(),
            connections: Gauge::default(),
            frames_queued: Gauge::default(),
            answer_bytes: Gauge::default(),
            uploads: Gauge::default(),
            spool_bytes: Gauge::default(),
            pushes_open: Gauge::default(),
        };
        let m = &metrics;
        // Clones of a counter count together, so that the fields of this struct are what is
        // encoded.
        registry.register("steps", "Steps carried out", m.steps.clone());
        let help = "From a step's arrival to its observation, waiting included";
        registry.register_with_unit("step", help, Unit::Seconds, m.step_seconds.clone());
        let help = "How long the frames of a step waited for other sessions' frames";
        registry.register_with_unit("queue", help, Unit::Seconds, m.queue_seconds.clone());
        registry.register("refusals", "Requests refused, by code", m.refusals.clone());
        registry.register("uploads_begun", "Uploads announced", m.uploads_begun.clone());
        registry.register("uploaded_bytes", "Bytes of uploads", m.uploaded_bytes.clone());
        let help = "Bytes of observations sent through the socket";
        registry.register("observation_bytes", help, m.observation_bytes.clone());
        let help = "Bytes of observations written into shared memory";
        registry.register("shared_memory_bytes", help, m.shared_memory_bytes.clone());
        let help = "Sessions that switched to another version";
        registry.register("versions_switched", help, m.versions_switched.clone());
        let help = "SIGHUPs after which certificate and tokens were read again";
        registry.register("reloads", help, m.reloads.clone());
        registry.register("pushes", "Pushes that ended, by outcome", m.pushes.clone());
        let help = "Sessions, connected or waiting to be resumed";
        registry.register("sessions", help, m.sessions.clone());
        registry.register("connections", "WebSocket connections", m.connections.clone());
        registry.register("frames_queued", "Frames in the queue", m.frames_queued.clone());
        let help = "Memory of answers that are made, sent or kept";
        registry.register("answer_bytes", help, m.answer_bytes.clone());
        registry.register("uploads", "Uploads on disk", m.uploads.clone());
        registry.register(
            "spool_bytes",
            "Bytes of those that arrived or are reserved",
            m.spool_bytes.clone(),
        );
        registry.register("pushes_open", "Pushes that wait or run", m.pushes_open.clone());
        registry.register_collector(Box::new(LongestPolls(engine.polls().clone())));
        registry.register_collector(Box::new(Devices(engine.clone())));
        registry.register_collector(Box::new(Residency(engine)));
        Self { registry: all, ..metrics }
    }

    /// All numbers in OpenMetrics' text format; `gauges` are the values of this moment.
    ///
    /// # Errors
    /// A collector failed.
    pub(crate) fn text(&self, gauges: GaugeValues) -> Result<String, std::fmt::Error> {
        // Gauges are read when they are asked for, and so never drift from what they count.
        self.sessions.set(gauges.sessions as i64);
        self.connections.set(gauges.connections as i64);
        self.frames_queued.set(gauges.frames_queued as i64);
        self.answer_bytes.set(gauges.answer_bytes);
        self.uploads.set(gauges.uploads as i64);
        self.spool_bytes.set(gauges.spool_bytes);
        self.pushes_open.set(gauges.pushes_open as i64);
        let mut text = String::new();
        encode(&mut text, &self.registry)?;
        Ok(text)
    }

    /// Counts a refused request by its wire code.
    pub(crate) fn refused(&self, code: &str) {
        self.refusals.get_or_create(&[("code", code.to_owned())]).inc();
    }

    /// Counts a push that ended, by its outcome.
    pub(crate) fn push_ended(&self, outcome: &str) {
        self.pushes.get_or_create(&[("outcome", outcome.to_owned())]).inc();
    }
}

/// How long tasks hold the threads that answer requests.
#[derive(Debug)]
struct LongestPolls(Arc<Polls>);

impl Collector for LongestPolls {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), std::fmt::Error> {
        let times = self.0.times();
        let polls: u64 = times.counts.iter().map(|(_, count)| count).sum();
        // The encoder writes `+Inf` for this number only.
        let buckets: Vec<_> =
            times.counts.iter().map(|&(bound_s, count)| (bound_s.min(f64::MAX), count)).collect();
        let help = "How long a task held a thread that answers requests";
        let unit = Some(&Unit::Seconds);
        let kind = MetricType::Histogram;
        let mut histogram = encoder.encode_descriptor("poll", help, unit, kind)?;
        let total_s = times.total.as_secs_f64();
        histogram.encode_histogram::<NoLabelSet>(total_s, polls, &buckets, None)?;
        let longest = ConstGauge::new(times.longest.as_secs_f64());
        let help = "The longest of them since the start";
        let kind = longest.metric_type();
        longest.encode(encoder.encode_descriptor("poll_longest_seconds", help, None, kind)?)
    }
}

/// What each device of the backend does.
#[derive(Debug)]
struct Devices(Arc<Engine>);

impl Collector for Devices {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), std::fmt::Error> {
        let loads = self.0.device_loads();
        // Read once, so that the numbers of one answer belong together.
        let sessions = loads.iter().map(|load| load.sessions).collect::<Vec<_>>();
        let queued = loads.iter().map(|load| load.queued_frames).collect();
        for (name, help, counts) in [
            ("device_sessions", "Sessions by the device that draws them", sessions),
            ("device_frames_queued", "Frames in the queue of a device", queued),
        ] {
            let mut gauge = encoder.encode_descriptor(name, help, None, MetricType::Gauge)?;
            for (device, count) in counts.into_iter().enumerate() {
                let labels = [("device", device.to_string())];
                gauge.encode_family(&labels)?.encode_gauge(&(count as i64))?;
            }
        }
        Ok(())
    }
}

/// The counters of the pager and the object store, which are read when metrics are requested.
#[derive(Debug)]
struct Residency(Arc<Engine>);

impl Collector for Residency {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), std::fmt::Error> {
        // One copy of the statistics, so that the numbers of one answer belong together.
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
            (
                "by_camera",
                "Times that a session began to draw frames camera by camera, for lack of memory"
                    .to_owned(),
                stats.by_camera,
            ),
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
        // A directory has no requests to count.
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
        let counter = ConstCounter::new(seconds(stats.wait_time));
        let name = "residency_wait_seconds";
        let help = "How long frames waited, together";
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
