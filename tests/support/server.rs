//! A server with a synthetic renderer, and a client of raw WebSocket messages.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{Bytes, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};
use wildcity_render::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target};
use wildcity_scene::Gaussians;
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::rig::{Rig, RigCamera};
use wildcity_scene::trajectory::{Keyframe, Trajectory};
use wildcity_server::{Config, Directories, Limits, Running};
use wildcity_twin::store::{Catalog, NewVersion};

/// How long a test waits for anything before it fails.
pub(crate) const TEST_TIMEOUT: Duration = Duration::from_secs(20);

/// A backend that paints a pattern that depends only on the pose of the camera.
#[derive(Debug, Default)]
pub(crate) struct Painter {
    /// Milliseconds that a frame takes.
    pub(crate) slow_ms: AtomicU64,
    /// Whether frames that have begun do not end.
    pub(crate) held: AtomicBool,
    /// Whether the next frame crashes.
    pub(crate) crash: AtomicBool,
    /// Whether the next frame fails with `RenderError::TooMany`.
    pub(crate) too_many: AtomicBool,
    /// Frames begun.
    pub(crate) begun: AtomicU64,
}

impl Painter {
    /// The colour of one byte of an image.
    pub(crate) fn paint(world_from_camera: &Pose, index: usize) -> u8 {
        let p = world_from_camera.position_m;
        let key = p.x.to_bits() ^ p.y.to_bits().rotate_left(17) ^ p.z.to_bits().rotate_left(31);
        let key = key ^ world_from_camera.rotation.z.to_bits().rotate_left(43);
        let mixed = (key ^ index as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        (mixed >> 56) as u8
    }

    /// Waits until this number of frames has begun since the start.
    pub(crate) async fn begins(&self, frames: u64) {
        let beginning = async {
            while self.begun.load(Ordering::SeqCst) < frames {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(TEST_TIMEOUT, beginning).await.expect("a frame begins");
    }

    /// The expected image of a camera.
    pub(crate) fn image(world_from_camera: &Pose, camera: &Camera) -> Vec<u8> {
        (0..3 * camera.pixels()).map(|index| Self::paint(world_from_camera, index)).collect()
    }
}

impl Backend for Painter {
    fn name(&self) -> &'static str {
        "painter"
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        frame.check(targets)?;
        self.begun.fetch_add(1, Ordering::SeqCst);
        assert!(!self.crash.swap(false, Ordering::SeqCst), "a crash was asked for");
        if self.too_many.swap(false, Ordering::SeqCst) {
            return Err(RenderError::TooMany { what: "dots", limit: 1 });
        }
        while self.held.load(Ordering::SeqCst) {
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(self.slow_ms.load(Ordering::SeqCst)));
        for (k, (view, target)) in frame.views.iter().zip(targets).enumerate() {
            if let Some(rgb8) = target.rgb8.as_deref_mut() {
                for (index, byte) in rgb8.iter_mut().enumerate() {
                    *byte = Self::paint(&view.world_from_camera, index);
                }
            }
            if let Some(depth_m) = target.depth_m.as_deref_mut() {
                depth_m.fill(1.5 + k as f32);
            }
            if let Some(opacity) = target.opacity.as_deref_mut() {
                opacity.fill(0.25);
            }
            if let Some(normals) = target.normals.as_deref_mut() {
                normals.fill(-0.5);
            }
            if let Some(instances) = target.instances.as_deref_mut() {
                instances.fill(7 + k as u16);
            }
            if let Some(semantics) = target.semantics.as_deref_mut() {
                semantics.fill(3 + k as u8);
            }
            finished(k, target);
        }
        Ok(FrameStats { stages_ms: vec![("paint", 0.5)], ..FrameStats::default() })
    }
}

/// A directory with the twin `test`: a few Gaussians, two small cameras, 9 m of road.
pub(crate) fn twins() -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a temporary directory");
    commit_twin(dir.path());
    dir
}

/// Commits a version of the twin `test`.
pub(crate) fn commit_twin(dir: &Path) {
    commit_twin_with_opacity(dir, 2.0);
}

/// As [`commit_twin`], with Gaussians of this opacity before the sigmoid: another opacity makes
/// another version.
pub(crate) fn commit_twin_with_opacity(dir: &Path, logit_opacity: f32) {
    commit_twin_to(&Catalog::open(dir).expect("a directory"), logit_opacity);
}

/// As [`commit_twin_with_opacity`], to a catalog.
pub(crate) fn commit_twin_to(catalog: &Catalog, logit_opacity: f32) {
    let gaussians = Gaussians {
        sh_degree: 0,
        means_m: (0..64).map(|i| [f64::from(i), f64::from(i % 5) - 2.0, 1.0]).collect(),
        quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; 64],
        ln_scales: vec![[-1.0; 3]; 64],
        logit_opacities: vec![logit_opacity; 64],
        sh: (0..64 * 3).map(|i| (i % 7) as f32 * 0.3 - 0.9).collect(),
        ..Gaussians::default()
    };
    let keyframe = |i: i64| Keyframe {
        time_us: 100_000 * i,
        world_from_rig: Pose {
            position_m: DVec3::new(i as f64, 0.0, 0.0),
            rotation: DQuat::IDENTITY,
        },
    };
    let log = Trajectory { name: "log".to_owned(), keyframes: (0..10).map(keyframe).collect() };
    let new = NewVersion {
        rig: Some(rig()),
        trajectories: vec![log],
        ..NewVersion::from_gaussians("test", &gaussians, Provenance::new("test".to_owned()))
    };
    catalog.commit(new, &mut |_, _| {}).expect("a twin");
}

