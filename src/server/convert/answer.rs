//! Session to wire.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::Serialize;

use crate::Limits as ServerLimits;
use crate::fault::Fault;
use wildcity_protocol::http::Refusal;
use wildcity_protocol::message::{
    self, Answer, Limits, Opened, RigCamera, ServerInfo, TrajectoryInfo, TwinInfo,
};
use wildcity_protocol::observation::{
    Ego, Image, ObservationMetadata, Residency, Stage, Timings, Trust,
};
use wildcity_scene::Rig;
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_session::{
    self, DType, Encoding, EpisodeSummary, HEADER_PREFIX_BYTES, Outcome, PastImageInfo, PixelMaps,
    Session, TensorKind, TrajectorySummary, TwinSummary,
};
use wildcity_sim::{Dynamics, EgoModel};
use wildcity_twin::store::Version;

use super::SUBPROTOCOL;
use super::camera::{beyond, exposure_to, shutter_to};
use super::fault::{cells, code_and_field};

/// To `hello`.
pub(crate) fn welcome(
    seq: u64,
    server: &ServerLimits,
    backend: &str,
    twins: &[Arc<TwinSummary>],
) -> Result<String, Fault> {
    let limits = Limits {
        message_bytes: wildcity_protocol::limits::INBOUND_MESSAGE_BYTES as u64,
        observe_poses: wildcity_session::limits::OBSERVE_POSES as u64,
        cameras: Rig::MAX_CAMERAS as u64,
        side_px: Camera::MAX_SIDE_PX.into(),
        answer_pixels: wildcity_session::limits::ANSWER_PIXELS,
        idle_ms: server.idle.as_millis() as u64,
        resume_ms: server.resume_grace.as_millis() as u64,
    };
    text(&Answer::Welcome {
        seq,
        protocol: SUBPROTOCOL.to_owned(),
        server: ServerInfo {
            name: env!("CARGO_PKG_NAME").to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        },
        limits,
        backend: backend.to_owned(),
        twins: twins.iter().map(|twin| twin_info(twin)).collect(),
    })
}

/// To `open`.
pub(crate) fn opened(seq: u64, session: &Session) -> Result<String, Fault> {
    let resident = session.resident();
    let Version { number, hash, manifest, .. } = &*resident.version;
    let profile = profile(session)?;
    let (encoding, quality) = encoding(session.encoding());
    let PixelMaps { depth, opacity, normals } = session.maps();
    let names: Vec<_> = session.cameras().iter().map(|camera| camera.name.clone()).collect();
    let period_us = |(index, name): (usize, &String)| (name.clone(), session.period_us(index));
    let outputs = message::Outputs {
        encoding,
        quality,
        depth,
        opacity,
        normals: Some(normals),
        frames: Some(session.frames() as u64),
        trust: Some(session.trust()),
        period_us: Some(names.iter().enumerate().map(period_us).collect()),
        cameras: Some(names),
        images: BTreeMap::new(),
    };
    text(&Answer::Opened(Box::new(Opened {
        seq,
        session: session.name().to_owned(),
        twin: manifest.twin.clone(),
        version: *number,
        version_hash: hash.clone(),
        profile_hash: session.profile_hash().to_hex().to_string(),
        profile,
        backend: session.backend().to_owned(),
        seed: session.episode().seed(),
        start: pose(&session.start()),
        dynamics: dynamics(session.dynamics()),
        dt_us: session.dt_us(),
        deadline_ms: session.deadline().as_millis() as u64,
        decision_us: session.decision_us(),
        warm_up_us: session.warm_up_us(),
        cameras: session.cameras().iter().map(camera).collect(),
        outputs,
        trajectories: manifest
            .trajectories
            .iter()
            .map(TrajectorySummary::of)
            .map(trajectory_info)
            .collect(),
        reserved_bytes: session.reserved_bytes(),
    })))
}

/// To `resume`.
pub(crate) fn resumed(seq: u64, last_seq: u64, session: &Session) -> Result<String, Fault> {
    let episode = session.episode();
    let (step, time_us) = (episode.step(), episode.time_us());
    text(&Answer::Resumed { seq, session: session.name().to_owned(), last_seq, step, time_us })
}

