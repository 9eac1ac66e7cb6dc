//! The spans of requests, which `wildcity serve --otlp-endpoint` sends to a collector.

use tracing::Span;
use tracing::field::Empty;

use crate::convert::Command;

/// The span of a request, from the arrival of its text until its answer is sent.
pub(super) fn request() -> Span {
    // The fields are known after parsing, which belongs to the span.
    tracing::debug_span!("request", r#type = Empty, seq = Empty, session = Empty)
}

/// Records the properties of the request in the current span.
pub(super) fn note(seq: u64, session: Option<&str>, command: &Command) {
    let span = Span::current();
    span.record("type", name(command)).record("seq", seq);
    if let Some(session) = session {
        span.record("session", session);
    }
}

/// The `type` of a request, as in `protocol/README.md`.
fn name(command: &Command) -> &'static str {
    match command {
        Command::Hello { .. } => "hello",
        Command::ShareMemory { .. } => "share_memory",
        Command::Open { .. } => "open",
        Command::Step { .. } => "step",
        Command::StepMany { .. } => "step_many",
        Command::Observe { .. } => "observe",
        Command::Prefetch { .. } => "prefetch",
        Command::Reset { .. } => "reset",
        Command::SwitchVersion { .. } => "switch_version",
        Command::Snapshot { .. } => "snapshot",
        Command::Restore { .. } => "restore",
        Command::Branch { .. } => "branch",
        Command::Close => "close",
        Command::Resume { .. } => "resume",
    }
}
