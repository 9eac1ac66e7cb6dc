//! One episode with a session of wildcity and a session of a driver.
//!
//! At each decision the driver gets the images that are new, the ego's poses, and the route; then
//! it is asked for a plan, which the ego follows for one step. `EPISODE_US` is added to the
//! simulated times that are sent, because they are unsigned.

use std::collections::BTreeMap;
use std::time::Duration;

use glam::{DMat3, DQuat, DVec3};

use wildcity_client::protocol::message::{
    self, Drive, DrivePose, DriveSection, ImagePart, Opened, Outputs, Start,
};
use wildcity_client::{
    Client, ClientError, ConnectOptions, Dynamics, DynamicsChoice, DynamicsModel, HttpClient,
    HttpError, ImageView, Movement, Observation, Open,
};
use wildcity_scene::geometry::{Pose, PoseError};
use wildcity_scene::rig::RigCamera;

use super::driver::{Driver, DriverError};
use super::plan::trajectory;
use super::route::{Route, waypoints};
use crate::camera::{available, logical_id};
use crate::limits;
use crate::scene::LocalFrame;
use crate::wire::common::{PoseAtTime, Trajectory, Vec3};
use crate::wire::egodriver as wire;

/// Time of the driver at the simulated time 0, in microseconds.
const EPISODE_US: i64 = 1_000_000_000;

/// Time between two poses of the history.
const HISTORY_US: i64 = 100_000;

/// How an episode is driven.
#[derive(Clone, Debug)]
pub struct EpisodeSettings {
    /// URL of the server's WebSocket, `ws://HOST:PORT/v1/session`.
    pub server: String,
    /// Token for the server.
    pub token: Option<String>,
    /// `HOST:PORT` of the driver.
    pub driver: String,
    /// Options of the session: twin, version, rig, scenario, times. Its outputs are not used.
    pub open: Open,
    /// Name of the drive to follow; if absent, the drive of the start, or else the first one of the
    /// twin.
    pub trajectory: Option<String>,
    /// Start along the drive, in metres; if absent, the start of `open`.
    pub start_m: Option<f64>,
    /// Cameras to send; all of the rig if absent.
    pub cameras: Option<Vec<String>>,
    /// Width and height of the images, in pixels; those of the rig if absent.
    pub size_px: Option<[u32; 2]>,
    /// How the ego moves. If this and the speed are absent, as the scenario says; without a
    /// scenario, `dynamic`.
    pub model: Option<DynamicsModel>,
    /// Speed at the start, in m/s. If this and the model are absent, that of the scenario; without
    /// a scenario, the recorded one.
    pub speed_m_s: Option<f64>,
    /// Frames of each camera before the first decision.
    pub frames: u32,
    pub steps: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// How long the driver may take for an answer.
    pub max_wait: Duration,
}

/// How an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All steps were driven, or the driver ended the session.
    Completed,
    /// A contact ended the episode, or another rule of the scenario.
    DrivingFailure,
    /// As `Completed`, but the ego left the area that the twin was trained on.
    OffModel,
    /// The driver refused a request, or its plan cannot be driven.
    AgentError,
    /// The driver did not answer in time.
    AgentTimeout,
    /// The driver went away.
    AgentLost,
}

/// Result of an episode.
#[derive(Clone, Debug, PartialEq)]
pub struct EpisodeReport {
    pub seed: u64,
    pub outcome: Outcome,
    /// Why, unless it completed.
    pub reason: Option<String>,
    pub steps: u64,
    /// Length of the driven path, in metres.
    pub distance_m: f64,
    /// BLAKE3 of the concatenated frame hashes of all observations, in hex.
    pub frames_hash: String,
}

