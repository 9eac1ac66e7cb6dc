//! `wildcity serve`.

use std::io::{self, IsTerminal, Write};
use std::net::SocketAddr;
use std::sync::Arc;

use tracing_subscriber::EnvFilter;

use crate::config;
use crate::server::{self, Limits};

use super::places::{Episodes, Twins};
use super::scene_source::Engine;

/// Serve twins to agents over WebSocket.
///
/// Prints `listening on ws://HOST:PORT/v1/session` when agents can connect, and logs to standard
/// error. Ctrl-C or SIGTERM lets running steps finish, then stops.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Serve {
    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    episodes: Episodes,

    /// Loopback address and port to listen on; port 0 takes a free one.
    #[arg(long, value_name = "ADDR", default_value = config::LISTEN, value_parser = address)]
    listen: SocketAddr,

    /// Memory that all twins in use may take, in GiB [default: three quarters of the machine's]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=65_536))]
    memory_gib: Option<u32>,

    #[command(flatten)]
    engine: Engine,

    /// What to log, as `warn` or `wildcity=debug` [default: $RUST_LOG, or info]
    #[arg(long, value_name = "FILTER")]
    log: Option<String>,
}

const EXAMPLES: &str = "\
Examples:
  wildcity serve
  wildcity serve --twins ./twins --listen 127.0.0.1:0 --log debug
  curl http://127.0.0.1:8080/v1/twins";

impl Serve {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let log = self.log.or_else(|| std::env::var("RUST_LOG").ok());
        let filter = EnvFilter::try_new(log.as_deref().unwrap_or("info"))?;
        tracing_subscriber::fmt()
            .with_env_filter(filter)
            .with_writer(io::stderr)
            .with_ansi(io::stderr().is_terminal())
            .init();
        let twins = self.twins.dir()?;
        anyhow::ensure!(
            !twins.exists() || twins.is_dir(),
            "--twins {} is not a directory",
            twins.display()
        );
        if self.twins.catalog()?.twins()?.is_empty() {
            let dir = twins.display();
            tracing::warn!("no twins in {dir}: wildcity import or wildcity demo makes one");
        }
        let config = server::Config {
            listen: self.listen,
            twins,
            cache: self.twins.cache(),
            episodes: self.episodes.dir()?,
            backend: Arc::from(self.engine.backend()?),
            limits: Limits {
                resident_bytes: self.memory_gib.map(|gib| u64::from(gib) << 30),
                ..Limits::default()
            },
        };
        tracing::info!(twins = %config.twins.display(), episodes = %config.episodes.display(), "serving");
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        runtime.block_on(async {
            // Before anybody is told of the server: they may tell it to stop at once.
            let stop = server::stop_signal()?;
            let running = server::start(config).await?;
            writeln!(io::stdout(), "listening on {}", running.url())?;
            stop.await;
            tracing::info!("stopping");
            running.stop().await;
            Ok(())
        })
    }
}

fn address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| "expected an address and a port, as 127.0.0.1:8080".to_owned())
}
