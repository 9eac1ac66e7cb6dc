//! The session client: one request, one answer, in lock step.

use std::mem;
use std::time::Duration;

use wildcity_protocol::PROTOCOL;
use wildcity_protocol::error::Code;
use wildcity_protocol::limits::HELLO_TIMEOUT;
use wildcity_protocol::message::{
    Action, Answer, Branch, BranchPoint, ClientInfo, DynamicsChoice, Limits, Open, Opened, Pose,
    Request, ResumedSession, ServerInfo, SessionStep, Start, Summary, TimedPose, TwinInfo,
};

use crate::connection::{Connection, Endpoint, Incoming};
use crate::error::ClientError;
use crate::limits;
use crate::many::Stepped;
use crate::observation::Observation;
use crate::options::ConnectOptions;

/// A connection to a server, and the sessions on it.
///
/// Most clients have one session. With several, each call is for the one that was opened last or
/// [selected](Client::select), and [`Client::step_many`] steps several at once.
///
/// A request keeps its number if it was refused or its answer did not arrive. Make the same call
/// again (after [`Client::reconnect`] if the connection was lost): the server carries it out only
/// once. Dropping the future of a call before it completes closes the connection, because its
/// answer could still come.
///
/// ```no_run
/// use wildcity_client::{Client, ClientError, Open, Pose};
///
/// # async fn drive() -> Result<(), ClientError> {
/// let mut client = Client::connect("ws://127.0.0.1:8080/v1/session", "my-agent").await?;
/// client.open(Open::twin("street")).await?;
/// let pose = Pose { xyz: [1.0, 0.0, 0.0], q: [1.0, 0.0, 0.0, 0.0] };
/// let observation = match client.step(pose).await {
///     Err(ClientError::Disconnected(_)) => {
///         client.reconnect().await?;
///         client.step(pose).await?
///     }
///     other => other?,
/// };
/// println!("step {}", observation.metadata().step);
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Client {
    endpoint: Endpoint,
    /// Name of this client, for the server's log.
    name: String,
    /// None while a call is running, and after the connection was lost.
    connection: Option<Connection>,
    /// Why the connection was lost; empty if it was not, or if a call was dropped.
    disconnect_reason: String,
    welcome: Welcome,
    /// Names of the open sessions.
    sessions: Vec<String>,
    /// The session that calls are for.
    selected: Option<String>,
    /// Number of the first request of a connection after `hello` and `share_memory`.
    first_seq: u64,
    next_seq: u64,
    answer_timeout: Duration,
}

/// How the ego moves in one step.
#[derive(Clone, Debug, PartialEq)]
pub enum Movement {
    /// To this pose, `world_from_rig`. Only with the dynamics `teleport`.
    Pose(Pose),
    /// Along these poses, in the rig's frame at the start of the step. With any dynamics.
    Trajectory(Vec<TimedPose>),
    /// With this acceleration and curvature. Only with the dynamics `kinematic` and `dynamic`.
    Action(Action),
}

impl Movement {
    /// The step of a session, for [`Client::step_many`].
    pub fn for_session(self, session: &str) -> SessionStep {
        let (pose, trajectory, action) = self.fields();
        SessionStep {
            session: session.to_owned(),
            pose,
            trajectory,
            action,
            until_us: None,
            notes: None,
            terminate: false,
        }
    }

    fn fields(self) -> (Option<Pose>, Option<Vec<TimedPose>>, Option<Action>) {
        match self {
            Self::Pose(pose) => (Some(pose), None, None),
            Self::Trajectory(poses) => (None, Some(poses), None),
            Self::Action(action) => (None, None, Some(action)),
        }
    }
}

/// Options of a step in addition to its movement.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepOptions {
    /// For how long the movement, a trajectory or an action, is followed, in microseconds: a whole
    /// number of steps. One step if `None`.
    pub until_us: Option<i64>,
    /// Notes of the agent about the step, for the record: any JSON of at most 65,536 bytes.
    pub notes: Option<serde_json::Value>,
    /// Whether the episode ends with this step.
    pub terminate: bool,
}

