//! The Rust client of the protocol.
//!
//! One WebSocket in lock step: every call sends one request and waits for its one answer. The tests
//! and `wildcity demo` drive with it; `clients/rust/drive.rs` is the example to start from.

mod connection;
mod error;
mod http;
pub mod limits;
mod observation;
mod upload;

use std::mem;
use std::time::Duration;

use wildcity_protocol::PROTOCOL;
use wildcity_protocol::error::Code;
use wildcity_protocol::message::{
    Answer, ClientInfo, Limits, Opened, Request, ServerInfo, Start, Summary, TwinInfo,
};

use connection::{Connection, Incoming};

pub use error::{ClientError, FrameError};
pub use http::{HttpClient, HttpError};
pub use observation::{ImageView, Observation};
pub use wildcity_protocol::http::{
    AllCells, CellReport, CellSelection, NewPush, PreviewRequest, Push, PushFile, PushReport,
    PushState, Upload,
};
pub use wildcity_protocol::message::{
    Action, Dynamics, DynamicsChoice, DynamicsModel, Open, Pose, TimedPose,
};

/// A connection to a server, and the session on it.
///
/// A request that was refused, or whose answer did not arrive, keeps its number: make the same call
/// again (after [`Client::reconnect`], if the connection was lost) and it is carried out once.
/// Dropping a call's future before it is done gives the connection up, as an answer may still come.
#[derive(Debug)]
pub struct Client {
    url: String,
    token: Token,
    name: String,
    connection: Option<Connection>,
    lost_because: String,
    welcome: Welcome,
    session: Option<String>,
    next_seq: u64,
    answer_timeout: Duration,
}

/// How an ego is to move in one step.
#[derive(Clone, Debug, PartialEq)]
pub enum Movement {
    /// To a pose, `world_from_rig`: of an ego that teleports.
    Pose(Pose),
    /// Along poses in the frame of the rig at the step's start.
    Trajectory(Vec<TimedPose>),
    /// By acceleration and curvature: of an ego that is driven.
    Action(Action),
}

/// Says nothing of itself.
struct Token(Option<String>);

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(if self.0.is_some() { "a token" } else { "none" })
    }
}

/// The server's answer to `hello`.
#[derive(Clone, Debug, PartialEq)]
pub struct Welcome {
    /// The protocol version chosen.
    pub protocol: String,
    /// Name and version of the server.
    pub server: ServerInfo,
    /// What the server accepts.
    pub limits: Limits,
    /// Name of the backend that renders.
    pub backend: String,
    /// Twins that can be opened.
    pub twins: Vec<TwinInfo>,
}

/// The server's answer to `resume`.
#[derive(Clone, Debug, PartialEq)]
pub struct Resumed {
    /// Last request that the session carried out.
    pub last_seq: u64,
    /// Steps done in the episode.
    pub step: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
}

/// The server's answer to `switch_version`: what is seen from now on.
#[derive(Clone, Debug, PartialEq)]
pub struct Switched {
    /// The version.
    pub version: u64,
    /// BLAKE3 of its manifest, in hex.
    pub version_hash: String,
    /// BLAKE3 of its render profile's JSON, in hex.
    pub profile_hash: String,
}

impl Client {
    /// Connects to `ws://host:port/v1/session` and says hello; `name` is for the server's log.
    ///
    /// # Errors
    /// The server cannot be reached in time, speaks another protocol, or refuses.
    pub async fn connect(url: &str, name: &str) -> Result<Self, ClientError> {
        Self::connect_as(url, name, None).await
    }

    /// The same with a token, for a server that has tokens.
    ///
    /// # Errors
    /// As [`Client::connect`].
    pub async fn connect_as(
        url: &str,
        name: &str,
        token: Option<String>,
    ) -> Result<Self, ClientError> {
        let mut connection = Connection::open(url, token.as_deref()).await?;
        let welcome = hello(&mut connection, name).await?;
        Ok(Self {
            url: url.to_owned(),
            token: Token(token),
            name: name.to_owned(),
            connection: Some(connection),
            lost_because: String::new(),
            welcome,
            session: None,
            next_seq: 1,
            answer_timeout: limits::ANSWER_TIMEOUT,
        })
    }

