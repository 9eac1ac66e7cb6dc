//! Bodies of HTTP, both ways.

use std::collections::BTreeSet;

use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use crate::fault::Fault;
use crate::limits;
use crate::push::{Ask, AskedCells, AskedFile, Status};
use crate::report::{CellChange, FileReport, Report, State};
use crate::sessions::About;
use crate::spool::{Announced, Upload};
use wildcity_protocol::http;
use wildcity_scene::RenderProfile;
use wildcity_scene::rig::is_name;
use wildcity_twin::ingest::{Axes, BadGaussian};
use wildcity_twin::store::{LogEntry, Version};

use super::answer::pose;
use super::request::pose_of;

/// The body of `POST /v1/uploads`.
pub(crate) fn new_upload(body: &[u8]) -> Result<Announced, Fault> {
    let http::NewUpload { name, size, digest } = parse(body)?;
    let is_plain = |c: char| !c.is_control() && c != '/' && c != '\\';
    if name.is_empty() || name.len() > limits::UPLOAD_NAME_BYTES || !name.chars().all(is_plain) {
        let most = limits::UPLOAD_NAME_BYTES;
        let must = format!("{name:?}; 1 to {most} bytes without / and \\ are accepted");
        return Err(Fault::OutOfRange { field: "name".to_owned(), must });
    }
    let digest = digest.try_into().map_err(|reason: String| Fault::InvalidRequest {
        field: Some("digest".to_owned()),
        reason: format!("digest: {reason}"),
    })?;
    Ok(Announced { name, size, digest })
}

/// An upload.
pub(crate) fn upload(upload: &Upload) -> Value {
    let Announced { name, size, .. } = upload.announced();
    json!(http::Upload {
        id: upload.id().to_owned(),
        name: name.clone(),
        size: *size,
        offset: upload.offset(),
        complete: upload.is_complete(),
    })
}

/// The body of `POST /v1/twins/{twin}/pushes`.
pub(crate) fn new_push(twin: String, body: &[u8]) -> Result<Ask, Fault> {
    let asked: http::NewPush = parse(body)?;
    // What was understood, not what was sent: spaces make no other push.
    let content = blake3::hash(json!([&twin, &asked]).to_string().as_bytes());
    let http::NewPush { id, files, base, cells, record, levels, profile, note, preview } = asked;
    let name_of = |field: &str, name: String| match is_name(&name) {
        true => Ok(name),
        false => Err(Fault::InvalidName { field: field.to_owned(), name }),
    };
    let out_of_range =
        |field: &str, must: String| Err(Fault::OutOfRange { field: field.to_owned(), must });
    if !(1..=limits::PUSH_FILES).contains(&files.len()) {
        let must = format!("{} entries; 1 to {} are accepted", files.len(), limits::PUSH_FILES);
        return out_of_range("files", must);
    }
    let file = |(index, file): (usize, http::PushFile)| {
        let axes = file.axes.parse::<Axes>().and_then(|axes| axes.scaled(file.scale));
        let axes = axes.map_err(|error| Fault::InvalidRequest {
            field: Some(format!("files[{index}]")),
            reason: format!("files[{index}]: {error}"),
        })?;
        let options = [format!("axes={}", file.axes), format!("scale={}", file.scale)];
        Ok(AskedFile { upload: file.upload, axes, options })
    };
    let files = files.into_iter().enumerate().map(file).collect::<Result<_, Fault>>()?;
    let cells = match cells {
        None => AskedCells::Touched,
        Some(http::CellSelection::All(http::AllCells::All)) => AskedCells::All,
        Some(http::CellSelection::Listed(cells)) if cells.is_empty() => {
            return out_of_range("cells", "empty; leave it out, or name some".to_owned());
        }
        Some(http::CellSelection::Listed(cells)) => {
            AskedCells::These(cells.into_iter().collect::<BTreeSet<_>>())
        }
    };
    let record = match record {
        None => None,
        Some(text) => match text.parse() {
            Ok(record) => Some(record),
            Err(error) => {
                let reason = format!("record: {error}");
                return Err(Fault::InvalidRequest { field: Some("record".to_owned()), reason });
            }
        },
    };
    for (index, setting) in profile.iter().enumerate() {
        RenderProfile::default().set(setting).map_err(|error| Fault::InvalidRequest {
            field: Some(format!("profile[{index}]")),
            reason: format!("profile[{index}]: {error}"),
        })?;
    }
    if note.as_ref().is_some_and(|note| note.chars().count() > limits::NOTE_CHARS) {
        let must = format!("longer than {} characters", limits::NOTE_CHARS);
        return out_of_range("note", must);
    }
    let poses = match preview.poses {
        Some(poses) if poses.len() > limits::GOLDEN_POSES => {
            let must = format!("{} poses; at most {}", poses.len(), limits::GOLDEN_POSES);
            return out_of_range("golden.poses", must);
        }
        Some(poses) => {
            let checked = |(index, pose)| pose_of(&format!("golden.poses[{index}]"), pose);
            Some(poses.iter().enumerate().map(checked).collect::<Result<_, _>>()?)
        }
        None => None,
    };
    Ok(Ask {
        id: id.map(|id| name_of("id", id)).transpose()?,
        twin: name_of("twin", twin)?,
        content,
        files,
        base,
        cells,
        record,
        levels,
        profile,
        note,
        poses,
        min_psnr_db: preview.min_psnr_db,
    })
}

