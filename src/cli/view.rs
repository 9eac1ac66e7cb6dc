//! `wildcity view`.

use std::env;
use std::io::Write;
use std::process::{Command, Stdio};
use std::sync::Arc;

use wildcity_server::Config;

use super::backend_options::BackendOptions;
use super::directories::ServerDirectories;
use crate::cli::output;

/// Look at a twin in the browser, and drive through it by hand.
///
/// Serves the viewer on a free port of this machine, prints its URL, and opens it in the browser.
/// Drives are recorded as those of any agent. Ctrl-C ends it. A running `wildcity serve` has the
/// same viewer at its own URL.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct View {
    /// Twin to drive through; without it, the page lists all of them.
    twin: Option<String>,

    /// Print the URL, but do not open it.
    #[arg(long)]
    no_open: bool,

    #[command(flatten)]
    directories: ServerDirectories,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity view
  wildcity view street
  wildcity view street --no-open --twins ./twins";

impl View {
    pub(super) fn run(self) -> anyhow::Result<()> {
        if let Some(twin) = &self.twin {
            // An unknown or damaged twin is reported here, and not by the page.
            self.directories.twins.catalog()?.version(twin, None)?;
        }
        let config = Config {
            cache: self.directories.twins.cache(),
            ..Config::local(self.directories.all()?, Arc::from(self.backend.backend()?))
        };
        serve(config, self.twin.as_deref(), !self.no_open)
    }
}

/// Serves the viewer until Ctrl-C. The page shows the twin, or the list of all.
pub(super) fn serve(config: Config, twin: Option<&str>, open: bool) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let served = runtime.block_on(async {
        let stop = wildcity_server::stop_signal()?;
        let running = wildcity_server::start(config).await?;
        let place = twin.map_or(String::new(), |twin| format!("#/drive/{twin}"));
        let url = format!("{}{place}", running.page());
        writeln!(output::stdout(), "viewer at {url}")?;
        if open {
            open_browser(&url);
        }
        stop.await;
        running.stop().await;
        Ok(())
    });
    runtime.shutdown_timeout(crate::cli::limits::SHUTDOWN_TIMEOUT);
    served
}

/// Opens a URL in the user's browser, if there is a screen. The URL has been printed, so a failure
/// is no error.
fn open_browser(url: &str) {
    let opener = match env::consts::OS {
        "macos" => "open",
        "windows" => "explorer",
        _ if env::var_os("DISPLAY").is_none() && env::var_os("WAYLAND_DISPLAY").is_none() => return,
        _ => "xdg-open",
    };
    let mut command = Command::new(opener);
    command.arg(url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    if let Err(error) = command.spawn() {
        tracing::debug!("{opener} did not start: {error}");
    }
}