/// How an episode starts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResetOptions {
    /// Seed of the episode's random draws.
    pub seed: u64,
    /// Where it starts; the session's start if `None`.
    pub start: Option<Start>,
    /// How the ego moves in this episode; as in the session if `None`.
    pub dynamics: Option<DynamicsChoice>,
    /// Speed at the start, in m/s, in place of that of the dynamics.
    pub speed: Option<f64>,
}

/// The server's answer to `hello`.
#[derive(Clone, Debug, PartialEq)]
pub struct Welcome {
    /// The protocol version that the server chose.
    pub protocol: String,
    /// Name and version of the server.
    pub server: ServerInfo,
    /// Largest sizes, counts and times that the server accepts.
    pub limits: Limits,
    /// Name of the render backend.
    pub backend: String,
    /// The twins that can be opened.
    pub twins: Vec<TwinInfo>,
}

/// The server's answer to `resume`.
#[derive(Clone, Debug, PartialEq)]
pub struct Resumed {
    /// Number of the last request that the session carried out.
    pub last_seq: u64,
    /// Steps of the episode so far.
    pub step: u64,
    /// Simulated time since the start of the episode, in microseconds.
    pub time_us: i64,
    /// The settings of the session, as [`Client::open`] returned them; `None` if it is closed.
    pub opened: Option<Box<Opened>>,
    /// The other sessions of the connection.
    pub also: Vec<ResumedSession>,
}

/// The server's answer to `switch_version`: the version that the session shows from the next step
/// on.
#[derive(Clone, Debug, PartialEq)]
pub struct Switched {
    /// Number of the version.
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    /// BLAKE3 of the version's render profile as JSON, in hex.
    pub profile_hash: String,
}

impl Client {
    /// Connects to `ws://HOST:PORT/v1/session` or `wss://HOST/v1/session` and sends `hello`. `name`
    /// appears in the server's log.
    ///
    /// # Errors
    /// [`ClientError::Connect`] if the address is invalid or the server does not answer within 10
    /// s. A server that speaks another protocol gives [`ClientError::UnexpectedAnswer`].
    pub async fn connect(url: &str, name: &str) -> Result<Self, ClientError> {
        Self::connect_with(url, name, &ConnectOptions::default()).await
    }

    /// As [`Client::connect`], with a token, additional root certificates, or shared memory.
    ///
    /// # Errors
    /// As [`Client::connect`]. With shared memory, [`Code::SharedMemoryUnavailable`] if the server
    /// refuses it, and [`ClientError::SharedMemory`] if its memory cannot be opened. An unknown
    /// token gives [`ClientError::Connect`] with HTTP status 401 in its reason, a token without the
    /// role `drive` 403.
    pub async fn connect_with(
        url: &str,
        name: &str,
        options: &ConnectOptions,
    ) -> Result<Self, ClientError> {
        let endpoint = Endpoint::new(url, options)?;
        let (connection, welcome) = begin(&endpoint, name).await?;
        // `hello` has number 0, and sharing memory takes two.
        let first_seq = if endpoint.shares_memory { 3 } else { 1 };
        Ok(Self {
            endpoint,
            name: name.to_owned(),
            connection: Some(connection),
            disconnect_reason: String::new(),
            welcome,
            sessions: Vec::new(),
            selected: None,
            first_seq,
            next_seq: first_seq,
            answer_timeout: limits::ANSWER_TIMEOUT,
        })
    }

    /// Continues a session that another client opened, for example one in a process that ended.
    /// Call it directly after connecting. `last_seq` is the number of the last answer that the
    /// other client received (`metadata().seq` of an observation).
    ///
    /// # Errors
    /// [`Code::UnknownSession`] if the session ended or its time to resume is over. After any other
    /// error the connection is lost.
    pub async fn resume(&mut self, session: &str, last_seq: u64) -> Result<Resumed, ClientError> {
        self.resume_with(session, &[], last_seq).await
    }

