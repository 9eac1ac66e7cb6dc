//! Where a server logs, and where it sends its traces.
//!
//! A trace is a request with its parts: a step loads chunks, waits for a render thread, is rendered
//! and encoded, and is recorded and sent. The parts are spans of `tracing` at the level `debug`. So
//! a server without traces, at the default level of its log, only checks for each span whether it
//! is enabled.

use std::io::{self, IsTerminal as _};

use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer as _};

/// How a server writes its log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum LogFormat {
    /// A line of text for each event.
    #[default]
    Text,
    /// A JSON object for each event, on one line.
    Json,
}

#[cfg(feature = "otlp")]
pub(super) use self::otlp::Traces;

/// Stands for the sender of traces, which this build does not have.
#[cfg(not(feature = "otlp"))]
pub(super) struct Traces;

/// Starts to log to standard error, and to send traces to an endpoint, if there is one.
pub(super) fn start(
    filter: &str,
    format: LogFormat,
    endpoint: Option<&str>,
) -> anyhow::Result<Option<Traces>> {
    let filter = EnvFilter::try_new(filter)?;
    let layer = tracing_subscriber::fmt::layer().with_writer(io::stderr);
    let lines = match format {
        LogFormat::Text => layer.with_ansi(io::stderr().is_terminal()).boxed(),
        LogFormat::Json => layer.json().with_ansi(false).boxed(),
    }
    .with_filter(filter);
    let registry = tracing_subscriber::registry().with(lines);
    let Some(endpoint) = endpoint else {
        registry.init();
        return Ok(None);
    };
    #[cfg(feature = "otlp")]
    {
        let (traces, layer) = Traces::to(endpoint)?;
        registry.with(layer).init();
        Ok(Some(traces))
    }
    #[cfg(not(feature = "otlp"))]
    anyhow::bail!(
        "--otlp-endpoint {endpoint}: built without `otlp`: cargo build --release --features full,otlp"
    )
}

#[cfg(feature = "otlp")]
mod otlp {
    use std::time::Duration;

    use anyhow::Context as _;
    use opentelemetry::trace::TracerProvider as _;
    use opentelemetry_otlp::{SpanExporter, WithExportConfig as _};
    use opentelemetry_sdk::Resource;
    use opentelemetry_sdk::trace::{BatchConfigBuilder, BatchSpanProcessor, SdkTracerProvider};
    use tracing::{Metadata, Subscriber};
    use tracing_subscriber::Layer;
    use tracing_subscriber::filter::filter_fn;
    use tracing_subscriber::registry::LookupSpan;

    /// Spans that wait to be sent: those of a thousand steps of six cameras. More are dropped.
    const WAITING_SPANS: usize = 1 << 15;
    /// Interval at which spans are sent.
    const SENT_EVERY: Duration = Duration::from_secs(1);
    /// Path below an endpoint that names none (OTLP specification 1.9, section "OTLP/HTTP
    /// Request").
    const TRACES_PATH: &str = "/v1/traces";

    /// Sends traces. When it is dropped, it sends the remaining spans.
    pub(in crate::cli::serve) struct Traces(SdkTracerProvider);

    impl Traces {
        /// Sends the spans of this program to an endpoint, `http://host:4318` or the same with a
        /// path.
        pub(super) fn to<S>(endpoint: &str) -> anyhow::Result<(Self, impl Layer<S> + use<S>)>
        where
            S: Subscriber + for<'a> LookupSpan<'a>,
        {
            let cannot = || format!("--otlp-endpoint {endpoint}");
            let host = endpoint.split_once("://").map_or("", |(_, rest)| rest);
            anyhow::ensure!(
                !host.is_empty(),
                "{}: expected a URL, as http://127.0.0.1:4318",
                cannot()
            );
            // The exporter takes an endpoint as it is: the path of the specification is added if
            // there is none.
            let url = if host.trim_end_matches('/').contains('/') {
                endpoint.to_owned()
            } else {
                format!("{}{TRACES_PATH}", endpoint.trim_end_matches('/'))
            };
            // The exporter's HTTP client has no TLS provider. Another part of the program may have
            // installed one already.
            let _ = rustls::crypto::ring::default_provider().install_default();
            let exporter = SpanExporter::builder()
                .with_http()
                .with_endpoint(url)
                .build()
                .with_context(cannot)?;
            let batches = BatchConfigBuilder::default()
                .with_max_queue_size(WAITING_SPANS)
                .with_scheduled_delay(SENT_EVERY)
                .build();
            let processor =
                BatchSpanProcessor::builder(exporter).with_batch_config(batches).build();
            let provider = SdkTracerProvider::builder()
                .with_span_processor(processor)
                .with_resource(Resource::builder().with_service_name("wildcity").build())
                .build();
            let layer = tracing_opentelemetry::layer()
                .with_tracer(provider.tracer("wildcity"))
                .with_location(false)
                .with_threads(false)
                // Spans of libraries, also those of the exporter's own requests, would be traced
                // without end.
                .with_filter(filter_fn(is_own_span));
            Ok((Self(provider), layer))
        }
    }

    impl Drop for Traces {
        fn drop(&mut self) {
            if let Err(error) = self.0.shutdown() {
                tracing::warn!("the last traces were not sent: {error}");
            }
        }
    }

    fn is_own_span(metadata: &Metadata<'_>) -> bool {
        metadata.is_span() && metadata.target().starts_with("wildcity")
    }
}