/// Why there is no report: an error of the server or of the settings, and not of the driver.
#[derive(Debug, thiserror::Error)]
pub enum BridgeError {
    /// The server refused, or went away.
    #[error(transparent)]
    Server(#[from] ClientError),
    /// The server refused a request over HTTP.
    #[error(transparent)]
    Http(#[from] HttpError),
    /// A setting cannot be used.
    #[error("{0}")]
    Setting(String),
    /// The server sent an invalid pose.
    #[error("the server sent an invalid pose: {0}")]
    Pose(PoseError),
    /// No driver answers, so that no episode began.
    #[error(transparent)]
    Driver(DriverError),
}

impl From<PoseError> for BridgeError {
    fn from(cause: PoseError) -> Self {
        Self::Pose(cause)
    }
}

/// Drives one episode.
///
/// # Errors
/// The server or the settings are at fault. Errors of the driver are in the report.
pub async fn drive_episode(settings: &EpisodeSettings) -> Result<EpisodeReport, BridgeError> {
    // The driver first: it may take minutes to load, and a session would wait for it.
    let uuid = format!("wildcity-{}-{}", std::process::id(), settings.seed);
    let mut driver = Driver::connect(&settings.driver, uuid, settings.max_wait)
        .await
        .map_err(BridgeError::Driver)?;

    let options = ConnectOptions::with_token(settings.token.clone());
    let mut client = Client::connect_with(&settings.server, "wildcity-egodriver", &options).await?;
    // The drive is needed before the session opens, for its start and its speed.
    let drive = recorded_drive(settings, &client, &options).await?;
    let opened = client.open(open(settings, &drive)).await?;
    let first = client.reset(settings.seed, None).await?;
    let mut episode = Episode::new(settings, &opened, drive)?;

    // Both sessions are closed whatever the result is: otherwise the server would wait for the next
    // request until it times out.
    let driven = episode.drive(&mut client, &mut driver, first).await;
    let closed = client.close().await;
    // The driver may be gone; the report then has this error.
    let _ = driver.close_session().await;
    // After an error of the server, closing fails as well: the first error is the cause.
    let failure = match driven {
        Ok(()) => None,
        Err(StepError::Server(error)) => return Err(error),
        Err(StepError::Driver(error)) => Some(error),
    };
    let closed = closed?;
    Ok(EpisodeReport {
        seed: settings.seed,
        outcome: failure.as_ref().map_or_else(|| driven_outcome(closed.outcome), outcome),
        reason: failure.map(|error| error.to_string()),
        steps: closed.steps,
        distance_m: closed.distance_m,
        frames_hash: episode.hashes.finalize().to_hex().to_string(),
    })
}

/// The outcome of an episode in which the driver answered to the end.
fn driven_outcome(closed: message::Outcome) -> Outcome {
    match closed {
        // What remains is completed from the driver's side: the driver answered to the end.
        message::Outcome::DrivingFailure => Outcome::DrivingFailure,
        message::Outcome::OffModel => Outcome::OffModel,
        _ => Outcome::Completed,
    }
}

fn outcome(error: &DriverError) -> Outcome {
    match error {
        DriverError::Lost(_) => Outcome::AgentLost,
        DriverError::TimedOut { .. } => Outcome::AgentTimeout,
        DriverError::Address(_)
        | DriverError::Refused { .. }
        | DriverError::Plan(_)
        | DriverError::Image { .. } => Outcome::AgentError,
    }
}

async fn recorded_drive(
    settings: &EpisodeSettings,
    client: &Client,
    options: &ConnectOptions,
) -> Result<Drive, BridgeError> {
    let open = &settings.open;
    let twin = client.welcome().twins.iter().find(|twin| twin.name == open.twin);
    let first = twin.and_then(|twin| twin.trajectories.first()).map(|drive| drive.name.clone());
    // The route follows the drive on which the episode starts. A start at a free pose names none.
    let started = match &open.start {
        Some(Start::Station { trajectory, .. }) => Some(trajectory.clone()),
        Some(Start::Random { random }) => random.trajectory.clone(),
        Some(Start::Pose { .. }) | None => None,
    };
    let name = settings.trajectory.clone().or(started).or(first).ok_or_else(|| {
        BridgeError::Setting(format!("twin {:?} has no recorded drive to follow", open.twin))
    })?;
    let http = HttpClient::new(&http_address(&settings.server), options)?;
    let section = DriveSection { name, from_m: None, to_m: None, every_m: None };
    let drive = http.trajectory(&open.twin, open.version, &section).await?;
    // From here on a drive has two poses or more, so that `poses[0]` and a segment exist.
    let count = drive.poses.len();
    if count < 2 {
        let text = format!("trajectory {:?} has {count} poses; a route needs two", drive.name);
        return Err(BridgeError::Setting(text));
    }
    Ok(drive)
}

/// `http://HOST:PORT` of the server whose WebSocket is `ws://HOST:PORT/v1/session`.
fn http_address(server: &str) -> String {
    let address = server.trim_end_matches("/v1/session");
    // The `s` of `wss` stays, so that it becomes `https`.
    address.replacen("ws", "http", 1)
}

fn open(settings: &EpisodeSettings, drive: &Drive) -> Open {
    let start_m = settings.start_m;
    let start =
        start_m.map(|station_m| Start::Station { trajectory: drive.name.clone(), station_m });
    // A size without names of cameras has no camera to belong to; the images then have the size of
    // the rig.
    let images = settings.size_px.iter().flat_map(|size| {
        let names = settings.cameras.iter().flatten();
        names.map(|name| {
            let size = Some(size.map(u64::from));
            (name.clone(), ImagePart { crop: None, size })
        })
    });
    let given = &settings.open;
    // A scenario says how its ego moves, as it says where it starts.
    let is_of_scenario =
        given.scenario.is_some() && settings.model.is_none() && settings.speed_m_s.is_none();
    let dynamics = || {
        let model = settings.model.unwrap_or(DynamicsModel::Dynamic);
        let speed = settings.speed_m_s.unwrap_or_else(|| recorded_speed_m_s(drive, settings));
        DynamicsChoice::Full(Dynamics { model, speed, reverse: false })
    };
    Open {
        seed: settings.seed,
        start: start.or_else(|| given.start.clone()),
        outputs: Outputs {
            cameras: settings.cameras.clone(),
            images: images.collect(),
            frames: Some(u64::from(settings.frames)),
            ..Outputs::default()
        },
        dynamics: given.dynamics.or_else(|| (!is_of_scenario).then(dynamics)),
        ..given.clone()
    }
}

/// The recorded speed where the episode starts.
fn recorded_speed_m_s(drive: &Drive, settings: &EpisodeSettings) -> f64 {
    let first_us = drive.poses[0].time_us;
    let is_after = |at: &DrivePose| match settings.start_m {
        Some(start_m) => at.station_m >= start_m,
        None => at.time_us >= first_us + settings.open.warm_up_us.unwrap_or_default(),
    };
    let after = drive.poses.iter().position(is_after).unwrap_or(0);
    // The pose before it must exist: a start at the first pose takes the first segment.
    let after = after.clamp(1, drive.poses.len() - 1);
    let from = &drive.poses[after - 1];
    let to = &drive.poses[after];
    (to.station_m - from.station_m) / (1e-6 * (to.time_us - from.time_us) as f64)
}

/// Why a step was not driven.
enum StepError {
    Server(BridgeError),
    Driver(DriverError),
}

impl From<DriverError> for StepError {
    fn from(error: DriverError) -> Self {
        Self::Driver(error)
    }
}

impl From<ClientError> for StepError {
    fn from(error: ClientError) -> Self {
        Self::Server(error.into())
    }
}

impl From<PoseError> for StepError {
    fn from(error: PoseError) -> Self {
        Self::Server(error.into())
    }
}

/// The state of an episode.
struct Episode<'a> {
    settings: &'a EpisodeSettings,
    cameras: Vec<RigCamera>,
    frame: LocalFrame,
    route: Route,
    dt_us: i64,
    /// Time of the newest image of each camera that the driver has.
    sent_us: BTreeMap<String, i64>,
    hashes: blake3::Hasher,
}

impl<'a> Episode<'a> {
    fn new(
        settings: &'a EpisodeSettings,
        opened: &Opened,
        drive: Drive,
    ) -> Result<Self, BridgeError> {
        // A camera has the same format on the wire and in a rig file.
        let cameras = opened.cameras.iter().map(|camera| {
            let json = serde_json::to_value(camera);
            json.and_then(serde_json::from_value)
                .map_err(|error| BridgeError::Setting(format!("camera {:?}: {error}", camera.name)))
        });
        let start = Pose::checked(opened.start.xyz, opened.start.q)?;
        let points = drive.poses.iter().map(|at| (at.station_m, at.pose.xyz));
        Ok(Self {
            settings,
            cameras: cameras.collect::<Result<_, _>>()?,
            // Rounded to whole metres, which f32 holds exactly: poses lose nothing on the way to
            // the driver.
            frame: LocalFrame { origin_m: start.position_m.round() },
            route: Route::new(points),
            dt_us: opened.dt_us,
            sent_us: BTreeMap::new(),
            hashes: blake3::Hasher::new(),
        })
    }