/// A push.
pub(crate) fn push(id: &str, twin: &str, status: &Status) -> Value {
    let state = match status.state {
        State::Queued => http::PushState::Queued,
        State::Ingesting => http::PushState::Ingesting,
        State::Validating => http::PushState::Validating,
        State::Committing => http::PushState::Committing,
        State::Prefetching => http::PushState::Prefetching,
        State::Ready => http::PushState::Ready,
        State::Refused => http::PushState::Refused,
        State::Failed => http::PushState::Failed,
    };
    let (done, total) = status.progress;
    let version = status.version.as_ref();
    json!(http::Push {
        id: id.to_owned(),
        twin: twin.to_owned(),
        state,
        progress: http::Progress { done, total },
        version: version.map(|(number, _)| *number),
        version_hash: version.map(|(_, hash)| hash.clone()),
        report: status.report.as_deref().map(report),
        error: status.error.as_deref().map(|fault| http::PushError {
            code: super::fault::code_and_field(fault).0,
            message: fault.to_string(),
            cells: super::fault::cells(fault).to_vec(),
        }),
    })
}

fn report(report: &Report) -> http::PushReport {
    http::PushReport {
        files: report.files.iter().map(file).collect(),
        gaussians: report.gaussians,
        left_out: report.left_out,
        sh_degree: report.sh_degree,
        ranges: report.ranges.map(|ranges| http::Ranges {
            mean_m: ranges.mean_m,
            scale_m: ranges.scale_m,
            opacity: ranges.opacity,
            quat_length: ranges.quat_length,
        }),
        cells: report
            .cells
            .iter()
            .map(|&CellChange { cell, before, after }| http::CellReport { cell, before, after })
            .collect(),
        previews: report
            .golden
            .iter()
            .map(|golden| http::PsnrPreview {
                pose: pose(&golden.world_from_rig),
                psnr_db: Some(golden.psnr_db).filter(|db| db.is_finite()),
            })
            .collect(),
    }
}

fn file(file: &FileReport) -> http::FileReport {
    let bad = |bad: &BadGaussian| http::BadGaussian {
        index: bad.index as u64,
        field: bad.field.clone(),
        value: bad.value.clone(),
        must: bad.must.to_owned(),
    };
    http::FileReport {
        name: file.name.clone(),
        gaussians: file.gaussians,
        bad: file.bad,
        first_bad: file.first_bad.iter().map(bad).collect(),
    }
}

/// The body of `POST /v1/twins/{twin}/rollback`: the old version.
pub(crate) fn rollback(body: &[u8]) -> Result<u64, Fault> {
    parse::<http::Rollback>(body).map(|rollback| rollback.version)
}

/// The versions of a twin, the latest last. Those after one that is held are not ready.
pub(crate) fn versions(versions: &[LogEntry], held: Option<u64>) -> Value {
    let version = |entry: &LogEntry| http::VersionInfo {
        version: entry.number,
        version_hash: entry.hash.clone(),
        created_us: entry.created_us,
        kind: entry.kind.to_string(),
        ready: held.is_none_or(|held| entry.number <= held),
        parent: entry.parent,
    };
    json!({ "versions": versions.iter().map(version).collect::<Vec<_>>() })
}

/// One version that was just made.
pub(crate) fn version(version: &Version) -> Value {
    json!({ "version": version.number, "version_hash": version.hash })
}

/// All sessions.
pub(crate) fn sessions(sessions: &[(String, About, bool)]) -> Value {
    let session = |(name, about, connected): &(String, About, bool)| http::SessionInfo {
        session: name.clone(),
        twin: about.twin.clone(),
        version: about.version,
        step: about.step,
        pose: pose(&about.world_from_rig),
        connected: *connected,
    };
    json!({ "sessions": sessions.iter().map(session).collect::<Vec<_>>() })
}

/// Reads a body, and names the field of a mistake.
fn parse<T: DeserializeOwned>(body: &[u8]) -> Result<T, Fault> {
    // serde would take a list for the object's values in order.
    if body.trim_ascii_start().first() == Some(&b'[') {
        let reason = "expected one object, not a list".to_owned();
        return Err(Fault::InvalidRequest { field: None, reason });
    }
    let deserializer = &mut serde_json::Deserializer::from_slice(body);
    let parsed = serde_path_to_error::deserialize(&mut *deserializer);
    let parsed = parsed.map_err(|error| {
        let (path, error) = (error.path().to_string(), error.into_inner());
        match error.classify() {
            serde_json::error::Category::Data if path != "." => {
                Fault::InvalidRequest { reason: format!("{path}: {error}"), field: Some(path) }
            }
            serde_json::error::Category::Data => {
                Fault::InvalidRequest { field: None, reason: error.to_string() }
            }
            _ => Fault::MalformedJson(error.to_string()),
        }
    })?;
    deserializer.end().map_err(|error| Fault::MalformedJson(error.to_string()))?;
    Ok(parsed)
}
