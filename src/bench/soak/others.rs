//! The other load on a server in a mixed soak: pushes with garbage collection, damaged requests,
//! and clients that do not read. None of it may disturb the agents.

use std::fs;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use glam::DVec3;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};

use wildcity_client::protocol::error::Code;
use wildcity_client::protocol::message::{Encoding, Outputs, RigChoice};
use wildcity_client::{
    Client, ClientError, ConnectOptions, HttpClient, NewPush, Open, Pose, PreviewRequest, PushFile,
    PushState,
};
use wildcity_scene::random::Random;
use wildcity_twin::store::{Catalog, Retention};

/// Pauses between two pushes, two damaged requests and two clients that do not read.
const PUSH_EVERY: Duration = Duration::from_secs(10);
const DAMAGED_EVERY: Duration = Duration::from_millis(100);
const UNREAD_EVERY: Duration = Duration::from_secs(1);
/// Time that a client that does not read has for its request, and time that it stays afterwards.
const UNREAD_AFTER: Duration = Duration::from_millis(2);
const UNREAD_FOR: Duration = Duration::from_secs(20);
/// How long the server may take to answer a damaged request or to close its connection.
const REFUSED_WITHIN: Duration = Duration::from_secs(60);
/// Gaussians of a push.
const PUSHED: usize = 20_000;
/// Versions that garbage collection keeps in addition to those in use.
const KEPT: Retention = Retention { versions: 2, grace: Duration::from_secs(1) };

/// Copies a twin into an empty directory of twins, so that pushes to it leave the user's own as it
/// is.
pub(super) fn copy_twin(from: &Path, to: &Path, twin: &str) -> anyhow::Result<()> {
    let source = from.join(twin);
    anyhow::ensure!(
        source.is_dir(),
        "--mixed copies the twin, and {} is not a directory: give --twins DIR, not a URL",
        source.display(),
    );
    copy_directory(&source, &to.join(twin)).with_context(|| format!("cannot copy twin {twin:?}"))
}

fn copy_directory(from: &Path, to: &Path) -> io::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            copy_directory(&entry.path(), &target)?;
        } else {
            fs::copy(entry.path(), target)?;
        }
    }
    Ok(())
}

/// Pushes a scene to the twin again and again, each time a different one, and collects the garbage
/// of earlier versions.
pub(super) struct Pusher {
    pub(super) url: String,
    pub(super) catalog: Catalog,
    pub(super) twin: String,
    /// Middle of the pushed scene.
    pub(super) at_m: DVec3,
    pub(super) scratch: PathBuf,
    pub(super) until: Instant,
}

impl Pusher {
    /// Returns the number of versions that were made.
    ///
    /// # Errors
    /// A push is refused or fails, or garbage cannot be collected.
    pub(super) async fn run(self) -> anyhow::Result<u64> {
        let client = HttpClient::new(&self.url, &ConnectOptions::default())?;
        let mut pushes = 0;
        while Instant::now() < self.until {
            let path = self.scratch.join("pushed.splat");
            let file = path.clone();
            let write = move || fs::write(file, splat(self.at_m, pushes));
            tokio::task::spawn_blocking(write).await??;
            let upload = client.upload(&path, &mut |_, _| ()).await?;
            let axes = Some("identity".to_owned());
            let file = PushFile { upload: upload.id, axes, scale: Some(1.0), name: None };
            let push = NewPush {
                id: None,
                files: vec![file],
                frame: None,
                base: None,
                cells: None,
                record: None,
                levels: true,
                profile: Vec::new(),
                note: Some(format!("push {pushes} of a soak")),
                preview: PreviewRequest::default(),
                drop_bad: false,
            };
            let begun = client.push(&self.twin, &push).await?;
            let ended = client.wait_for_push(begun, &mut |_| ()).await?;
            let why = ended.error.map_or_else(String::new, |error| error.message);
            anyhow::ensure!(
                ended.state == PushState::Ready,
                "push {pushes} ended without a version: {why}"
            );
            let catalog = self.catalog.clone();
            let twin = self.twin.clone();
            tokio::task::spawn_blocking(move || catalog.collect(&twin, KEPT, false)).await??;
            pushes += 1;
            sleep(PUSH_EVERY.min(self.until.saturating_duration_since(Instant::now()))).await;
        }
        Ok(pushes)
    }
}

