//! Failures with an exit code of their own.

/// A failure that ends the program with another exit code than 1.
#[derive(Debug)]
pub(super) struct Exit {
    /// The exit code.
    pub(super) code: u8,
    /// What happened.
    pub(super) message: String,
}

impl std::fmt::Display for Exit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Exit {}
