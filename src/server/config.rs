//! The configuration of a server, and its limits.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use wildcity_episode::Keep;
use wildcity_push::QueueLimits;
use wildcity_render::Backend;
use wildcity_repair::Models;
use wildcity_scene::ProfileOverrides;
use wildcity_session::RecordLimits;
use wildcity_twin::residency::default_memory_bytes;
use wildcity_twin::store::DiskCacheSettings;

use crate::auth::Tokens;
use crate::limits;
use crate::origins::Origins;
use crate::tls::TlsFiles;

/// Where a server reads and writes.
#[derive(Clone, Debug)]
pub struct Directories {
    /// Directory of twins, or their URL.
    pub twins: PathBuf,
    /// Directory where episodes are recorded.
    pub episodes: PathBuf,
    /// Directory of the scenarios that can be opened by name; it need not exist.
    pub scenarios: PathBuf,
    /// Directory where uploads are kept until they are pushed. One server uses it at a time.
    pub uploads: PathBuf,
}

/// The configuration of a server.
#[derive(Clone)]
pub struct Config {
    /// Address to listen on; port 0 takes a free one. It must be a loopback address if there are no
    /// tokens.
    pub listen: SocketAddr,
    /// Where it reads and writes.
    pub directories: Directories,
    /// Where parts of twins at a URL are kept on disk.
    pub cache: Option<DiskCacheSettings>,
    /// Address of a second listener, which answers `/metrics`, `/healthz` and `/readyz` without
    /// TLS and without tokens.
    pub metrics_listen: Option<SocketAddr>,
    /// The tokens of clients; without tokens every client may do everything.
    pub tokens: Option<Tokens>,
    /// Web pages of other sites that may send requests.
    pub origins: Origins,
    /// Certificate and key; without them the server speaks plain HTTP.
    pub tls: Option<TlsFiles>,
    /// File of the audit log; `None` for no audit log.
    pub audit: Option<PathBuf>,
    /// Whether an episode that ends is also written as an MCAP file, next to its record.
    pub mcap: bool,
    pub backend: Arc<dyn Backend>,
    /// The models that can repair images, by name. Each is loaded when a session asks for it.
    pub repairs: Arc<Models>,
    /// Changes of the render profile of every twin; a session may change more.
    pub profile: ProfileOverrides,
    /// Whether clients on this machine may ask for observations in shared memory.
    pub shared_memory: bool,
    /// Time-outs, counts and bytes.
    pub limits: Limits,
}

impl Config {
    /// A server for programs of this machine, on a free port, without tokens, TLS or disk cache,
    /// with all defaults.
    pub fn local(directories: Directories, backend: Arc<dyn Backend>) -> Self {
        Self {
            // A loopback address, because there are no tokens.
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            directories,
            cache: None,
            metrics_listen: None,
            tokens: None,
            origins: Origins::default(),
            tls: None,
            audit: None,
            mcap: wildcity_episode::CAN_EXPORT,
            backend,
            repairs: Arc::default(),
            profile: ProfileOverrides::default(),
            shared_memory: true,
            limits: Limits::default(),
        }
    }
}

/// Time-outs, counts and bytes of a server. The constants in [`crate::limits`] and in the packages
/// of the protocol, the session and the push are the defaults.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Time-out for the first message of a connection.
    pub hello: Duration,
    /// Time-out for the next request.
    pub idle: Duration,
    /// Time-out for a client to read an answer.
    pub send: Duration,
    /// Time-out for one step, including the time that it waits for other sessions.
    pub step: Duration,
    /// How long a session without a connection waits to be resumed.
    pub resume_grace: Duration,
    /// How long sessions may go on after the server was asked to stop; none is opened then.
    pub sessions_end: Duration,
    /// Time-out for running steps when the server stops.
    pub drain: Duration,
    /// WebSocket connections at once.
    pub connections: usize,
    pub sessions: usize,
    /// Pushes that wait or run at once.
    pub pushes: usize,
    /// Bytes of memory that running pushes may use together; a third of `resident_bytes` if there
    /// is no value.
    pub push_memory_bytes: Option<u64>,
    /// Time-out for reading and checking one push.
    pub push: Duration,
    /// Bytes of memory that all twins in use may use together; three quarters of the machine's
    /// memory if there is no value.
    pub resident_bytes: Option<u64>,
    /// Time between two returns of free memory to the operating system, while sections are evicted
    /// or pushes run.
    pub memory_release: Duration,
    pub spool: SpoolLimits,
    /// Bytes of the records of episodes.
    pub records: RecordLimits,
    /// Which records stay; the others are removed. By default all.
    pub keep_records: Keep,
}

