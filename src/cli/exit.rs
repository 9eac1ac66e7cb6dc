//! Ends of the program with an exit code of their own.

use std::process::ExitCode;

/// An end of the program with an exit code of its own.
#[derive(Debug)]
pub struct Exit {
    pub code: u8,
    pub message: String,
    /// Whether this is a result and not an error: a result is printed without `error:`.
    pub is_finding: bool,
}

impl Exit {
    /// The program failed: the message is printed after `error:`.
    pub fn error(code: u8, message: String) -> Self {
        Self { code, message, is_finding: false }
    }

    /// The program worked, and the exit code reports what it found.
    pub fn finding(code: u8, message: String) -> Self {
        Self { code, message, is_finding: true }
    }
}

impl std::fmt::Display for Exit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Exit {}

/// The exit code of a program that ended with this result: 0 for success, 1 for a failure, or the
/// one of an [`Exit`]. Prints the error.
pub fn code(result: anyhow::Result<()>) -> ExitCode {
    let Err(error) = result else { return ExitCode::SUCCESS };
    let exit = error.downcast_ref::<Exit>();
    if exit.is_some_and(|exit| exit.is_finding) {
        eprintln!("{error}");
    } else {
        eprintln!("error: {}", chain(&error));
    }
    exit.map_or(ExitCode::FAILURE, |exit| exit.code.into())
}

/// An error with its causes. A cause whose text the error before it already ends with is not said
/// twice: the `Display` text of many errors includes that of their source.
pub fn chain(error: &anyhow::Error) -> String {
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
