//! Ends of the program with an exit code of their own.

/// An end of the program with an exit code of its own.
#[derive(Debug)]
pub(super) struct Exit {
    /// The exit code.
    pub(super) code: u8,
    /// What happened.
    pub(super) message: String,
    /// Whether it is what the program found: then it is printed without `error:`.
    pub(super) is_finding: bool,
}

impl Exit {
    /// The program could not do what it should.
    pub(super) fn error(code: u8, message: String) -> Self {
        Self { code, message, is_finding: false }
    }

    /// The program did what it should, and this is what it found.
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