/// Limits of uploads. The constants in [`crate::limits`] are the defaults.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpoolLimits {
    /// Uploads at once, finished or not.
    pub uploads: usize,
    /// Bytes of the largest upload.
    pub upload_bytes: u64,
    /// Bytes of all uploads.
    pub bytes: u64,
    /// Bytes of the uploads of one token; if there is no value, half of all if several tokens may
    /// upload.
    pub token_bytes: Option<u64>,
    /// How long an upload is kept after its last byte.
    pub age: Duration,
}

impl Limits {
    /// The limits of the pushes.
    pub(crate) fn queue(&self) -> QueueLimits {
        // The share follows the memory for twins, so that one flag scales both.
        let twins_bytes = self.resident_bytes.unwrap_or_else(default_memory_bytes);
        let share_bytes = twins_bytes / wildcity_push::limits::MEMORY_SHARE_OF_TWINS;
        QueueLimits {
            open: self.pushes,
            memory_bytes: self.push_memory_bytes.unwrap_or(share_bytes),
            check_timeout: self.push,
        }
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            // Limits that a client has to know are those of the protocol.
            hello: wildcity_protocol::limits::HELLO_TIMEOUT,
            idle: limits::IDLE_TIMEOUT,
            send: wildcity_protocol::limits::SEND_TIMEOUT,
            step: wildcity_protocol::limits::STEP_TIMEOUT,
            resume_grace: limits::RESUME_GRACE,
            sessions_end: Duration::ZERO,
            drain: limits::DRAIN_TIMEOUT,
            connections: limits::CONNECTIONS,
            sessions: wildcity_session::limits::SESSIONS,
            pushes: wildcity_push::limits::OPEN_PUSHES,
            push_memory_bytes: None,
            push: wildcity_push::limits::CHECK_TIMEOUT,
            resident_bytes: None,
            memory_release: limits::MEMORY_RELEASE,
            spool: SpoolLimits::default(),
            records: RecordLimits {
                bytes: limits::RECORDS_BYTES,
                owner_bytes: limits::TOKEN_RECORDS_BYTES,
            },
            keep_records: Keep::default(),
        }
    }
}

impl Default for SpoolLimits {
    fn default() -> Self {
        Self {
            uploads: limits::UPLOADS,
            upload_bytes: limits::UPLOAD_BYTES,
            bytes: limits::SPOOL_BYTES,
            token_bytes: None,
            age: limits::UPLOAD_AGE,
        }
    }
}

impl std::fmt::Debug for Config {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // Taken apart by name, so that a field that is added has to be decided on here: tokens must
        // not be printed.
        let Self {
            listen,
            directories,
            cache,
            metrics_listen,
            tokens,
            origins,
            tls,
            audit,
            mcap,
            backend,
            repairs,
            profile,
            shared_memory,
            limits,
        } = self;
        f.debug_struct("Config")
            .field("listen", listen)
            .field("directories", directories)
            .field("cache", cache)
            .field("metrics_listen", metrics_listen)
            .field("tokens", &tokens.is_some())
            .field("origins", origins)
            .field("tls", tls)
            .field("audit", audit)
            .field("mcap", mcap)
            .field("backend", &backend.name())
            .field("repairs", &repairs.names().collect::<Vec<_>>())
            .field("profile", profile)
            .field("shared_memory", shared_memory)
            .field("limits", limits)
            .finish()
    }
}