    async fn drive(
        &mut self,
        client: &mut Client,
        driver: &mut Driver,
        first: Observation,
    ) -> Result<(), StepError> {
        // The driver learns of the cameras and of the history before the first image.
        let available_cameras = self.cameras.iter().map(available).collect();
        let vehicle = Some(wire::VehicleDefinition { available_cameras });
        let start = wire::DriveSessionRequest {
            session_uuid: driver.uuid(),
            random_seed: self.settings.seed,
            rollout_spec: Some(wire::RolloutSpec { vehicle }),
        };
        driver.start_session(start).await?;
        let (history, states) = self.history(&first)?;
        driver.submit_egomotion(history, states).await?;

        // In each turn `seen` is the newest observation, of which the driver has nothing yet. The
        // history of the first one was sent above.
        let mut seen = first;
        for step in 1..=self.settings.steps {
            self.hashes.update(seen.metadata().frame_hash.as_bytes());
            self.submit_images(driver, &seen).await?;
            if step > 1 {
                let (trajectory, states) = self.present(&seen)?;
                driver.submit_egomotion(trajectory, states).await?;
            }
            let here = ego_pose(&seen)?;
            let now_us = driver_us(seen.metadata().time_us);
            // A scenario has a route of its own, which counts more than the recorded drive.
            let waypoints = match &seen.metadata().route {
                Some(route) => waypoints(&route.points),
                None => self.route.ahead(&here),
            };
            driver.submit_route(wire::Route { waypoints, timestamp_us: now_us }).await?;
            // The query time is the end of the step: up to there the plan must reach.
            let plan = driver.drive(now_us, now_us + self.dt_us.unsigned_abs()).await?;
            let planned =
                trajectory(plan.trajectory.as_ref(), &self.frame, &here, now_us, self.dt_us)?;
            let is_last = plan.terminate_session || step == self.settings.steps;
            seen = client.drive(Movement::Trajectory(planned), is_last).await?;
            // A rule of the scenario may have ended it before.
            if seen.metadata().terminated {
                break;
            }
        }
        // The last observation is hashed, too, though no driver sees it.
        self.hashes.update(seen.metadata().frame_hash.as_bytes());
        Ok(())
    }