/// To `prefetch`.
pub(crate) fn ok(seq: u64) -> Result<String, Fault> {
    text(&Answer::Ok { seq })
}

/// To `switch_version`.
pub(crate) fn switched(seq: u64, session: &Session) -> Result<String, Fault> {
    let Version { number, hash, .. } = &*session.resident().version;
    text(&Answer::Switched {
        seq,
        version: *number,
        version_hash: hash.clone(),
        profile_hash: session.profile_hash().to_hex().to_string(),
        profile: profile(session)?,
    })
}

/// To `close`.
pub(crate) fn closed(seq: u64, summary: &EpisodeSummary) -> Result<String, Fault> {
    let EpisodeSummary { outcome, steps, time_us, distance_m, least_trust } = *summary;
    let outcome = match outcome {
        Outcome::Completed => message::Outcome::Completed,
        Outcome::OffModel => message::Outcome::OffModel,
        Outcome::AgentError => message::Outcome::AgentError,
        Outcome::AgentTimeout => message::Outcome::AgentTimeout,
        Outcome::AgentLost => message::Outcome::AgentLost,
        Outcome::ServerError => message::Outcome::ServerError,
    };
    let summary = message::Summary { outcome, steps, time_us, distance_m, least_trust };
    text(&Answer::Closed { seq, summary })
}

/// To a request that was refused.
pub(crate) fn refused(seq: Option<u64>, fault: &Fault) -> String {
    let (code, field) = code_and_field(fault);
    let (message, fatal) = (fault.to_string(), fault.is_fatal());
    // An error of strings and flags always has JSON.
    text(&Answer::Error { seq, code, message, field, fatal }).unwrap_or_default()
}

/// The code of a fault as it stands on the wire.
#[derive(Clone, Debug)]
pub(crate) struct WireCode(pub(crate) String);

/// The code of a fault.
pub(crate) fn code(fault: &Fault) -> WireCode {
    let code = serde_json::to_value(code_and_field(fault).0);
    WireCode(code.ok().and_then(|code| code.as_str().map(str::to_owned)).unwrap_or_default())
}

/// The body of an HTTP answer that refuses.
pub(crate) fn refusal_body(fault: &Fault) -> serde_json::Value {
    let (code, field) = code_and_field(fault);
    let offset = match fault {
        Fault::UploadOffset { held, .. } => Some(*held),
        _ => None,
    };
    let cells = cells(fault).to_vec();
    serde_json::json!(Refusal { code, message: fault.to_string(), field, cells, offset })
}

/// The body of `GET /v1/twins`.
pub(crate) fn twins(twins: &[Arc<TwinSummary>]) -> serde_json::Value {
    serde_json::json!({ "twins": twins.iter().map(|twin| twin_info(twin)).collect::<Vec<_>>() })
}

/// The body of `GET /v1/twins/{twin}`.
pub(crate) fn twin(twin: &TwinSummary) -> serde_json::Value {
    serde_json::json!(twin_info(twin))
}

/// Completes an observation: writes the header that says what its bytes are.
pub(crate) fn observation(
    seq: u64,
    session: &Session,
    mut frame: wildcity_session::Observation,
) -> Result<wildcity_session::Observation, Fault> {
    let image_names = image_names(session, &frame);
    let mut header = Header { tensors: BTreeMap::new(), metadata: BTreeMap::new() };
    for tensor in &frame.tensors {
        let name = match tensor.kind {
            TensorKind::HistoryXyz => "ego.history_xyz".to_owned(),
            TensorKind::HistoryRotation => "ego.history_rot".to_owned(),
            TensorKind::Depth(image) => format!("{}/depth", image_names[image]),
            TensorKind::Opacity(image) => format!("{}/opacity", image_names[image]),
            TensorKind::Normals(image) => format!("{}/normals", image_names[image]),
            TensorKind::Rgb(image) => format!("{}/rgb", image_names[image]),
            TensorKind::PastRgb(image) => past_tensor(session, &frame.history[image]),
        };
        let dtype = match tensor.dtype {
            DType::F32 => "F32",
            DType::U8 => "U8",
        };
        let data_offsets = [tensor.bytes.start, tensor.bytes.end];
        header.tensors.insert(name, TensorInfo { dtype, shape: &tensor.shape, data_offsets });
    }
    let observation = text(&metadata(seq, session, &frame, &image_names))?;
    header.metadata.insert("observation", observation);
    let header = text(&header)?;

    let room = frame.buffer.header_mut();
    let (prefix, room) = room.split_at_mut(HEADER_PREFIX_BYTES);
    if header.len() > room.len() {
        let what = format!("a header of {} bytes, room for {}", header.len(), room.len());
        return Err(Fault::Internal(what));
    }
    prefix.copy_from_slice(&(room.len() as u64).to_le_bytes());
    let (written, padding) = room.split_at_mut(header.len());
    written.copy_from_slice(header.as_bytes());
    padding.fill(b' ');
    Ok(frame)
}

