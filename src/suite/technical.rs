//! Failures that are not driving.

/// Why an attempt failed for a reason that is not driving. The names are those of outcomes.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Technical {
    /// `server_error`, `agent_error`, `agent_timeout`, `agent_lost`.
    pub(crate) kind: &'static str,
    /// Description of the failure.
    pub(crate) message: String,
    /// The last lines that the agent wrote to its standard error; empty for a built-in agent.
    pub(crate) stderr: String,
}

impl Technical {
    /// A failure of some kind.
    pub(crate) fn new(kind: &'static str, message: impl Into<String>) -> Self {
        Self { kind, message: message.into(), stderr: String::new() }
    }

    /// A failure of this program.
    pub(crate) fn server(message: impl Into<String>) -> Self {
        Self::new("server_error", message)
    }
}
