//! Bodies of HTTP requests and answers.

use std::fmt::Display;
use std::str::FromStr;
use std::time::UNIX_EPOCH;

use glam::DVec3;
use serde_json::{Value, json};

use crate::fault::{Fault, Report};
use crate::limits;
use crate::sessions::ListedSession;
use crate::spool::{Announced, Upload};
use wildcity_episode::{Listed, Overview};
use wildcity_protocol::http;
use wildcity_push::{
    CellChange, CellSelection, DriveRequest, EditRequest, FileReport, Frame, PushError, PushReport,
    PushRequest, PushedVersion, RequestedFile, SourceAxes, State, Status, Survey,
};
use wildcity_scene::Rig;
use wildcity_scene::align::GroundPlane;
use wildcity_session::SessionError;
use wildcity_twin::ingest::{BadGaussian, IngestError};
use wildcity_twin::store::{LogEntry, Version};

use super::answer::pose;
use super::field::convert_poses;
use super::mistake::read_body;

/// The body of `POST /v1/uploads`.
pub(crate) fn new_upload(body: &[u8]) -> Result<Announced, Fault> {
    let http::NewUpload { name, size, digest } = read_body(body)?;
    // The name is not used as a path; it is matched with the names within other files, and written
    // to logs.
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

/// The body of `POST /v1/twins/{twin}/pushes`, checked as far as it can be without the files.
pub(crate) fn new_push(twin: String, body: &[u8]) -> Result<PushRequest, Fault> {
    let body: http::NewPush = read_body(body)?;
    // The hash is computed from the parsed body, so that white space does not make it a different
    // push. Nor does the name of a lone file, which no other names.
    let mut content = body.clone();
    if let [lone] = &mut content.files[..] {
        lone.name = None;
    }
    let request_hash = blake3::hash(json!([&twin, &content]).to_string().as_bytes());
    let http::NewPush {
        id,
        files,
        frame,
        base,
        cells,
        record,
        levels,
        profile,
        note,
        preview,
        drop_bad,
    } = body;
    // `None` lets the server choose, and an empty list asks for no preview.
    let preview_poses = preview.poses.map(|poses| {
        convert_poses("golden.poses", &poses, wildcity_push::limits::PREVIEW_MAX_POSES)
    });
    let request = PushRequest {
        id,
        twin,
        request_hash,
        files: requested_files(files)?,
        frame: match frame {
            None | Some(http::PushFrame::Twin) => Frame::Twin,
            Some(http::PushFrame::Capture) => Frame::Capture,
        },
        base,
        cells: match cells {
            None => CellSelection::Touched,
            Some(http::CellSelection::All(http::AllCells::All)) => CellSelection::All,
            Some(http::CellSelection::Listed(cells)) => {
                CellSelection::These(cells.into_iter().collect())
            }
        },
        record: record.map(|text| parse_field("record", &text)).transpose()?,
        levels,
        profile,
        note,
        preview_poses: preview_poses.transpose()?,
        min_psnr_db: preview.min_psnr_db,
        drop_bad,
    };
    request.check()?;
    Ok(request)
}

/// The files of a push.
pub(super) fn requested_files(files: Vec<http::PushFile>) -> Result<Vec<RequestedFile>, PushError> {
    let files = files.into_iter().enumerate();
    files.map(|(index, file)| requested_file(index, file)).collect()
}

fn requested_file(index: usize, file: http::PushFile) -> Result<RequestedFile, PushError> {
    let given = SourceAxes::given(file.axes.as_deref(), file.scale);
    let axes = given.map_err(|error| {
        // Both are read together, so that the error has to say which one it is about.
        let part = match error {
            IngestError::InvalidAxes { option: "--scale", .. } => "scale",
            _ => "axes",
        };
        let field = format!("files[{index}].{part}");
        PushError::InvalidField { field, reason: error.to_string() }
    })?;
    Ok(RequestedFile { upload: file.upload, axes, name: file.name })
}

/// Reads a value that is text on the wire.
pub(super) fn parse_field<T: FromStr<Err: Display>>(
    field: &str,
    text: &str,
) -> Result<T, PushError> {
    text.parse().map_err(|error: T::Err| PushError::InvalidField {
        field: field.to_owned(),
        reason: error.to_string(),
    })
}

/// The status of a push.
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
    let progress = http::Progress { done: status.progress.done, total: status.progress.total };
    let version = status.version.as_ref();
    json!(http::Push {
        id: id.to_owned(),
        twin: twin.to_owned(),
        state,
        progress,
        version: version.map(|PushedVersion { number, .. }| *number),
        version_hash: version.map(|PushedVersion { hash, .. }| hash.clone()),
        report: status.report.as_deref().map(report),
        error: status.error.as_deref().map(push_error),
    })
}

fn push_error(error: &PushError) -> http::PushError {
    let http::Refusal { code, message, cells, .. } = Report::from_push(error).body;
    http::PushError { code, message, cells }
}