    /// Connects and continues a session that another client opened; `last_seq` is the number of the
    /// last answer that arrived there.
    ///
    /// # Errors
    /// As [`Client::connect`]; `unknown_session` if its time is over.
    pub async fn resume(
        url: &str,
        name: &str,
        session: &str,
        last_seq: u64,
    ) -> Result<(Self, Resumed), ClientError> {
        let mut client = Self::connect(url, name).await?;
        client.session = Some(session.to_owned());
        client.next_seq = last_seq.saturating_add(1);
        let resumed = client.take_up(session, last_seq).await?;
        Ok((client, resumed))
    }

    /// Connects again after the connection was lost, and continues the session if one was open.
    ///
    /// Then repeat the call that failed: it keeps its number, so it is carried out once, and if it
    /// was carried out already its answer comes again, byte for byte.
    ///
    /// # Errors
    /// As [`Client::resume`]. After `unknown_session` another session can be opened.
    pub async fn reconnect(&mut self) -> Result<Option<Resumed>, ClientError> {
        self.connection = None;
        let mut connection = Connection::open(&self.url, self.token.0.as_deref()).await?;
        self.welcome = hello(&mut connection, &self.name).await?;
        self.connection = Some(connection);
        let Some(session) = self.session.clone() else {
            self.next_seq = 1;
            return Ok(None);
        };
        self.take_up(&session, self.next_seq - 1).await.map(Some)
    }

    /// What the server said to `hello`.
    pub fn welcome(&self) -> &Welcome {
        &self.welcome
    }

    /// Number of the next request.
    pub fn next_seq(&self) -> u64 {
        self.next_seq
    }

    /// Waits this long for an answer before the connection is given up; 90 s unless changed.
    pub fn set_answer_timeout(&mut self, timeout: Duration) {
        self.answer_timeout = timeout;
    }

