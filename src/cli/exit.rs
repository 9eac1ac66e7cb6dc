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

/// An error with its causes. A cause whose text the error before it already ends with is not said
/// twice: the `Display` text of many errors includes that of their source.
pub(super) fn chain(error: &anyhow::Error) -> String {
    error.chain().map(ToString::to_string).fold(String::new(), |text, cause| {
        match (text.is_empty(), text.ends_with(&cause)) {
            (true, _) => cause,
            (false, true) => text,
            (false, false) => format!("{text}: {cause}"),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cause_is_said_once() {
        let cause = anyhow::anyhow!("Gaussian 0: x is NaN");
        let once = cause.context("sky: Gaussian 0: x is NaN").context("cannot import a.ply");
        assert_eq!(chain(&once), "cannot import a.ply: sky: Gaussian 0: x is NaN");
        let plain = anyhow::anyhow!("no such file").context("cannot read b");
        assert_eq!(chain(&plain), format!("{plain:#}"));
    }
}