    /// As [`Client::resume`], with the other sessions that were on the same connection.
    ///
    /// # Errors
    /// As [`Client::resume`], and if another session was not on that connection.
    pub async fn resume_with(
        &mut self,
        session: &str,
        also: &[String],
        last_seq: u64,
    ) -> Result<Resumed, ClientError> {
        self.sessions = std::iter::once(session.to_owned()).chain(also.iter().cloned()).collect();
        self.selected = Some(session.to_owned());
        // The number may be any that the caller has stored, also the largest.
        self.next_seq = last_seq.saturating_add(1);
        self.resume_sessions(last_seq).await
    }

    /// Connects again after the connection was lost, and continues the sessions that were open.
    ///
    /// Then repeat the call that failed. It keeps its number, so the server carries it out only
    /// once: if it already did, it sends the same answer again, byte for byte.
    ///
    /// # Errors
    /// As [`Client::connect`] and [`Client::resume`]. After [`Code::UnknownSession`] another
    /// session can be opened.
    pub async fn reconnect(&mut self) -> Result<Option<Resumed>, ClientError> {
        self.connection = None;
        let (connection, welcome) = begin(&self.endpoint, &self.name).await?;
        self.welcome = welcome;
        self.connection = Some(connection);
        if self.sessions.is_empty() {
            self.next_seq = self.first_seq;
            return Ok(None);
        }
        self.resume_sessions(self.next_seq - 1).await.map(Some)
    }

    /// Names of the open sessions, in the order in which they were opened.
    pub fn sessions(&self) -> &[String] {
        &self.sessions
    }

    /// Chooses the session that calls are for. Nothing is sent: a name that is not open is refused
    /// by the server.
    pub fn select(&mut self, session: &str) {
        self.selected = Some(session.to_owned());
    }

    /// The server's answer to `hello`: its limits and its twins.
    pub fn welcome(&self) -> &Welcome {
        &self.welcome
    }

    /// Number of the next request.
    pub fn next_seq(&self) -> u64 {
        self.next_seq
    }

    /// Sets how long a call waits for its answer before it closes the connection. The default is
    /// [`limits::ANSWER_TIMEOUT`], 90 s.
    pub fn set_answer_timeout(&mut self, timeout: Duration) {
        self.answer_timeout = timeout;
    }

    /// Opens a session on a twin. `open.seq` is ignored: the client sets it. While another session
    /// is open, the new one needs a name.
    ///
    /// # Errors
    /// [`ClientError::Refused`] if the server refuses; see [`ClientError`] for lost connections.
    pub async fn open(&mut self, open: Open) -> Result<Opened, ClientError> {
        let request = Request::Open(Box::new(Open { seq: self.next_seq, ..open }));
        match self.exchange(&request).await? {
            Incoming::Answer(Answer::Opened(opened)) => {
                self.add(&opened);
                Ok(*opened)
            }
            other => Err(self.unexpected_answer("opened", &other)),
        }
    }

    /// Opens a session in a state of another episode, with that episode's settings: a snapshot of a
    /// session that still exists, or a step of an episode that the server has recorded. The new
    /// session has that state as its snapshot `start`.
    ///
    /// # Errors
    /// [`Code::UnknownState`] if there is no such state; otherwise as [`Client::open`].
    pub async fn branch(
        &mut self,
        from: BranchPoint,
        session: Option<String>,
    ) -> Result<Opened, ClientError> {
        let request = Request::Branch(Branch { seq: self.next_seq, from, session });
        match self.exchange(&request).await? {
            Incoming::Answer(Answer::Opened(opened)) => {
                self.add(&opened);
                Ok(*opened)
            }
            other => Err(self.unexpected_answer("opened", &other)),
        }
    }

