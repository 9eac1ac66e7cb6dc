//! Reads the files of a push and joins them to one scene.

use wildcity_scene::Gaussians;
use wildcity_twin::ingest::IngestError;

use crate::error::PushError;
use crate::limits;
use crate::report::{FileReport, PushReport, Ranges};
use crate::request::{PushRequest, RequestedFile};
use crate::source::{SourceFile, SourceScene, read_scene};
use crate::status::Push;

/// The joined files of a push.
pub(crate) struct PushedScene {
    pub(crate) gaussians: Gaussians,
    /// BLAKE3 of each file, in hex.
    pub(crate) hashes: Vec<String>,
    /// The axes and scale of each file.
    pub(crate) options: Vec<String>,
    pub(crate) report: PushReport,
}

/// Reads the files in order, converts them to the twin's axes, and joins them. The report of the push
/// is set on success, and on failure if Gaussians are the reason.
pub(crate) fn read(
    push: &Push,
    request: &PushRequest,
    files: &[SourceFile],
) -> Result<PushedScene, PushError> {
    let mut scene = PushedScene {
        gaussians: Gaussians::default(),
        hashes: Vec::with_capacity(files.len()),
        options: Vec::new(),
        report: PushReport::default(),
    };
    let total_bytes: u64 = files.iter().map(|file| file.bytes).sum();
    let mut read_bytes = 0;
    for (requested, file) in request.files.iter().zip(files) {
        let progress = &mut |done: u64, _| push.set_progress(read_bytes + done, total_bytes);
        add_file(push, &mut scene, RequestedSource { requested, file }, progress)?;
        read_bytes += file.bytes;
    }
    scene.report.sh_degree = scene.gaussians.sh_degree;
    scene.report.ranges = Ranges::of(&scene.gaussians);
    push.set_report(scene.report.clone());
    if scene.gaussians.is_empty() {
        let reason = "the files hold no Gaussians: there is nothing to push".to_owned();
        return Err(PushError::Content { reason, cells: Vec::new() });
    }
    Ok(scene)
}

/// A file, with its axes and unit from the request.
struct RequestedSource<'a> {
    requested: &'a RequestedFile,
    file: &'a SourceFile,
}

/// Reads one file and appends it to the scene. If its content is refused for its Gaussians, they are
/// in the report.
fn add_file(
    push: &Push,
    scene: &mut PushedScene,
    source: RequestedSource<'_>,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<(), PushError> {
    let RequestedSource { requested, file } = source;
    let name = &file.name;
    let report = &mut scene.report;
    let refused = |error: IngestError| PushError::Content {
        reason: format!("{name}: {error}"),
        cells: Vec::new(),
    };
    let read = match read_scene(&file.path, &requested.axes, progress) {
        Ok(read) => read,
        Err(IngestError::Values(bad)) => {
            report.gaussians += bad.gaussians;
            report.files.push(FileReport {
                name: name.clone(),
                gaussians: bad.gaussians,
                bad: bad.count,
                first_bad: bad.first.clone(),
            });
            push.set_report(report.clone());
            return Err(refused(IngestError::Values(bad)));
        }
        Err(IngestError::File(cause)) => {
            return Err(PushError::Unreadable { name: name.clone(), reason: cause.to_string() });
        }
        Err(error) => return Err(refused(error)),
    };
    let SourceScene { gaussians, hash } = read;
    let count = gaussians.len() as u64;
    report.gaussians += count;
    report.files.push(FileReport {
        name: name.clone(),
        gaussians: count,
        bad: 0,
        first_bad: Vec::new(),
    });
    check_count(name, report.gaussians).inspect_err(|_| push.set_report(report.clone()))?;
    if scene.gaussians.is_empty() {
        // The usual push has one file, which needs no copy.
        scene.gaussians = gaussians;
    } else {
        scene.gaussians.append(&gaussians);
    }
    scene.hashes.push(hash);
    scene.options.extend_from_slice(requested.axes.options());
    Ok(())
}

/// Refuses a push of too many Gaussians; `count` is how many it has with the file `name`.
fn check_count(name: &str, count: u64) -> Result<(), PushError> {
    let most = limits::PUSH_GAUSSIANS;
    if count <= most {
        return Ok(());
    }
    let reason = format!(
        "{name}: the push has {count} Gaussians with this file; at most {most} are accepted: push the \
         scene in parts, some cells each"
    );
    Err(PushError::Content { reason, cells: Vec::new() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_push_has_a_largest_size() {
        assert!(check_count("a.ply", limits::PUSH_GAUSSIANS).is_ok());
        let error = check_count("b.ply", limits::PUSH_GAUSSIANS + 1).unwrap_err();
        assert!(error.is_refusal());
        let text = error.to_string();
        assert!(text.starts_with("b.ply") && text.contains("250000001"), "{text}");
    }
}