#[derive(Serialize)]
struct Header<'a> {
    #[serde(rename = "__metadata__")]
    metadata: BTreeMap<&'static str, String>,
    #[serde(flatten)]
    tensors: BTreeMap<String, TensorInfo<'a>>,
}

#[derive(Serialize)]
struct TensorInfo<'a> {
    dtype: &'static str,
    shape: &'a [usize],
    data_offsets: [usize; 2],
}

/// Where an image's tensors are, without the `/rgb` at the end.
fn image_names(session: &Session, frame: &wildcity_session::Observation) -> Vec<String> {
    let several = frame.images.iter().any(|image| image.pose > 0);
    let name = |image: &wildcity_session::ImageInfo| {
        let camera = &session.cameras()[image.camera].name;
        if several {
            format!("pose/{}/camera/{camera}", image.pose)
        } else {
            format!("camera/{camera}")
        }
    };
    frame.images.iter().map(name).collect()
}

fn past_tensor(session: &Session, past: &PastImageInfo) -> String {
    format!("camera/{}/history/{}/rgb", session.cameras()[past.camera].name, past.back)
}

fn metadata(
    seq: u64,
    session: &Session,
    frame: &wildcity_session::Observation,
    image_names: &[String],
) -> ObservationMetadata {
    let (episode, version) = (session.episode(), &session.resident().version);
    let time_us = episode.time_us();
    let (encoding, _) = encoding(session.encoding());
    // Of `images`, and of `history` alike.
    let image = |index: usize, tensor: String, time_us: i64, hash: &blake3::Hash| {
        let mounted = &session.cameras()[index];
        let Pinhole { fx, fy, cx, cy } = mounted.camera.pinhole;
        let RigCamera { name: camera, width, height, lens, windshield, camera_to_rig, .. } =
            camera(mounted);
        let exposed_us = mounted.shutter.map_or(0, |shutter| shutter.duration_us);
        Image {
            camera,
            index: index as u64,
            pose: 0,
            back: 0,
            tensor,
            encoding,
            width,
            height,
            fx,
            fy,
            cx,
            cy,
            lens,
            windshield,
            seen: session.visible_share(index),
            camera_to_rig,
            shutter_start_us: time_us - exposed_us,
            shutter_end_us: time_us,
            hash: hash.to_hex().to_string(),
            trust: None,
        }
    };
    let drawn = |(drawn, name): (&wildcity_session::ImageInfo, &String)| {
        let tensor = format!("{name}/rgb");
        let pose = drawn.pose as u64;
        let trust = drawn.trust.map(trust);
        Image { pose, trust, ..image(drawn.camera, tensor, drawn.time_us, &drawn.hash) }
    };
    let past = |past: &PastImageInfo| {
        let (back, trust) = (past.back as u64, past.trust.map(trust));
        Image {
            back,
            trust,
            ..image(past.camera, past_tensor(session, past), past.time_us, &past.hash)
        }
    };
    let timings = &frame.timings;
    let ms = |duration: std::time::Duration| duration.as_secs_f64() * 1e3;
    let stage = |&(name, ms): &(&str, f64)| Stage { name: name.to_owned(), ms };
    ObservationMetadata {
        seq,
        step: episode.step(),
        time_us,
        session: session.name().to_owned(),
        seed: episode.seed(),
        terminated: episode.terminated(),
        twin: version.manifest.twin.clone(),
        version: version.number,
        version_hash: version.hash.clone(),
        profile_hash: session.profile_hash().to_hex().to_string(),
        backend: session.backend().to_owned(),
        frame_hash: frame.frame_hash.to_hex().to_string(),
        ego: Ego {
            pose: pose(&episode.world_from_rig()),
            velocity: episode.ego().velocity_m_s().to_array(),
            acceleration: episode.ego().acceleration_m_s2().to_array(),
            yaw_rate: episode.ego().yaw_rate_rad_s(),
            steering: episode.ego().steering_rad(),
            history_count: frame.history_count as u64,
        },
        images: frame.images.iter().zip(image_names).map(drawn).collect(),
        history: frame.history.iter().map(past).collect(),
        timings: Timings {
            queue_ms: ms(timings.queue),
            render_ms: ms(timings.render),
            encode_ms: ms(timings.encode),
            stages_ms: timings.stages_ms.iter().map(stage).collect(),
        },
        residency: Residency {
            held_bytes: frame.residency.held_bytes,
            limit_bytes: frame.residency.limit_bytes,
            waited_for: frame.residency.waited_for as u64,
            waited_us: frame.residency.waited.as_micros() as u64,
        },
    }
}