    /// Stores the state of the episode under a name, in place of an earlier snapshot of that name.
    ///
    /// # Errors
    /// As [`Client::step`].
    pub async fn snapshot(&mut self, name: &str) -> Result<(), ClientError> {
        let request =
            Request::Snapshot { seq: self.next_seq, session: self.named(), name: name.to_owned() };
        match self.exchange(&request).await? {
            Incoming::Answer(Answer::Ok { .. }) => Ok(()),
            other => Err(self.unexpected_answer("ok", &other)),
        }
    }

    /// Returns to a snapshot of this session, and renders it.
    ///
    /// # Errors
    /// [`Code::UnknownState`] if there is no such snapshot; otherwise as [`Client::step`].
    pub async fn restore(&mut self, name: &str) -> Result<Observation, ClientError> {
        let request =
            Request::Restore { seq: self.next_seq, session: self.named(), name: name.to_owned() };
        self.exchange_for_observation(&request).await
    }

    /// Moves the ego to `pose` (`world_from_rig`), advances the simulated time by one step, and
    /// returns the observation there. Only with the dynamics `teleport`, which is the default.
    ///
    /// # Errors
    /// [`ClientError::Refused`] if the server refuses; see [`ClientError`] for lost connections.
    pub async fn step(&mut self, pose: Pose) -> Result<Observation, ClientError> {
        self.drive(Movement::Pose(pose), false).await
    }

    /// As [`Client::step`], and ends the episode with this step.
    ///
    /// # Errors
    /// As [`Client::step`].
    pub async fn last_step(&mut self, pose: Pose) -> Result<Observation, ClientError> {
        self.drive(Movement::Pose(pose), true).await
    }

    /// Moves the ego by a pose, a trajectory or an action, advances the simulated time by one step,
    /// and returns the observation there. `terminate` ends the episode with this step.
    ///
    /// # Errors
    /// [`Code::SessionState`] if the session's dynamics do not accept this kind of movement;
    /// otherwise as [`Client::step`].
    pub async fn drive(
        &mut self,
        movement: Movement,
        terminate: bool,
    ) -> Result<Observation, ClientError> {
        self.follow(movement, StepOptions { terminate, ..StepOptions::default() }).await
    }

    /// As [`Client::drive`], with notes for the record, or for several steps: the observation is
    /// the one at the end of the plan.
    ///
    /// # Errors
    /// As [`Client::drive`].
    pub async fn follow(
        &mut self,
        movement: Movement,
        options: StepOptions,
    ) -> Result<Observation, ClientError> {
        let StepOptions { until_us, notes, terminate } = options;
        let (pose, trajectory, action) = movement.fields();
        let seq = self.next_seq;
        let session = self.named();
        let request =
            Request::Step { seq, session, pose, trajectory, action, until_us, notes, terminate };
        self.exchange_for_observation(&request).await
    }

    /// Steps several sessions of this connection, 1 to 64, in one message. A session whose step is
    /// refused does not stop the others. The results are in the order of `steps`.
    ///
    /// # Errors
    /// [`ClientError::Refused`] if the list itself is refused; then no session was stepped.
    /// Otherwise as [`Client::step`].
    pub async fn step_many(
        &mut self,
        steps: Vec<SessionStep>,
    ) -> Result<Vec<Stepped>, ClientError> {
        match self.exchange(&Request::StepMany { seq: self.next_seq, steps }).await? {
            Incoming::Many(many) => Ok(many.steps),
            other => Err(self.unexpected_answer("observations of several sessions", &other)),
        }
    }

    /// Renders the cameras from `poses` (`world_from_rig`) without moving the ego or the time. The
    /// observation has the images of all poses, pose by pose.
    ///
    /// # Errors
    /// As [`Client::step`].
    pub async fn observe(&mut self, poses: &[Pose]) -> Result<Observation, ClientError> {
        let request =
            Request::Observe { seq: self.next_seq, session: self.named(), poses: poses.to_vec() };
        self.exchange_for_observation(&request).await
    }