/// A scene of grey points in a box of 20 m, in antimatter15's format: mean and scale as f32, then
/// colour, opacity and rotation as u8.
fn splat(middle_m: DVec3, seed: u64) -> Vec<u8> {
    let mut random = Random::new(seed, "soak", 0);
    let mut bytes = Vec::with_capacity(32 * PUSHED);
    for _ in 0..PUSHED {
        let mean_m = middle_m.to_array().map(|middle| (middle + random.range(-10.0, 10.0)) as f32);
        for number in mean_m.into_iter().chain([0.1; 3]) {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend([128, 128, 128, 200, 255, 128, 128, 128]);
    }
    bytes
}

/// Sends damaged requests, one connection each, and returns their number.
///
/// # Errors
/// The server takes no connection, or neither answers nor closes one.
pub(super) async fn send_damaged(address: SocketAddr, until: Instant) -> anyhow::Result<u64> {
    let mut random = Random::new(0, "damaged", 0);
    let mut sent = 0;
    while Instant::now() < until {
        let mut stream = TcpStream::connect(address).await.context("no connection")?;
        // The server may close the connection before it has read all of it.
        let _ = stream.write_all(&damaged(&mut random)).await;
        let _ = stream.shutdown().await;
        let mut answer = [0; 4096];
        let heard = timeout(REFUSED_WITHIN, stream.read(&mut answer)).await;
        anyhow::ensure!(
            heard.is_ok(),
            "damaged request {sent}: no answer and no end within {REFUSED_WITHIN:?}"
        );
        sent += 1;
        sleep(DAMAGED_EVERY).await;
    }
    Ok(sent)
}

/// A request that is cut off, has random bytes, or is text that is not a request of the protocol.
fn damaged(random: &mut Random) -> Vec<u8> {
    const UPGRADE: &str = "GET /v1/session HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\n\
        Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\
        Sec-WebSocket-Protocol: wildcity.v1\r\n\r\n";
    const UPLOAD: &str = "POST /v1/uploads HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n\
        Content-Length: 60\r\n\r\n{\"name\":\"a.ply\",\"size\":-1,\"digest\":\"blake3:0\"}             ";
    let mut bytes = match random.below(4) {
        0 => Vec::new(),
        1 => UPGRADE.into(),
        2 => UPLOAD.into(),
        _ => UPGRADE[..random.below(UPGRADE.len())].into(),
    };
    let garbage = random.below(2_000);
    bytes.extend((0..garbage).map(|_| random.below(256) as u8));
    bytes
}

/// Opens sessions with large images, asks for one and does not read the answer. Returns how many.
///
/// # Errors
/// The server refuses a session for another reason than its limits.
pub(super) async fn leave_unread(
    url: String,
    twin: String,
    version: u64,
    pose: Pose,
    until: Instant,
) -> anyhow::Result<u64> {
    let mut unread = 0;
    while Instant::now() < until {
        let mut client = Client::connect(&url, "wildcity-bench soak, not reading").await?;
        let outputs = Outputs { encoding: Encoding::Raw, ..Outputs::default() };
        let rig = Some(RigChoice::Preset("vehicle6".to_owned()));
        let open = Open { rig, outputs, version: Some(version), ..Open::twin(&twin) };
        match client.open(open).await {
            Ok(_) => {
                // The request is sent, and the future that would read the answer is dropped.
                match timeout(UNREAD_AFTER, client.step(pose)).await {
                    Err(_) => unread += 1,
                    Ok(answer) => drop(answer.context("a client that does not read")?),
                }
                sleep(UNREAD_FOR.min(until.saturating_duration_since(Instant::now()))).await;
            }
            // Earlier ones still wait to be resumed.
            Err(ClientError::Refused { code: Code::Busy, .. }) => {}
            Err(error) => return Err(error).context("a client that does not read"),
        }
        drop(client);
        sleep(UNREAD_EVERY).await;
    }
    Ok(unread)
}
