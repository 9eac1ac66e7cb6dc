//! `wildcity serve`.

use std::io::{self, IsTerminal, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use tracing_subscriber::EnvFilter;

use wildcity_server::{Limits, Tokens};
use wildcity_twin::ingest;

use super::backend_options::{BackendOptions, bytes_of_gib, gib};
use super::directories::{Episodes, Twins, Uploads};
use super::profile_options::read_profile;

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

    #[command(flatten)]
    uploads: Uploads,

    /// JSON file of who may do what (see below); without it the server listens on this machine alone.
    #[arg(long, value_name = "FILE")]
    tokens: Option<PathBuf>,

    /// Address and port to listen on; port 0 takes a free one. Not loopback only with --tokens.
    #[arg(long, value_name = "ADDR", default_value = wildcity_server::limits::LISTEN, value_parser = address)]
    listen: SocketAddr,

    /// Memory that the Gaussians of all twins may take, in GiB, as 2 or 0.5 [default: three quarters of
    /// the machine's]. A session is refused if its largest frame does not fit beside those of others;
    /// whatever else fits is kept for the frames to come.
    #[arg(long, value_name = "N", value_parser = gib)]
    memory_gib: Option<f64>,

    /// JSON file of fields of the render profile that every session gets instead of its twin's, as
    /// `wildcity report` writes it: {"tau_px": 2.0}. A session may ask for others.
    #[arg(long, value_name = "FILE")]
    profile: Option<PathBuf>,

    #[command(flatten)]
    backend: BackendOptions,

    /// What to log, as `warn` or `wildcity=debug` [default: $RUST_LOG, or info]
    #[arg(long, value_name = "FILTER")]
    log: Option<String>,
}

const EXAMPLES: &str = "\
Examples:
  wildcity serve
  wildcity serve --memory-gib 2
  wildcity serve --twins ./twins --listen 127.0.0.1:0 --log debug
  wildcity serve --tokens tokens.json --listen 0.0.0.0:8080
  curl http://127.0.0.1:8080/v1/twins

Tokens file: role is drive (sessions), push (uploads and pushes) or admin (everything). Give a token
itself, 16 characters and more, or hash: blake3: or sha-256: and its hash in hex. twins is which twins
it sees; all if it is left out.
  {\"tokens\": [
    {\"name\": \"fleet\", \"role\": \"drive\", \"token\": \"u3mR8qkV0aXn2wLc\", \"twins\": [\"street\"]},
    {\"name\": \"trainer\", \"role\": \"push\", \"hash\": \"sha-256:9f86d081884c7d659a2feaa0c55ad015...\"}]}";

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
        let tokens = self.tokens.as_deref().map(read_tokens).transpose()?;
        let config = wildcity_server::Config {
            listen: self.listen,
            twins,
            cache: self.twins.cache(),
            episodes: self.episodes.dir()?,
            uploads: self.uploads.dir()?,
            tokens,
            backend: Arc::from(self.backend.backend()?),
            profile: self.profile.as_deref().map(read_profile).transpose()?.unwrap_or_default(),
            limits: Limits {
                resident_bytes: self.memory_gib.map(bytes_of_gib),
                ..Limits::default()
            },
        };
        tracing::info!(twins = %config.twins.display(), episodes = %config.episodes.display(), "serving");
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let served = runtime.block_on(async {
            // Before anybody is told of the server: they may tell it to stop at once.
            let stop = wildcity_server::stop_signal()?;
            let running = wildcity_server::start(config).await?;
            writeln!(io::stdout(), "listening on {}", running.url())?;
            stop.await;
            tracing::info!("stopping");
            running.stop().await;
            Ok(())
        });
        // A push that still writes is not waited for: killed at any point, it leaves nothing.
        runtime.shutdown_background();
        served
    }
}

fn read_tokens(path: &Path) -> anyhow::Result<Tokens> {
    let cannot = || format!("--tokens {}", path.display());
    let text = ingest::read_whole(path, wildcity_server::limits::TOKENS_FILE_BYTES)
        .with_context(cannot)?;
    Tokens::parse(&text).with_context(cannot)
}

fn address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| "expected an address and a port, as 127.0.0.1:8080".to_owned())
}
