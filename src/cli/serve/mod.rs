//! `wildcity serve`.

mod check;
mod config_file;
mod limit_options;
mod log;

use std::io::Write;
use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::Context as _;

#[cfg(feature = "alpasim")]
use wildcity_alpasim::sensorsim;
use wildcity_server::{Origins, TlsFiles, Tokens};
use wildcity_twin::residency::default_memory_bytes;
use wildcity_twin::store::DamagedTwin;

use limit_options::{LimitOptions, bytes_as_gib};

use super::backend_options::{BackendOptions, Devices, bytes_of_gib, gib};
use super::directories::ServerDirectories;
use super::left_out::built_without;
use super::profile_options::read_profile;
use super::repair_options::{RepairOptions, runtime_library};
use crate::cli::{browser, output};

/// Serve twins to agents over WebSocket.
///
/// Prints `listening on ws://HOST:PORT/v1/session` when agents can connect, and logs to standard
/// error. Ctrl-C or SIGTERM lets sessions go on for --sessions-end-s, then running steps finish,
/// and stops.
///
/// Every option can also be set in a TOML file: --memory-gib is memory_gib there. --print-config
/// prints all of them, also those that only --help-all shows: the table [limits] has time-outs,
/// counts and bytes. A flag overrides the file, and the file overrides a default.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Serve {
    /// Twin whose page --open shows; without it, the page lists all.
    #[arg(value_name = "TWIN", requires = "open")]
    twin: Option<String>,

    /// Open the viewer in the browser, to look at a twin and to drive by hand.
    #[arg(long)]
    open: bool,

    /// TOML file of options; `wildcity serve --print-config` prints one.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,

    /// Print every option that is in effect with its meaning, as a file for --config, and exit.
    #[arg(long)]
    print_config: bool,

    #[command(flatten)]
    directories: ServerDirectories,

    /// Export each episode as MCAP when it ends, next to its record: for Foxglove, Rerun and
    /// others. The export takes additional disk space of about half the size of the record, and no
    /// step waits for it.
    #[arg(long, value_name = "BOOL", action = clap::ArgAction::Set, default_value_t = wildcity_episode::CAN_EXPORT, num_args = 0..=1, default_missing_value = "true")]
    mcap: bool,

    /// JSON file of tokens and what each allows: {"tokens": [{"name": "fleet", "role": "drive",
    /// "token": "TOKEN"}]}. role is metrics, drive, push or admin. hash may replace token. twins
    /// lists the twins that the token may use. limits are its largest numbers at a time: sessions,
    /// connections, pushes, upload_bytes. The file is read again at SIGHUP. Without it, the server
    /// listens only on a loopback address. docs/operators.md says more.
    #[arg(long, value_name = "FILE")]
    tokens: Option<PathBuf>,

    /// PEM file with the certificate of the server, followed by those of its authorities. The
    /// server then uses HTTPS, with the key of --tls-key. Both files are read again at SIGHUP.
    #[arg(long, value_name = "FILE")]
    tls_cert: Option<PathBuf>,

    /// PEM file with the key of the certificate.
    #[arg(long, value_name = "FILE")]
    tls_key: Option<PathBuf>,

    /// Origins of web pages of other sites that may send requests, separated by commas, for example
    /// https://sim.example.org; pages of this machine always may. With this option, the server
    /// answers only requests to these hosts, to localhost and, with tokens, to its addresses: list
    /// the server's own host name, too.
    #[arg(long, value_name = "ORIGINS", value_parser = origins)]
    origin: Option<Origins>,

    /// File of the audit log: which token pushed, edited or rolled back which twin, one JSON object
    /// per line. A change that cannot be logged is refused. At 64 MiB the file is renamed to
    /// FILE.1, an earlier FILE.1 to FILE.2, and so on; eight of these are kept.
    #[arg(long, value_name = "FILE")]
    audit_log: Option<PathBuf>,

    /// Address and port to listen on; port 0 selects a free one. An address that is not loopback
    /// needs --tokens.
    #[arg(long, value_name = "ADDR", default_value = wildcity_server::limits::LISTEN, value_parser = address)]
    listen: SocketAddr,

    /// Address and port of a second listener, for Prometheus and probes: /metrics, /healthz and
    /// /readyz, without TLS and without tokens. The metrics name no twin and no token.
    #[arg(long, value_name = "ADDR", value_parser = address)]
    metrics_listen: Option<SocketAddr>,

    /// Address and port of another listener, for AlpaSim: the gRPC service `sensorsim`, through
    /// which AlpaSim uses the twins as scenes of its renderer. AlpaSim sends no tokens.
    #[arg(long, value_name = "ADDR", value_parser = address)]
    alpasim: Option<SocketAddr>,

    /// Allow an address of --alpasim that is not loopback: every machine that can connect to it can
    /// then read the twins.
    #[arg(long, value_name = "BOOL", action = clap::ArgAction::Set, default_value_t = false, num_args = 0..=1, default_missing_value = "true")]
    alpasim_open: bool,

    /// Refuse shared memory to clients on this machine: they then receive observations through the
    /// socket only.
    #[arg(long, hide = true, value_name = "BOOL", action = clap::ArgAction::Set, default_value_t = false, num_args = 0..=1, default_missing_value = "true")]
    no_shared_memory: bool,

    /// Memory for the Gaussians of all twins and for the frames that are rendered from them, in
    /// GiB, for example 2 or 0.5 [default: three quarters of the machine's]. A session is refused
    /// if its largest frame does not fit into memory together with those of the other sessions; the
    /// rest of the memory is a cache for later frames.
    #[arg(long, value_name = "N", value_parser = gib)]
    memory_gib: Option<f64>,

    /// JSON file of render profile fields that replace those of every twin, for example {"tau_px":
    /// 2.0}; `wildcity report` writes such files. A session may request other values.
    #[arg(long, value_name = "FILE")]
    profile: Option<PathBuf>,

    #[command(flatten)]
    backend: BackendOptions,

    #[command(flatten)]
    devices: Devices,

    #[command(flatten)]
    repair: RepairOptions,

    /// What to log, for example `warn` or `wildcity=debug` [default: $RUST_LOG, or info]
    #[arg(long, value_name = "FILTER")]
    log: Option<String>,

    /// How to write the log.
    #[arg(long, hide = true, value_enum, value_name = "FORMAT", default_value_t)]
    log_format: log::LogFormat,

    /// OpenTelemetry collector that receives traces of requests and pushes, by OTLP over HTTP, for
    /// example http://127.0.0.1:4318. Needs a program built with the feature otlp.
    #[arg(long, hide = true, value_name = "URL")]
    otlp_endpoint: Option<String>,

    #[command(flatten)]
    limits: LimitOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity serve
  wildcity serve --open street
  wildcity serve --memory-gib 2
  wildcity serve --twins ./twins --listen 127.0.0.1:0 --log debug
  wildcity serve --tokens tokens.json --listen 0.0.0.0:8080
  wildcity serve --tokens tokens.json --listen 0.0.0.0:8443 --tls-cert cert.pem --tls-key key.pem
  wildcity serve --repair zero-dce.json,deblur.json --onnxruntime libonnxruntime.so.1.32.0
  wildcity serve --print-config > serve.toml
  wildcity serve --config serve.toml --sessions 16
  curl http://127.0.0.1:8080/v1/twins

