//! Ends of the program with an exit code of their own.

/// An end of the program with an exit code of its own.
#[derive(Debug)]
pub(super) struct Exit {
    /// The exit code.
    pub(super) code: u8,
    /// What happened.
    pub(super) message: String,
    /// Whether this is a result and not an error: a result is printed without `error:`.
    pub(super) is_finding: bool,
}

impl Exit {
    /// The program failed.
    pub(super) fn error(code: u8, message: String) -> Self {
        Self { code, message, is_finding: false }
    }

    /// The program worked, and the exit code reports what it found.
    pub(super) fn finding(code: u8, message: String) -> Self {
        Self { code, message, is_finding: true }
    }
}

impl std::fmt::Display for Exit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Exit {}
