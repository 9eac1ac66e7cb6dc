//! Errors of the file of tokens.

/// Why a file of tokens cannot be used. The message contains no token.
#[derive(Debug, thiserror::Error)]
#[error("{location}: {reason}")]
pub struct TokensError {
    /// The location in the file, as `tokens[2].hash`.
    pub location: String,
    /// The error, and the expected form.
    pub reason: String,
}