Tokens file: role is metrics (GET /metrics only), drive (sessions), push (sessions, uploads and pushes) or
admin (everything). Give token, of at least 16 characters, or hash: blake3: or sha-256:, then the token's
hash in hex. twins lists the twins that the token may use; without the list it may use all. limits are its
largest numbers at a time: sessions, connections, pushes, upload_bytes.
  openssl rand -base64 24                 makes a TOKEN
  printf %s TOKEN | sha256sum             prints its HASH
  {\"tokens\": [
    {\"name\": \"fleet\", \"role\": \"drive\", \"token\": \"TOKEN\", \"twins\": [\"street\"]},
    {\"name\": \"trainer\", \"role\": \"push\", \"hash\": \"sha-256:HASH\"}]}";

impl Serve {
    pub(super) fn run(self) -> anyhow::Result<()> {
        // The arguments after `wildcity serve` are parsed again, after those of the file.
        let resolved = config_file::resolve(std::env::args_os().skip(2).collect())?;
        if resolved.serve.print_config {
            write!(output::stdout(), "{}", resolved.to_toml()?)?;
            return Ok(());
        }
        resolved.serve.serve()
    }

    /// The value of an option that was not given and has no fixed default, as text; none if it has
    /// no effect.
    fn default_value(&self, id: &str) -> anyhow::Result<Option<String>> {
        let text = |path: PathBuf| Some(path.display().to_string());
        Ok(match id {
            "twins" => text(self.directories.twins.dir()?),
            "episodes" => text(self.directories.episodes.dir()?),
            "scenarios" => text(self.directories.scenarios.dir()?),
            "uploads" => text(self.directories.uploads.dir()?),
            "cache_dir" => self.directories.twins.cache().and_then(|cache| text(cache.dir)),
            "onnxruntime" => text(runtime_library(None)).filter(|path| !path.is_empty()),
            "memory_gib" => Some(bytes_as_gib(default_memory_bytes()).to_string()),
            "log" => Some(self.log_filter()),
            _ => None,
        })
    }

    fn log_filter(&self) -> String {
        let log = self.log.clone().or_else(|| std::env::var("RUST_LOG").ok());
        log.unwrap_or_else(|| "info".to_owned())
    }

    /// Checks that this build has what the options need. TLS and object stores say it themselves.
    fn check_features(&self) -> anyhow::Result<()> {
        let needed = [
            ("--mcap", self.mcap, "mcap", wildcity_episode::CAN_EXPORT),
            ("--alpasim", self.alpasim.is_some(), "alpasim", cfg!(feature = "alpasim")),
            ("--alpasim-open", self.alpasim_open, "alpasim", cfg!(feature = "alpasim")),
        ];
        for (option, is_given, feature, is_built) in needed {
            anyhow::ensure!(is_built || !is_given, "{option}: {}", built_without(feature));
        }
        Ok(())
    }

    fn serve(self) -> anyhow::Result<()> {
        // Dropped last, so that the end of the server is traced, too.
        let _traces =
            log::start(&self.log_filter(), self.log_format, self.otlp_endpoint.as_deref())?;
        self.check_features()?;
        let directories = self.directories.all()?;
        let twins = &directories.twins;
        anyhow::ensure!(
            !twins.exists() || twins.is_dir(),
            "--twins {} is not a directory",
            twins.display()
        );
        let catalog = self.directories.twins.catalog()?;
        if let Some(twin) = &self.twin {
            // An unknown or damaged twin is reported here, and not by the page.
            catalog.version(twin, None)?;
        }
        // A damaged twin is reported and left out: the others are served.
        let found = catalog.twins()?;
        for DamagedTwin { name, error } in &found.damaged {
            tracing::error!(twin = name, "damaged, not served: {error}");
        }
        if found.twins.is_empty() {
            let dir = twins.display();
            tracing::warn!("no twins in {dir}: wildcity import or wildcity demo makes one");
        }
        if let Some(dir) = self.directories.scenarios.missing() {
            tracing::warn!("scenarios: there is no directory {}", dir.display());
        }
        let tokens = self
            .tokens
            .as_deref()
            .map(|path| Tokens::read(path).with_context(|| format!("--tokens {}", path.display())))
            .transpose()?;
        let tls = match (self.tls_cert, self.tls_key) {
            (Some(cert), Some(key)) => Some(TlsFiles { cert, key }),
            (None, None) => None,
            (Some(_), None) => {
                anyhow::bail!("--tls-cert needs --tls-key, the key of the certificate")
            }
            (None, Some(_)) => {
                anyhow::bail!("--tls-key needs --tls-cert, the certificate of the key")
            }
        };
        let config = wildcity_server::Config {
            listen: self.listen,
            cache: self.directories.twins.cache(),
            metrics_listen: self.metrics_listen,
            directories,
            tokens,
            origins: self.origin.unwrap_or_default(),
            tls,
            audit: self.audit_log,
            mcap: self.mcap,
            backend: self.backend.backend_on(&self.devices)?,
            repairs: self.repair.models()?,
            profile: self.profile.as_deref().map(read_profile).transpose()?.unwrap_or_default(),
            shared_memory: !self.no_shared_memory,
            limits: self.limits.limits(self.memory_gib.map(bytes_of_gib)),
        };
        let served = &config.directories;
        tracing::info!(twins = %served.twins.display(), episodes = %served.episodes.display(), "serving");
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let served = runtime.block_on(async {
            // Before the address is printed: the signal may come right after.
            let stop = wildcity_server::stop_signal()?;
            let running = wildcity_server::start(config).await?;
            #[cfg(feature = "alpasim")]
            let alpasim = match self.alpasim {
                Some(listen) => {
                    let engine = running.engine().clone();
                    Some(sensorsim::start(engine, listen, self.alpasim_open).await?)
                }
                None => None,
            };
            writeln!(output::stdout(), "listening on {}", running.url())?;
            #[cfg(feature = "alpasim")]
            if let Some(alpasim) = &alpasim {
                writeln!(output::stdout(), "AlpaSim: listening on {}", alpasim.address())?;
            }
            if self.open {
                browser::open(&running, self.twin.as_deref())?;
            } else {
                tracing::info!("viewer at {}", running.page());
            }
            if let Some(address) = running.metrics_address() {
                tracing::info!("metrics at http://{address}/metrics");
            }
            stop.await;
            // A second signal ends the wait for running sessions.
            let again = wildcity_server::stop_signal()?;
            tokio::select! {
                () = running.end_sessions() => {}
                () = again => {}
            }
            tracing::info!("stopping");
            #[cfg(feature = "alpasim")]
            if let Some(alpasim) = alpasim {
                alpasim.stop().await;
            }
            running.stop().await;
            Ok(())
        });
        // A push that still writes after that is abandoned: a commit that is killed at any point
        // leaves nothing.
        runtime.shutdown_timeout(crate::cli::limits::SHUTDOWN_TIMEOUT);
        served
    }
}

fn address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| "expected an address and a port, as 127.0.0.1:8080".to_owned())
}

fn origins(text: &str) -> Result<Origins, String> {
    let listed = text.split(',').map(|origin| origin.trim().to_owned()).collect();
    Origins::new(listed).map_err(|error| error.to_string())
}
