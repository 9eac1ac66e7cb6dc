//! The viewer in the user's browser.

use std::env;
use std::io::Write;
use std::process::{Command, Stdio};

use wildcity_server::{Config, Running};

use crate::cli::output;

/// Serves the viewer until Ctrl-C, and opens the page of a twin.
pub(super) fn serve(config: Config, twin: &str) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let served = runtime.block_on(async {
        let stop = wildcity_server::stop_signal()?;
        let running = wildcity_server::start(config).await?;
        open(&running, Some(twin))?;
        stop.await;
        running.stop().await;
        Ok(())
    });
    runtime.shutdown_timeout(crate::cli::limits::SHUTDOWN_TIMEOUT);
    served
}

/// Prints the URL of the viewer, and opens it. The page shows the twin, or the list of all.
pub(super) fn open(running: &Running, twin: Option<&str>) -> anyhow::Result<()> {
    let place = twin.map_or(String::new(), |twin| format!("#/drive/{twin}"));
    let url = format!("{}{place}", running.page());
    writeln!(output::stdout(), "viewer at {url}")?;
    open_browser(&url);
    Ok(())
}

/// Opens a URL in the user's browser, if there is a screen. The URL has been printed, so a failure
/// is no error.
fn open_browser(url: &str) {
    let opener = match env::consts::OS {
        "macos" => "open",
        "windows" => "explorer",
        // Without a display xdg-open would start a browser of the terminal, over the output.
        _ if env::var_os("DISPLAY").is_none() && env::var_os("WAYLAND_DISPLAY").is_none() => return,
        _ => "xdg-open",
    };
    let mut command = Command::new(opener);
    // Browsers write warnings to the terminal that started them.
    command.arg(url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    // Only a note: the address was printed, and can be opened by hand.
    if let Err(error) = command.spawn() {
        tracing::debug!("{opener} did not start: {error}");
    }
}