    /// Sends the images that the driver has not seen yet, in order of time.
    async fn submit_images(
        &mut self,
        driver: &mut Driver,
        seen: &Observation,
    ) -> Result<(), DriverError> {
        for camera in &self.cameras {
            // An observation repeats the frames of the ones before it, by the number that `frames`
            // asks for.
            for image in seen.frames(&camera.name) {
                let end_us = image.metadata().shutter_end_us;
                if self.sent_us.get(&camera.name).is_some_and(|&sent_us| end_us <= sent_us) {
                    continue;
                }
                driver.submit_image(camera_image(image)?).await?;
                self.sent_us.insert(camera.name.clone(), end_us);
            }
        }
        Ok(())
    }

    /// The driven poses of the ego's history, the present one last. Their speeds are computed from
    /// differences; the present speed is that of the ego.
    fn history(
        &self,
        seen: &Observation,
    ) -> Result<(Trajectory, Vec<wire::DynamicState>), StepError> {
        let here = ego_pose(seen)?;
        let now_us = seen.metadata().time_us;
        let xyz_m = seen.history_xyz_m();
        let rotations = seen.history_rot();
        let past: Vec<Pose> = xyz_m
            .chunks_exact(3)
            .zip(rotations.chunks_exact(9))
            .map(|(xyz, rows)| {
                let entries: [f64; 9] = std::array::from_fn(|k| f64::from(rows[k]));
                // The tensor has rows, and glam takes columns.
                let matrix = DMat3::from_cols_array(&entries).transpose();
                let position_m = DVec3::from_array(std::array::from_fn(|k| f64::from(xyz[k])));
                here * Pose { position_m, rotation: DQuat::from_mat3(&matrix).normalize() }
            })
            .collect();
        // The tensor has a fixed length. Poses before the start of the episode are filled in, and
        // are no motion, so they are left out.
        let driven = (seen.metadata().ego.history_count as usize).max(1).min(past.len());
        let past = &past[past.len() - driven..];
        let seconds = 1e-6 * HISTORY_US as f64;
        let mut poses = Vec::new();
        let mut states = Vec::new();
        // `back` counts the periods from the present: driven - 1 for the oldest pose, and 1 for the
        // last pair. The present pose follows below with the ego's own speed.
        for (back, pair) in (1..driven).rev().zip(past.windows(2)) {
            let velocity = (pair[1].position_m - pair[0].position_m) / seconds;
            // The rotation from one pose to the next in the axes of the earlier one: its axis times
            // its angle, over the time between them, is the angular velocity in rad/s.
            let turned = (pair[0].rotation.inverse() * pair[1].rotation).to_scaled_axis() / seconds;
            poses.push(self.at_time(now_us - back as i64 * HISTORY_US, &pair[0]));
            states.push(state(&pair[0], velocity, turned, DVec3::ZERO));
        }
        let (present, own) = self.present(seen)?;
        poses.extend(present.poses);
        states.extend(own);
        Ok((Trajectory { poses }, states))
    }

