//! Answers other than observations.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::Serialize;

use crate::config::Limits as ServerLimits;
use crate::fault::Fault;
use crate::memory::{MemoryPlace, SharedMemory};
use crate::sessions::ClosedSession;
use wildcity_protocol::http;
use wildcity_protocol::limits::MEMORY_SLOTS;
use wildcity_protocol::message::{
    self, Answer, Limits, Opened, RigCamera, ServerInfo, TrajectoryInfo, TwinInfo,
};
use wildcity_repair::Selection;
use wildcity_scene::appearance::Appearance;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::rig::RigLidar;
use wildcity_scene::{Manifest, Rig, SemanticClass};
use wildcity_session::{
    DamagedSummary, Engine, EpisodeSummary, EpisodeTraffic, ImageEncoding, Outcome, PixelMaps,
    ReferenceSource, Session, SessionRepair, TrajectorySummary, TwinSummaries, TwinSummary,
};
use wildcity_twin::store::Version;

use super::drive::{DriveRequest, drive};

/// Name of the server in `welcome`.
const SERVER_NAME: &str = "wildcity";

/// The answer to `hello`.
pub(crate) fn welcome(
    seq: u64,
    server: &ServerLimits,
    engine: &Engine,
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
        protocol: wildcity_protocol::PROTOCOL.to_owned(),
        server: ServerInfo {
            name: SERVER_NAME.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        },
        limits,
        backend: engine.backend().to_owned(),
        twins: twins.iter().map(|twin| twin_info(twin)).collect(),
        repairs: engine.repairs().names().map(str::to_owned).collect(),
    })
}

/// The answer to `open`, with a part of a recorded drive if the client asked for one.
pub(crate) fn opened(
    seq: u64,
    session: &Session,
    section: Option<&DriveRequest>,
) -> Result<String, Fault> {
    text(&Answer::Opened(Box::new(settings(seq, session, section)?)))
}

/// All settings of a session.
fn settings(seq: u64, session: &Session, section: Option<&DriveRequest>) -> Result<Opened, Fault> {
    let resident = session.resident();
    let Version { number, hash, manifest, .. } = &*resident.version;
    // The version of the session, which may have been opened before the latest one was made.
    let trajectory = section.map(|section| drive(&resident.version, section, "trajectory."));
    let profile = profile(session)?;
    let (encoding, quality) = encoding(session.encoding());
    let PixelMaps { depth, opacity, normals, instances, semantics } = session.maps();
    let names: Vec<_> = session.cameras().iter().map(|camera| camera.name.clone()).collect();
    let period_us = |(index, name): (usize, &String)| (name.clone(), session.period_us(index));
    // All defaults are filled in: the client reads what applies, and not what it sent.
    let outputs = message::Outputs {
        encoding,
        quality,
        depth,
        opacity,
        normals: Some(normals),
        instances: instances.then_some(true),
        semantics: semantics.then_some(true),
        frames: Some(session.frames() as u64),
        trust: Some(session.trust()),
        actors: session.reports_actors().then_some(true),
        period_us: Some(names.iter().enumerate().map(period_us).collect()),
        cameras: Some(names),
        // The sizes and crops are in the cameras below already.
        images: BTreeMap::new(),
    };
    Ok(Opened {
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
        dynamics: session.dynamics().into(),
        dt_us: session.dt_us(),
        deadline_ms: session.deadline().as_millis() as u64,
        decision_us: session.decision_us(),
        warm_up_us: session.warm_up_us(),
        cameras: session.cameras().iter().map(camera).collect(),
        lidars: session.lidars().iter().map(opened_lidar).collect(),
        outputs,
        trajectories: manifest
            .trajectories
            .iter()
            .map(TrajectorySummary::from_trajectory)
            .map(trajectory_info)
            .collect(),
        reserved_bytes: session.reserved_bytes(),
        repair: session.repair().map(|repair| opened_repair(repair, session)),
        sensors: session.sensors().cloned(),
        scenario: session.traffic().map(opened_scenario),
        semantics: semantics.then(|| opened_semantics(manifest)),
        trajectory: trajectory.transpose()?,
    })
}

fn opened_lidar(mounted: &RigLidar) -> message::OpenedLidar {
    let RigLidar { name, lidar, rig_from_lidar } = mounted;
    message::OpenedLidar {
        name: name.clone(),
        rows: lidar.rows() as u64,
        columns: lidar.columns() as u64,
        duration_us: lidar.duration_us(),
        min_range_m: lidar.min_range_m(),
        max_range_m: lidar.max_range_m(),
        lidar_to_rig: pose(rig_from_lidar),
    }
}

fn opened_semantics(manifest: &Manifest) -> message::OpenedSemantics {
    message::OpenedSemantics {
        labelled: manifest.has_classes(),
        // In the order of their values, which count up from 0.
        classes: SemanticClass::ALL.map(|class| class.name().to_owned()).to_vec(),
    }
}

fn opened_repair(repair: &SessionRepair, session: &Session) -> message::OpenedRepair {
    let model = &repair.model;
    let Selection { below, above, at_least, per_step } = repair.selection;
    message::OpenedRepair {
        model: model.manifest().name.clone(),
        version: model.manifest().version.clone(),
        repair_hash: model.repair_hash().to_hex().to_string(),
        provider: model.provider().name().to_owned(),
        deterministic: model.is_deterministic(),
        below,
        above,
        at_least,
        per_step: per_step as u64,
        on_failure: repair.on_failure,
        references: session.references().map(|source| match source {
            ReferenceSource::Recorded => message::ReferenceSource::Recorded,
            ReferenceSource::Rendered => message::ReferenceSource::Rendered,
        }),
    }
}