/// The cameras of the twin `test`: `front`, 8 x 6 px, and `rear`, 5 x 4 px.
pub(crate) fn rig() -> Rig {
    let camera = |name: &str, width_px, height_px, yaw_rad: f64| {
        // Camera axes are x right, y down, z forward; rig axes x forward, y left, z up.
        let forward = DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5);
        let pinhole = Pinhole { fx: 10.0, fy: 10.0, cx: 4.0, cy: 3.0 };
        let rig_from_camera = Pose {
            position_m: DVec3::new(0.5, 0.0, 1.5),
            rotation: DQuat::from_rotation_z(yaw_rad) * forward,
        };
        RigCamera::new(name, Camera::from_pinhole(width_px, height_px, pinhole), rig_from_camera)
    };
    let cameras = vec![camera("front", 8, 6, 0.0), camera("rear", 5, 4, std::f64::consts::PI)];
    Rig::new("pair", cameras)
}

/// A server in this process.
pub(crate) struct TestServer {
    pub(crate) running: Running,
    pub(crate) painter: Arc<Painter>,
    pub(crate) twins: tempfile::TempDir,
    pub(crate) episodes: tempfile::TempDir,
}

/// The directories of a server that reads those twins and records there.
pub(crate) fn directories(twins: &Path, episodes: &Path) -> Directories {
    Directories {
        twins: twins.to_owned(),
        episodes: episodes.to_owned(),
        scenarios: twins.join(".scenarios"),
        uploads: twins.join(".uploads"),
    }
}

impl TestServer {
    /// A configuration for a second server with the same twins and recordings.
    pub(crate) fn config(&self) -> Config {
        Config::local(directories(self.twins.path(), self.episodes.path()), self.painter.clone())
    }

    pub(crate) async fn start() -> Self {
        Self::with(Limits::default()).await
    }

    pub(crate) async fn with(limits: Limits) -> Self {
        Self::configured(|config| config.limits = limits).await
    }

    pub(crate) async fn configured(change: impl FnOnce(&mut Config)) -> Self {
        let twins = twins();
        let painter = Arc::new(Painter::default());
        let episodes = tempfile::tempdir().expect("a temporary directory");
        let directories = directories(twins.path(), episodes.path());
        let mut config = Config::local(directories, painter.clone());
        change(&mut config);
        let running = wildcity_server::start(config).await.expect("a server");
        Self { running, painter, twins, episodes }
    }

    pub(crate) fn address(&self) -> SocketAddr {
        self.running.address()
    }

    /// A client that has connected and received `welcome`.
    pub(crate) async fn agent(&self) -> Agent {
        let mut agent = Agent::connect(self.address()).await;
        agent.hello().await;
        agent
    }