    /// The present pose of the ego.
    fn present(
        &self,
        seen: &Observation,
    ) -> Result<(Trajectory, Vec<wire::DynamicState>), StepError> {
        let here = ego_pose(seen)?;
        let ego = &seen.metadata().ego;
        let velocity = DVec3::from_array(ego.velocity);
        let acceleration = DVec3::from_array(ego.acceleration);
        // The car turns about its own vertical axis only.
        let states = vec![state(&here, velocity, ego.yaw_rate * DVec3::Z, acceleration)];
        let poses = vec![self.at_time(seen.metadata().time_us, &here)];
        Ok((Trajectory { poses }, states))
    }

    fn at_time(&self, time_us: i64, pose: &Pose) -> PoseAtTime {
        PoseAtTime { pose: Some(self.frame.local_from(pose)), timestamp_us: driver_us(time_us) }
    }
}

/// A state in the axes of the rig, of a velocity and an acceleration in world axes.
fn state(
    pose: &Pose,
    velocity: DVec3,
    angular_rad_s: DVec3,
    acceleration: DVec3,
) -> wire::DynamicState {
    let rig_from_world = pose.rotation.inverse();
    wire::DynamicState {
        angular_velocity: Some(vec3(angular_rad_s)),
        linear_velocity: Some(vec3(rig_from_world * velocity)),
        linear_acceleration: Some(vec3(rig_from_world * acceleration)),
        // The simulation does not compute it.
        angular_acceleration: Some(Vec3::default()),
    }
}

fn vec3(v: DVec3) -> Vec3 {
    Vec3 { x: v.x as f32, y: v.y as f32, z: v.z as f32 }
}

fn camera_image(image: ImageView<'_>) -> Result<wire::CameraImage, DriverError> {
    let metadata = image.metadata();
    let image_bytes = image.encoded().to_vec();
    // The driver would refuse the message with a status that does not name the size.
    if image_bytes.len() > limits::DRIVER_IMAGE_BYTES {
        let camera = metadata.camera.clone();
        return Err(DriverError::Image { camera, bytes: image_bytes.len() });
    }
    Ok(wire::CameraImage {
        frame_start_us: driver_us(metadata.shutter_start_us),
        frame_end_us: driver_us(metadata.shutter_end_us),
        image_bytes,
        logical_id: logical_id(&metadata.camera),
    })
}

fn ego_pose(seen: &Observation) -> Result<Pose, PoseError> {
    let pose = &seen.metadata().ego.pose;
    Pose::checked(pose.xyz, pose.q)
}

/// A simulated time as the driver has it. Warm-ups are far shorter than `EPISODE_US`.
fn driver_us(time_us: i64) -> u64 {
    (EPISODE_US + time_us).unsigned_abs()
}