    /// Asks the server to load what will be visible from `poses` (`world_from_rig`, in driving
    /// order) and from the straight lines between them. Returns at once, without waiting until it
    /// is loaded.
    ///
    /// # Errors
    /// As [`Client::step`].
    pub async fn prefetch(&mut self, poses: &[Pose]) -> Result<(), ClientError> {
        let request =
            Request::Prefetch { seq: self.next_seq, session: self.named(), poses: poses.to_vec() };
        match self.exchange(&request).await? {
            Incoming::Answer(Answer::Ok { .. }) => Ok(()),
            other => Err(self.unexpected_answer("ok", &other)),
        }
    }

    /// Starts a new episode at `start`, or at the session's start if `start` is `None`.
    ///
    /// # Errors
    /// As [`Client::step`].
    pub async fn reset(
        &mut self,
        seed: u64,
        start: Option<Start>,
    ) -> Result<Observation, ClientError> {
        self.reset_with(ResetOptions { seed, start, ..ResetOptions::default() }).await
    }

    /// As [`Client::reset`], with dynamics or a speed for only this episode.
    ///
    /// # Errors
    /// As [`Client::step`].
    pub async fn reset_with(&mut self, options: ResetOptions) -> Result<Observation, ClientError> {
        let ResetOptions { seed, start, dynamics, speed } = options;
        let seq = self.next_seq;
        let session = self.named();
        let request = Request::Reset { seq, session, seed, start, dynamics, speed };
        self.exchange_for_observation(&request).await
    }

    /// Shows another version of the twin from the next step on; the latest one if `version` is
    /// `None`. The episode continues.
    ///
    /// # Errors
    /// [`Code::UnknownVersion`] if the twin has no such version; otherwise as [`Client::step`].
    pub async fn switch_version(&mut self, version: Option<u64>) -> Result<Switched, ClientError> {
        let seq = self.next_seq;
        let session = self.named();
        match self.exchange(&Request::SwitchVersion { seq, session, version }).await? {
            Incoming::Answer(Answer::Switched { version, version_hash, profile_hash, .. }) => {
                Ok(Switched { version, version_hash, profile_hash })
            }
            other => Err(self.unexpected_answer("switched", &other)),
        }
    }

    /// Ends the session. Another one can be opened on the same connection. If others are open, the
    /// last of them is selected.
    ///
    /// # Errors
    /// As [`Client::step`].
    pub async fn close(&mut self) -> Result<Summary, ClientError> {
        let seq = self.next_seq;
        let session = self.named();
        match self.exchange(&Request::Close { seq, session }).await? {
            Incoming::Answer(Answer::Closed { summary, .. }) => {
                self.remove_selected();
                Ok(summary)
            }
            other => Err(self.unexpected_answer("closed", &other)),
        }
    }

    async fn exchange_for_observation(
        &mut self,
        request: &Request,
    ) -> Result<Observation, ClientError> {
        match self.exchange(request).await? {
            Incoming::Observation(observation) => Ok(*observation),
            other => Err(self.unexpected_answer("an observation", &other)),
        }
    }

    /// Sends a request of the session and waits for its answer. The number is used up only if that
    /// answer is not an error.
    async fn exchange(&mut self, request: &Request) -> Result<Incoming, ClientError> {
        let mut connection = self.take_connection()?;
        let result = connection.exchange(request, self.next_seq, self.answer_timeout).await;
        match &result {
            Ok(_) => {
                self.next_seq += 1;
                self.connection = Some(connection);
            }
            // A refused request keeps its number: the next one has the same.
            Err(ClientError::Refused { fatal: false, .. }) => self.connection = Some(connection),
            // The connection is dropped: after a time-out the late answer would come in place of
            // the next one.
            Err(error) => self.disconnect_reason = error.to_string(),
        }
        result
    }