    /// Opens a session on a twin; `open.seq` is filled in here.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn open(&mut self, open: Open) -> Result<Opened, ClientError> {
        let request = Request::Open(Box::new(Open { seq: self.next_seq, ..open }));
        match self.exchange(&request).await? {
            Incoming::Answer(Answer::Opened(opened)) => {
                self.session = Some(opened.session.clone());
                Ok(*opened)
            }
            other => Err(self.break_off("opened", &other)),
        }
    }

    /// Moves the ego to its next `world_from_rig` and gives what it sees there.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn step(&mut self, pose: Pose) -> Result<Observation, ClientError> {
        self.drive(Movement::Pose(pose), false).await
    }

    /// As [`Client::step`], and the episode ends with it.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn last_step(&mut self, pose: Pose) -> Result<Observation, ClientError> {
        self.drive(Movement::Pose(pose), true).await
    }

    /// Moves the ego in any way that the session's dynamics take, and gives what it sees then;
    /// `terminate` ends the episode with it.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn drive(
        &mut self,
        movement: Movement,
        terminate: bool,
    ) -> Result<Observation, ClientError> {
        let (mut pose, mut trajectory, mut action) = (None, None, None);
        match movement {
            Movement::Pose(there) => pose = Some(there),
            Movement::Trajectory(poses) => trajectory = Some(poses),
            Movement::Action(wanted) => action = Some(wanted),
        }
        let seq = self.next_seq;
        self.observation(&Request::Step { seq, pose, trajectory, action, terminate }).await
    }

    /// Gives what would be seen from poses (`world_from_rig`), without moving.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn observe(&mut self, poses: &[Pose]) -> Result<Observation, ClientError> {
        self.observation(&Request::Observe { seq: self.next_seq, poses: poses.to_vec() }).await
    }

    /// Has loaded what is seen from poses (`world_from_rig`) and from between them, where the agent may
    /// go next; does not wait for it.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn prefetch(&mut self, poses: &[Pose]) -> Result<(), ClientError> {
        let request = Request::Prefetch { seq: self.next_seq, poses: poses.to_vec() };
        match self.exchange(&request).await? {
            Incoming::Answer(Answer::Ok { .. }) => Ok(()),
            other => Err(self.break_off("ok", &other)),
        }
    }

    /// Starts a new episode, at the session's start if `start` is absent.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn reset(
        &mut self,
        seed: u64,
        start: Option<Start>,
    ) -> Result<Observation, ClientError> {
        self.observation(&Request::Reset { seq: self.next_seq, seed, start }).await
    }

    /// Sees another version of the twin from the next step on, or the latest; the episode goes on.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn switch_version(&mut self, version: Option<u64>) -> Result<Switched, ClientError> {
        match self.exchange(&Request::SwitchVersion { seq: self.next_seq, version }).await? {
            Incoming::Answer(Answer::Switched { version, version_hash, profile_hash, .. }) => {
                Ok(Switched { version, version_hash, profile_hash })
            }
            other => Err(self.break_off("switched", &other)),
        }
    }

    /// Ends the session; another can be opened on the same connection.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn close(&mut self) -> Result<Summary, ClientError> {
        match self.exchange(&Request::Close { seq: self.next_seq }).await? {
            Incoming::Answer(Answer::Closed { summary, .. }) => {
                self.session = None;
                Ok(summary)
            }
            other => Err(self.break_off("closed", &other)),
        }
    }

    async fn observation(&mut self, request: &Request) -> Result<Observation, ClientError> {
        match self.exchange(request).await? {
            Incoming::Observation(observation) => Ok(*observation),
            other => Err(self.break_off("an observation", &other)),
        }
    }

    /// Sends one of the session's requests and waits for its answer. The number is used up only
    /// when that answer is not an error.
    async fn exchange(&mut self, request: &Request) -> Result<Incoming, ClientError> {
        let mut connection =
            self.connection.take().ok_or_else(|| ClientError::Disconnected(self.reason()))?;
        let result = connection.exchange(request, self.next_seq, self.answer_timeout).await;
        match &result {
            Ok(_) => {
                self.next_seq += 1;
                self.connection = Some(connection);
            }
            Err(ClientError::Refused { fatal: false, .. }) => self.connection = Some(connection),
            Err(error) => self.lost_because = error.to_string(),
        }
        result
    }

    /// Continues the session on a new connection, where `hello` was request 0 and this is 1.
    async fn take_up(&mut self, session: &str, last_seq: u64) -> Result<Resumed, ClientError> {
        let mut connection =
            self.connection.take().ok_or_else(|| ClientError::Disconnected(self.reason()))?;
        let request = Request::Resume { seq: 1, session: session.to_owned(), last_seq };
        let incoming = match connection.exchange(&request, 1, self.answer_timeout).await {
            Ok(incoming) => incoming,
            Err(error) => {
                if matches!(error, ClientError::Refused { code: Code::UnknownSession, .. }) {
                    // Gone for good; a new one can be opened here, with the number of this try.
                    (self.session, self.next_seq, self.connection) = (None, 1, Some(connection));
                } else {
                    self.lost_because = error.to_string();
                }
                return Err(error);
            }
        };
        match incoming {
            // One request at a time: the session is where this client is, or one answer ahead.
            Incoming::Answer(Answer::Resumed { last_seq: done, step, time_us, .. })
                if done == last_seq || Some(done) == last_seq.checked_add(1) =>
            {
                self.connection = Some(connection);
                Ok(Resumed { last_seq: done, step, time_us })
            }
            other => Err(self.break_off("resumed, at most one request ahead", &other)),
        }
    }

    fn break_off(&mut self, expected: &'static str, got: &Incoming) -> ClientError {
        self.connection = None;
        let error = ClientError::UnexpectedAnswer { expected, got: got.to_string() };
        self.lost_because = error.to_string();
        error
    }

    fn reason(&mut self) -> String {
        let reason = mem::take(&mut self.lost_because);
        if reason.is_empty() { "a call was given up before its answer came".into() } else { reason }
    }
}

async fn hello(connection: &mut Connection, name: &str) -> Result<Welcome, ClientError> {
    let version = env!("CARGO_PKG_VERSION").to_owned();
    let request = Request::Hello {
        seq: 0,
        client: ClientInfo { name: name.to_owned(), version },
        protocols: vec![PROTOCOL.to_owned()],
    };
    match connection.exchange(&request, 0, wildcity_protocol::limits::HELLO_TIMEOUT).await? {
        Incoming::Answer(Answer::Welcome { protocol, server, limits, backend, twins, .. })
            if protocol == PROTOCOL =>
        {
            Ok(Welcome { protocol, server, limits, backend, twins })
        }
        other => Err(ClientError::UnexpectedAnswer {
            expected: "welcome to wildcity.v1",
            got: other.to_string(),
        }),
    }
}