fn opened_scenario(traffic: &EpisodeTraffic) -> message::OpenedScenario {
    message::OpenedScenario {
        name: traffic.loaded().scenario.file.name.clone(),
        hash: traffic.loaded().hash.clone(),
        actors: traffic.specs().len() as u64,
    }
}

/// A session that is resumed together with another.
pub(crate) struct AlsoResumed<'a> {
    pub(crate) name: &'a str,
    pub(crate) session: &'a Session,
}

/// The answer to `resume`.
pub(crate) fn resumed(
    seq: u64,
    name: &str,
    last_seq: u64,
    session: Result<&Session, &ClosedSession>,
    also_resumed: &[AlsoResumed<'_>],
) -> Result<String, Fault> {
    // A closed session has no state any more, only the numbers of its summary.
    let (step, time_us) = match session {
        Ok(open) => (open.episode().step(), open.episode().time_us()),
        Err(closed) => (closed.steps, closed.time_us),
    };
    // A client that was restarted has lost the answer to `open`, so it is repeated.
    let opened = session.ok().map(|session| settings(seq, session, None)).transpose()?;
    let one = |AlsoResumed { name, session }: &AlsoResumed<'_>| {
        Ok(message::ResumedSession {
            session: (*name).to_owned(),
            step: session.episode().step(),
            time_us: session.episode().time_us(),
            opened: Box::new(settings(seq, session, None)?),
        })
    };
    let also = also_resumed.iter().map(one).collect::<Result<_, Fault>>()?;
    text(&Answer::Resumed {
        seq,
        session: name.to_owned(),
        last_seq,
        step,
        time_us,
        opened: opened.map(Box::new),
        also,
    })
}

/// The answer to a request without a result of its own, such as `prefetch` or `snapshot`.
pub(crate) fn ok(seq: u64) -> Result<String, Fault> {
    text(&Answer::Ok { seq })
}

/// The answer to `share_memory` without a proof.
pub(crate) fn shared_memory(seq: u64, memory: &SharedMemory) -> Result<String, Fault> {
    text(&Answer::SharedMemory {
        seq,
        path: memory.path.clone(),
        target: memory.target.clone(),
        proof_bytes: memory.proof_bytes() as u64,
        slots: MEMORY_SLOTS as u64,
        slot_bytes: SharedMemory::SLOT_BYTES,
    })
}

/// Where in the shared memory an answer is.
pub(crate) fn in_memory(seq: u64, place: MemoryPlace) -> Result<String, Fault> {
    let MemoryPlace { slot, offset, bytes } = place;
    text(&Answer::InMemory { seq, slot: slot as u64, offset, bytes })
}

/// The answer to `switch_version`.
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

/// The answer to `close`.
pub(crate) fn closed(
    seq: u64,
    summary: &EpisodeSummary,
    episode: Option<String>,
) -> Result<String, Fault> {
    let EpisodeSummary { outcome, steps, time_us, distance_m, least_trust } = *summary;
    let outcome = match outcome {
        Outcome::Completed => message::Outcome::Completed,
        Outcome::OffModel => message::Outcome::OffModel,
        Outcome::DrivingFailure => message::Outcome::DrivingFailure,
        Outcome::AgentError => message::Outcome::AgentError,
        Outcome::AgentTimeout => message::Outcome::AgentTimeout,
        Outcome::AgentLost => message::Outcome::AgentLost,
        Outcome::ServerError => message::Outcome::ServerError,
    };
    let summary = message::Summary { outcome, steps, time_us, distance_m, least_trust, episode };
    text(&Answer::Closed { seq, summary })
}

/// The body of `GET /v1/twins`.
pub(crate) fn twins(list: &TwinSummaries) -> http::TwinList {
    let damaged = |damaged: &DamagedSummary| {
        let DamagedSummary { name, reason } = damaged.clone();
        http::DamagedTwin { name, reason }
    };
    http::TwinList {
        twins: list.twins.iter().map(|twin| twin_info(twin)).collect(),
        damaged: list.damaged.iter().map(damaged).collect(),
    }
}

/// The body of `GET /v1/twins/{twin}`: one twin.
pub(crate) fn twin(twin: &TwinSummary) -> serde_json::Value {
    serde_json::json!(twin_info(twin))
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
        Ok(serde_json::Value::Object(mut profile)) => {
            // Leave out fields that are not set, so that a client can send the profile back.
            profile.retain(|_, value| !value.is_null());
            Ok(profile)
        }
        other => Err(Fault::Internal(format!("the profile is not an object: {other:?}"))),
    }
}

fn trajectory_info(trajectory: TrajectorySummary) -> TrajectoryInfo {
    let TrajectorySummary { name, length_m, keyframes } = trajectory;
    TrajectoryInfo { name, length_m, keyframes }
}

/// A camera, without its overlay: answers do not repeat it.
pub(super) fn camera(camera: &wildcity_scene::rig::RigCamera) -> RigCamera {
    let appearance = Appearance { overlay: None, ..camera.appearance.clone() };
    wildcity_scene::rig::RigCamera { appearance, ..camera.clone() }.into()
}

pub(super) fn pose(pose: &Pose) -> message::Pose {
    (*pose).into()
}

/// An image encoding, and the quality of JPEG.
pub(super) fn encoding(encoding: ImageEncoding) -> (message::Encoding, Option<u8>) {
    match encoding {
        ImageEncoding::Jpeg(quality) => (message::Encoding::Jpeg, Some(quality)),
        ImageEncoding::Png => (message::Encoding::Png, None),
        ImageEncoding::Raw => (message::Encoding::Raw, None),
    }
}

pub(super) fn text(value: &impl Serialize) -> Result<String, Fault> {
    serde_json::to_string(value).map_err(|error| Fault::Internal(error.to_string()))
}