    /// A client that has connected and opened a session of that name, with raw images.
    pub(crate) async fn driver(&self, name: &str) -> Agent {
        let mut agent = self.agent().await;
        agent.open(json!({ "session": name, "outputs": { "encoding": "raw" } })).await;
        agent
    }

    /// Checks that the server still works, with a whole session of a new client.
    pub(crate) async fn still_serves(&self) {
        let mut agent = self.driver("still-serves").await;
        assert_eq!(agent.step(3.0).await.meta["step"], 1);
        let closed = agent.ask(json!({ "type": "close" })).await;
        assert_eq!(closed["type"], "closed", "{closed}");
    }

    /// The recorded episodes, in order of name.
    pub(crate) fn recorded(&self) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(self.episodes.path()).expect("episodes");
        let paths = entries.map(|entry| entry.expect("an entry").path());
        let is_record =
            |path: &PathBuf| path.extension().is_some_and(|extension| extension == "jsonl");
        let mut paths: Vec<_> = paths.filter(is_record).collect();
        paths.sort();
        paths
    }

    /// Waits until the first recorded episode has an end of this outcome: a moment after its
    /// session has ended.
    pub(crate) async fn record_ends_with(&self, outcome: &str) {
        let record = self.recorded()[0].clone();
        let text = || std::fs::read_to_string(&record).expect("a record");
        let ending = async {
            while !text().lines().last().is_some_and(|line| line.contains(outcome)) {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        let waited = tokio::time::timeout(TEST_TIMEOUT, ending).await;
        assert!(waited.is_ok(), "no end of outcome {outcome}: {}", text());
    }

    /// Waits until the server holds that many sessions.
    pub(crate) async fn sessions_become(&self, count: usize) {
        let reached = async {
            while self.running.sessions() != count {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        let waited = tokio::time::timeout(TEST_TIMEOUT, reached).await;
        assert!(waited.is_ok(), "{} sessions, not {count}", self.running.sessions());
    }
}

/// A client without a library, which sends exactly the bytes of the test.
pub(crate) struct Agent {
    pub(crate) socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
    pub(crate) seq: u64,
}

/// A message from the server.
#[derive(Clone, Debug)]
pub(crate) enum Reply {
    Text(Value),
    Binary(Bytes),
    Closed,
}

/// An observation, decoded with the safetensors crate.
#[derive(Clone, Debug)]
pub(crate) struct Seen {
    pub(crate) meta: Value,
    pub(crate) bytes: Bytes,
}

/// WebSocket limits that every observation fits.
pub(crate) fn client_limits() -> Option<WebSocketConfig> {
    let bytes = Some(wildcity_protocol::limits::OBSERVATION_BYTES);
    Some(WebSocketConfig::default().max_message_size(bytes).max_frame_size(bytes))
}

/// The protocol of watchers.
pub(crate) const WATCH: &str = "wildcity.watch.v1";

/// Connects to a path, or returns the status of the refusal.
pub(crate) async fn connect(
    address: SocketAddr,
    path: &str,
    protocol: &str,
    token: Option<&str>,
) -> Result<Agent, u16> {
    let mut request = format!("ws://{address}{path}").into_client_request().unwrap();
    request.headers_mut().insert("Sec-WebSocket-Protocol", protocol.parse().unwrap());
    if let Some(token) = token {
        let bearer = format!("Bearer {token}").parse().unwrap();
        request.headers_mut().insert("Authorization", bearer);
    }
    let connected =
        tokio_tungstenite::connect_async_with_config(request, client_limits(), true).await;
    match connected {
        Ok((socket, answer)) => {
            assert_eq!(answer.headers()["sec-websocket-protocol"], protocol);
            Ok(Agent { socket, seq: 0 })
        }
        Err(tokio_tungstenite::tungstenite::Error::Http(answer)) => Err(answer.status().as_u16()),
        Err(other) => panic!("{other}"),
    }
}

impl Agent {
    pub(crate) async fn connect(address: SocketAddr) -> Self {
        Self::connect_as(address, None).await
    }

    /// Connects with a token.
    pub(crate) async fn connect_as(address: SocketAddr, token: Option<&str>) -> Self {
        let connected = connect(address, "/v1/session", "wildcity.v1", token).await;
        connected.expect("a connection")
    }

    pub(crate) async fn hello(&mut self) -> Value {
        let client = json!({ "name": "test", "version": "1" });
        self.ask(json!({ "type": "hello", "client": client, "protocols": ["wildcity.v1"] })).await
    }

    /// Opens a session on the twin `test`; `more` replaces or adds fields.
    pub(crate) async fn open(&mut self, more: Value) -> Value {
        let opened = self.try_open(more).await;
        assert_eq!(opened["type"], "opened", "{opened}");
        opened
    }

    pub(crate) async fn try_open(&mut self, more: Value) -> Value {
        let mut request = json!({ "type": "open", "twin": "test" });
        let fields = request.as_object_mut().expect("an object");
        fields.extend(more.as_object().expect("an object").clone());
        self.ask(request).await
    }

    /// Steps to a place on the x axis.
    pub(crate) async fn step(&mut self, x_m: f64) -> Seen {
        self.look(json!({ "type": "step", "pose": pose(x_m) })).await
    }

    /// Sends a request with the next number; its answer is text.
    pub(crate) async fn ask(&mut self, request: Value) -> Value {
        self.send(request).await;
        match self.receive().await {
            Reply::Text(value) => value,
            other => panic!("not text: {other:?}"),
        }
    }

    /// Sends a request with the next number; its answer is an observation.
    pub(crate) async fn look(&mut self, request: Value) -> Seen {
        self.send(request).await;
        self.seen().await
    }

    pub(crate) async fn seen(&mut self) -> Seen {
        match self.receive().await {
            Reply::Binary(bytes) => Seen::decode(bytes),
            other => panic!("not an observation: {other:?}"),
        }
    }

    pub(crate) async fn send(&mut self, mut request: Value) {
        request["seq"] = self.seq.into();
        self.seq += 1;
        self.send_text(&request.to_string()).await;
    }

    pub(crate) async fn send_text(&mut self, text: &str) {
        self.socket.send(Message::text(text)).await.expect("sent");
    }

    pub(crate) async fn receive(&mut self) -> Reply {
        let next = tokio::time::timeout(TEST_TIMEOUT, self.socket.next()).await;
        match next.expect("an answer in time") {
            Some(Ok(Message::Text(text))) => {
                Reply::Text(serde_json::from_str(&text).expect("JSON"))
            }
            Some(Ok(Message::Binary(bytes))) => Reply::Binary(bytes),
            None | Some(Ok(Message::Close(_)) | Err(_)) => Reply::Closed,
            Some(Ok(other)) => panic!("{other:?}"),
        }
    }

    /// Asserts that the connection ends.
    pub(crate) async fn closed(&mut self) {
        let reply = self.receive().await;
        assert!(matches!(reply, Reply::Closed), "{reply:?}");
    }

    /// The TCP connection, for bytes that are not WebSocket.
    pub(crate) fn tcp(&mut self) -> &mut TcpStream {
        match self.socket.get_mut() {
            MaybeTlsStream::Plain(stream) => stream,
            _ => unreachable!("no TLS here"),
        }
    }
}

impl Seen {
    pub(crate) fn decode(bytes: Bytes) -> Self {
        let (_, metadata) = safetensors::SafeTensors::read_metadata(&bytes).expect("a header");
        let metadata = metadata.metadata().clone().expect("metadata");
        let meta = serde_json::from_str(&metadata["observation"]).expect("JSON");
        Self { meta, bytes }
    }

    pub(crate) fn tensors(&self) -> safetensors::SafeTensors<'_> {
        safetensors::SafeTensors::deserialize(&self.bytes).expect("safetensors")
    }

    pub(crate) fn frame_hash(&self) -> &str {
        self.meta["frame_hash"].as_str().expect("a hash")
    }
}

/// The wire's pose of a rig on the x axis.
pub(crate) fn pose(x_m: f64) -> Value {
    json!({ "xyz": [x_m, 0.0, 0.0], "q": [1.0, 0.0, 0.0, 0.0] })
}

/// Asserts that an answer is an error of a code.
pub(crate) fn refused(answer: &Value, code: &str) {
    assert_eq!((&answer["type"], &answer["code"]), (&"error".into(), &code.into()), "{answer}");
}