fn report(report: &PushReport) -> http::PushReport {
    http::PushReport {
        files: report.files.iter().map(file).collect(),
        gaussians: report.gaussians,
        left_out: report.left_out,
        sh_degree: report.sh_degree,
        frame: Some(match report.frame {
            Frame::Twin => http::PushFrame::Twin,
            Frame::Capture => http::PushFrame::Capture,
        }),
        aligned: report.is_aligned,
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
            .preview
            .iter()
            .map(|preview| http::PsnrPreview {
                pose: pose(&preview.world_from_rig),
                // JSON has no infinity: equal images have no PSNR.
                psnr_db: Some(preview.psnr_db).filter(|db| db.is_finite()),
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
        dropped: file.dropped,
        warnings: file.warnings.clone(),
        assumed: file.assumed.clone(),
    }
}

/// The body of `POST /v1/twins/{twin}/rollback`: the number of the old version.
pub(crate) fn rollback(body: &[u8]) -> Result<u64, Fault> {
    read_body::<http::Rollback>(body).map(|rollback| rollback.version)
}

/// The body of `POST /v1/twins/{twin}/edits`.
pub(crate) fn new_edit(twin: String, body: &[u8]) -> Result<EditRequest, Fault> {
    let http::NewEdit { base, ground, scale, drive, rig } = read_body(body)?;
    let unknown = |name| SessionError::UnknownRig { name, known: Rig::preset_names().collect() };
    let rig = rig.map(|name| Rig::preset(&name).ok_or_else(|| unknown(name)));
    let drive = drive.map(|http::EditDrive { name, points, speed }| {
        let points = points.into_iter().map(DVec3::from_array).collect();
        DriveRequest { name, points, speed_m_s: speed }
    });
    Ok(EditRequest {
        twin,
        base,
        ground: ground.map(|http::EditGround { points, above }| {
            (points.map(DVec3::from_array), DVec3::from_array(above))
        }),
        scale: scale.map(|http::EditScale { points, distance_m }| {
            (points.map(DVec3::from_array), distance_m)
        }),
        drive,
        rig: rig.transpose()?,
    })
}

/// Where a twin is, and its ground as the field `ground` of an edit.
pub(crate) fn survey(survey: &Survey) -> Value {
    let ground = survey.ground.map(|GroundPlane { point, up }| {
        let (across, along) = up.any_orthonormal_pair();
        let radius = survey.extent.radius;
        // Three points of the plane and one above it, so that the answer can be sent back as the
        // edit. The radius of the scene keeps them far apart.
        let points = [point, point + radius * across, point + radius * along];
        http::EditGround {
            points: points.map(|point| point.to_array()),
            above: (point + radius * up).to_array(),
        }
    });
    json!(http::Ground {
        version: survey.version,
        middle: survey.extent.middle.to_array(),
        radius: survey.extent.radius,
        ground,
    })
}

/// The version of an edit.
pub(crate) fn edited(version: &PushedVersion) -> Value {
    json!(http::MadeVersion { version: version.number, version_hash: version.hash.clone() })
}

/// The versions of a twin, the latest last. Versions after `held` are not ready.
pub(crate) fn versions(versions: &[LogEntry], held: Option<u64>) -> Value {
    let version = |entry: &LogEntry| http::VersionInfo {
        version: entry.number,
        version_hash: entry.hash.clone(),
        created_us: entry.created_us,
        kind: entry.kind_name().to_owned(),
        // Later versions are committed, but sessions still open the one that is held.
        ready: held.is_none_or(|held| entry.number <= held),
        parent: entry.parent,
    };
    json!({ "versions": versions.iter().map(version).collect::<Vec<_>>() })
}

/// A version that was just made.
pub(crate) fn version(version: &Version) -> Value {
    json!(http::MadeVersion { version: version.number, version_hash: version.hash.clone() })
}

pub(crate) fn sessions(sessions: &[ListedSession]) -> Value {
    let session = |ListedSession { name, view, connected }: &ListedSession| http::SessionInfo {
        session: name.clone(),
        twin: view.twin.clone(),
        version: view.version,
        step: view.step,
        pose: pose(&view.world_from_rig),
        connected: *connected,
    };
    json!({ "sessions": sessions.iter().map(session).collect::<Vec<_>>() })
}

pub(crate) fn ticket(ticket: String) -> Value {
    json!(http::Ticket { ticket, expires_ms: limits::TICKET_AGE.as_millis() as u64 })
}

/// A recorded episode, and its content.
pub(crate) struct ListedEpisode {
    pub(crate) listed: Listed,
    pub(crate) overview: Overview,
    /// Why it has no MCAP file.
    pub(crate) mcap_error: Option<String>,
}

pub(crate) fn episodes(episodes: &[ListedEpisode]) -> Value {
    let episode = |ListedEpisode { listed, overview, mcap_error }: &ListedEpisode| {
        // Not all file systems have the time of the last change.
        let since_1970 = listed.modified.and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        http::EpisodeInfo {
            episode: listed.name.clone(),
            twin: overview.head.twin.clone(),
            version: overview.head.version,
            steps: overview.steps,
            time_us: overview.time_us,
            bytes: listed.bytes,
            mcap_bytes: listed.mcap_bytes,
            // A file that exists now was made after the failure.
            mcap_error: mcap_error.clone().filter(|_| listed.mcap_bytes.is_none()),
            modified_us: since_1970.map(|time| time.as_micros() as u64),
            scenario: overview.scenario.clone(),
            outcome: overview.outcome.clone(),
            verdict: overview.verdict.clone(),
        }
    };
    json!({ "episodes": episodes.iter().map(episode).collect::<Vec<_>>() })
}
