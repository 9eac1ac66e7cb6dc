//! Failures that are not driving.

/// Why an attempt failed for a reason that is not driving. The names are those of outcomes.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Technical {
    /// `server_error`, `agent_error`, `agent_timeout`, `agent_lost`.
    pub(crate) kind: &'static str,
    /// What happened.
    pub(crate) message: String,
}

impl Technical {
    pub(crate) fn server(message: impl Into<String>) -> Self {
        Self { kind: "server_error", message: message.into() }
    }
}