fn trust(trust: wildcity_session::Trust) -> Trust {
    let wildcity_session::Trust { value, distance_m, angle_rad, low_coverage, outside } = trust;
    Trust { value, distance_m, angle_rad, low_coverage, outside }
}

fn dynamics(dynamics: Dynamics) -> message::Dynamics {
    let Dynamics { model, speed_m_s, reverse } = dynamics;
    let model = match model {
        EgoModel::Teleport => message::DynamicsModel::Teleport,
        EgoModel::Kinematic => message::DynamicsModel::Kinematic,
        EgoModel::Dynamic => message::DynamicsModel::Dynamic,
    };
    message::Dynamics { model, speed: speed_m_s, reverse }
}

fn twin_info(twin: &TwinSummary) -> TwinInfo {
    TwinInfo {
        name: twin.name.clone(),
        version: twin.number,
        version_hash: twin.hash.clone(),
        gaussians: twin.gaussians,
        sh_degree: twin.sh_degree,
        trajectories: twin.trajectories.iter().cloned().map(trajectory_info).collect(),
    }
}

fn profile(session: &Session) -> Result<serde_json::Map<String, serde_json::Value>, Fault> {
    match serde_json::to_value(session.profile()) {
        Ok(serde_json::Value::Object(profile)) => Ok(profile),
        other => Err(Fault::Internal(format!("the profile is no object: {other:?}"))),
    }
}

fn trajectory_info(log: TrajectorySummary) -> TrajectoryInfo {
    let TrajectorySummary { name, length_m, keyframes } = log;
    TrajectoryInfo { name, length_m, keyframes }
}

fn camera(camera: &wildcity_scene::rig::RigCamera) -> RigCamera {
    let Camera { width_px, height_px, pinhole, .. } = camera.camera;
    let (lens, windshield) = beyond(&camera.camera);
    RigCamera {
        name: camera.name.clone(),
        width: width_px.into(),
        height: height_px.into(),
        fx: Some(pinhole.fx),
        fy: Some(pinhole.fy),
        cx: pinhole.cx,
        cy: pinhole.cy,
        lens,
        windshield,
        shutter: camera.shutter.map(shutter_to),
        exposure: camera.appearance.exposure.map(exposure_to),
        overlay: None,
        camera_to_rig: pose(&camera.rig_from_camera),
    }
}

pub(super) fn pose(pose: &Pose) -> message::Pose {
    message::Pose { xyz: pose.position_m.to_array(), q: pose.q_wxyz() }
}

fn encoding(encoding: Encoding) -> (message::Encoding, Option<u8>) {
    match encoding {
        Encoding::Jpeg(quality) => (message::Encoding::Jpeg, Some(quality)),
        Encoding::Png => (message::Encoding::Png, None),
        Encoding::Raw => (message::Encoding::Raw, None),
    }
}

fn text(value: &impl Serialize) -> Result<String, Fault> {
    serde_json::to_string(value).map_err(|error| Fault::Internal(error.to_string()))
}