    /// Resumes sessions on a new connection. Must be its first request after `hello` and
    /// `share_memory`.
    async fn resume_sessions(&mut self, last_seq: u64) -> Result<Resumed, ClientError> {
        let mut connection = self.take_connection()?;
        let mut names = self.sessions.iter().cloned();
        let session = names.next().unwrap_or_default();
        let request =
            Request::Resume { seq: self.first_seq, session, last_seq, also: names.collect() };
        let incoming =
            match connection.exchange(&request, self.first_seq, self.answer_timeout).await {
                Ok(incoming) => incoming,
                Err(error) => {
                    if matches!(error, ClientError::Refused { code: Code::UnknownSession, .. }) {
                        // A session is over. A new one can be opened on this connection, and its
                        // request takes the number of this refused one.
                        self.sessions.clear();
                        self.selected = None;
                        self.next_seq = self.first_seq;
                        self.connection = Some(connection);
                    } else {
                        self.disconnect_reason = error.to_string();
                    }
                    return Err(error);
                }
            };
        match incoming {
            // One request is under way at a time, so the session has carried out either the request
            // with number `last_seq` or the one after it.
            Incoming::Answer(Answer::Resumed {
                last_seq: session_seq,
                step,
                time_us,
                opened,
                also,
                ..
            }) if session_seq == last_seq || Some(session_seq) == last_seq.checked_add(1) => {
                self.connection = Some(connection);
                Ok(Resumed { last_seq: session_seq, step, time_us, opened, also })
            }
            other => Err(self.unexpected_answer("resumed, at most one request ahead", &other)),
        }
    }

    /// The name of the selected session for a request, which needs a name only if there are several
    /// sessions.
    fn named(&self) -> Option<String> {
        // With one session the server needs no name.
        self.selected.clone().filter(|_| self.sessions.len() > 1)
    }

    /// Adds an opened session, and selects it. An answer that is repeated opens nothing new.
    fn add(&mut self, opened: &Opened) {
        if !self.sessions.contains(&opened.session) {
            self.sessions.push(opened.session.clone());
        }
        self.selected = Some(opened.session.clone());
    }

    /// Removes the session that was closed, and selects the last of the others.
    fn remove_selected(&mut self) {
        match self.sessions.len() {
            // The only session may have been selected by another name, and is the one that was
            // closed.
            0 | 1 => self.sessions.clear(),
            _ => self.sessions.retain(|name| Some(name) != self.selected.as_ref()),
        }
        self.selected = self.sessions.last().cloned();
    }

    /// Takes the connection for the time of a call. A dropped future does not give it back, which
    /// closes the connection.
    fn take_connection(&mut self) -> Result<Connection, ClientError> {
        self.connection.take().ok_or_else(|| {
            let reason = mem::take(&mut self.disconnect_reason);
            ClientError::Disconnected(if reason.is_empty() {
                "a call was given up before its answer came".to_owned()
            } else {
                reason
            })
        })
    }

    fn unexpected_answer(&mut self, expected: &'static str, got: &Incoming) -> ClientError {
        self.connection = None;
        let error = ClientError::UnexpectedAnswer { expected, got: got.to_string() };
        self.disconnect_reason = error.to_string();
        error
    }
}

/// Connects, says `hello`, and shares memory if this is requested.
async fn begin(endpoint: &Endpoint, name: &str) -> Result<(Connection, Welcome), ClientError> {
    let mut connection = endpoint.connect().await?;
    let welcome = hello(&mut connection, name).await?;
    if endpoint.shares_memory {
        connection.share_memory(1).await?;
    }
    Ok((connection, welcome))
}

async fn hello(connection: &mut Connection, name: &str) -> Result<Welcome, ClientError> {
    let version = env!("CARGO_PKG_VERSION").to_owned();
    let request = Request::Hello {
        seq: 0,
        client: ClientInfo { name: name.to_owned(), version },
        protocols: vec![PROTOCOL.to_owned()],
    };
    match connection.exchange(&request, 0, HELLO_TIMEOUT).await? {
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
