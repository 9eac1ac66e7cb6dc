//! The `wildcity` command: parse, run, exit code.

use std::process::ExitCode;

fn main() -> ExitCode {
    wildcity::cli::main()
}
