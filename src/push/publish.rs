//! The pipeline of a push: read, check, preview, commit, preload.
//!
//! A push is uploaded files and the cells that they replace. All cells are published by one record
//! of the twin's log.
//!
//! **Agents never wait for a push.** Small views before and after the change are rendered through
//! the render queue of the sessions. Until the new version is loaded, `latest` remains the previous
//! version for sessions that open the twin ([`Engine::pin_latest`]).
//!
//! **A push needs no state that survives the server**, because its content is compared with the
//! twin's. A client that got no answer sends its push again, and a push with the content of the
//! latest version makes no new version.

use std::collections::BTreeMap;
use std::sync::Arc;

use tokio::time::{Instant, timeout, timeout_at};

use wildcity_scene::align::Alignment;
use wildcity_scene::chunk::cell_at;
use wildcity_scene::{Gaussians, RenderProfile};
use wildcity_session::{Engine, LatestPin};
use wildcity_twin::residency::Viewpoint;
use wildcity_twin::store::{StoreError, Version, check_density};

use crate::base::{default_axes, find_base};
use crate::blocking::run_blocking;
use crate::commit::{NewContent, commit, merge_profile};
use crate::error::PushError;
use crate::preview::psnr::preview_psnr;
use crate::preview::{check_psnr, comparison};
use crate::queue::{PushPermit, PushQueue};
use crate::read::{PushedScene, ReadBounds, read};
use crate::report::{CellChanges, PushReport};
use crate::request::{CellSelection, PushRequest};
use crate::source::SourceFile;
use crate::status::{Push, PushedVersion, State};

/// For a twin, the viewpoints of the next frame of each session that drives on it now.
pub type Viewpoints<'a> = &'a (dyn Fn(&str) -> Vec<Vec<Viewpoint>> + Send + Sync);

/// A scene that was checked against the base.
struct CheckedScene {
    gaussians: Arc<Gaussians>,
    hashes: Vec<String>,
    options: Vec<String>,
    /// The render profile of the version.
    profile: RenderProfile,
    report: PushReport,
}

/// Waits for the push's permit, carries it out, and returns the version that it made. Dropping the
/// future abandons the push: before the commit nothing of it is visible. The caller ends the push
/// with [`Push::end`].
///
/// # Errors
/// The content is refused, or the server could not do it; see [`PushError::is_refusal`].
pub async fn publish(
    engine: &Arc<Engine>,
    queue: &PushQueue,
    push: &Arc<Push>,
    request: PushRequest,
    files: Vec<SourceFile>,
    viewpoints: Viewpoints<'_>,
) -> Result<PushedVersion, PushError> {
    let file_bytes = files.iter().map(|file| file.bytes).sum();
    let permit = queue.permit(&request.twin, file_bytes).await?;
    let request = Arc::new(request);

    // The limit begins with the permit, so that a push that waits for others is not punished.
    let limit = queue.check_timeout();
    let deadline = Instant::now() + limit;
    // The frames have a later deadline than the push, so that a push that takes too long fails with
    // `TimedOut` and not with the error of a frame.
    let frames_by = deadline + engine.step_timeout();
    let checked = read_and_check(engine, push, &request, files, &permit, frames_by);
    let Ok(checked) = timeout_at(deadline, checked).await else {
        // Dropping the future does not end its blocking thread; the flag does.
        push.stop_flag().stop();
        return Err(PushError::TimedOut { limit });
    };
    // A cancellation ends the reading with an error, too, and is the reason to report.
    let (scene, base) = checked.map_err(|error| push.cause(error))?;

    // From here on, the push cannot be cancelled.
    push.enter(State::Committing)?;
    let committed = {
        let engine = engine.clone();
        let push = push.clone();
        let request = request.clone();
        let permit = permit.clone();
        run_blocking(move || {
            let _permit = permit;
            commit_held(&engine, &push, &request, &scene, base.as_deref())
        })
        .await?
    };
    let Committed { version, held } = committed;
    // The version exists. What follows cannot fail, so the push ends with success.
    tracing::info!(twin = request.twin, version = version.number, "pushed");

    push.enter(State::Prefetching)?;
    preload(engine, &request.twin, version.number, viewpoints(&request.twin)).await;
    drop(held);
    Ok(PushedVersion { number: version.number, hash: version.hash })
}

/// Everything before the commit. `frames_by` is the deadline of the preview's frames.
///
/// Blocking threads hold a clone of the permit, because they may still run for a moment after the
/// push was cancelled: the next push of the twin must not begin before they end.
async fn read_and_check(
    engine: &Arc<Engine>,
    push: &Arc<Push>,
    request: &Arc<PushRequest>,
    files: Vec<SourceFile>,
    permit: &PushPermit,
    frames_by: Instant,
) -> Result<(CheckedScene, Option<Arc<Version>>), PushError> {
    push.enter(State::Ingesting)?;
    let scene = {
        let push = push.clone();
        let engine = engine.clone();
        let request = request.clone();
        let permit = permit.clone();
        let bounds = ReadBounds::for_twin(permit.memory_bytes(), request.drop_bad);
        run_blocking(move || {
            let _permit = permit;
            let default_axes = default_axes(engine.catalog(), &request)?;
            read(&push, &request.files, &files, &default_axes, bounds)
        })
        .await?
    };

    // The base is looked up again after minutes of reading, so that changes of others count.
    push.enter(State::Validating)?;
    let base = {
        let engine = engine.clone();
        let request = request.clone();
        run_blocking(move || find_base(engine.catalog(), &request)).await?.map(Arc::new)
    };
    let scene = check(engine, push, request, scene, base.clone(), frames_by).await?;
    Ok((scene, base))
}

/// Determines which cells would change, and compares images before and after.
async fn check(
    engine: &Arc<Engine>,
    push: &Arc<Push>,
    request: &Arc<PushRequest>,
    scene: PushedScene,
    base: Option<Arc<Version>>,
    frames_by: Instant,
) -> Result<CheckedScene, PushError> {
    // Counting the cells of 250 million Gaussians takes seconds, which an async thread must not.
    let (mut scene, changed) = {
        let push = push.clone();
        let request = request.clone();
        let base = base.clone();
        run_blocking(move || {
            let scene = compare_cells(&push, &request, scene, base.as_deref())?;
            let changed = comparison(&request, &scene.gaussians, &scene.report, base.as_ref())?;
            Ok((scene, changed))
        })
        .await?
    };
    if let Some(changed) = changed {
        let progress = |done, total| push.set_progress(done, total);
        // The poses are in the frame of the files, and the images in that of the twin.
        let alignment = request.frame.alignment(base.as_deref())?.unwrap_or(Alignment::IDENTITY);
        let poses = request
            .preview_poses
            .as_ref()
            .map(|poses| poses.iter().map(|pose| alignment.pose(pose)).collect());
        scene.report.preview = preview_psnr(engine, changed, poses, frames_by, &progress).await?;
        push.set_report(scene.report.clone());
    }
    // The report is set before this check, so that a refused push shows its PSNR, too.
    check_psnr(request, &scene.gaussians, &scene.report, base.as_deref())?;
    Ok(scene)
}

/// Takes the scene to the twin's frame, finds the cells that the push replaces, and completes the
/// report with both.
fn compare_cells(
    push: &Push,
    request: &PushRequest,
    mut scene: PushedScene,
    base: Option<&Version>,
) -> Result<CheckedScene, PushError> {
    // From here on all coordinates are those of the twin, and cells mean its cells. Each refusal
    // below sets the report first: it tells the user what was refused.
    let placed = scene.place_in_twin(request.frame, base);
    placed.inspect_err(|_| push.set_report(scene.report.clone()))?;
    let PushedScene { mut gaussians, hashes, options, antialiasing, mut report } = scene;
    let (profile, warning) = merge_profile(request, base, antialiasing.as_ref())?;
    if let (Some(warning), Some(file)) = (warning, report.files.first_mut()) {
        file.warnings.push(warning);
    }
    // All cells of a twin have one SH degree. Coefficients of zero raise a lower one.
    if let Some(base) = base
        && request.cells != CellSelection::All
    {
        gaussians.raise_sh_degree(base.manifest.sh_degree);
    }
    // One pass, O(n log c) for n Gaussians in c cells; a push of a street has about a hundred.
    let mut counts = BTreeMap::new();
    for mean_m in &gaussians.means_m {
        *counts.entry(cell_at(mean_m)).or_insert(0) += 1;
    }
    check_density(counts.len(), gaussians.len() as u64)
        .inspect_err(|_| push.set_report(report.clone()))?;
    let changes = CellChanges::new(&request.cells, base.map(|base| &base.manifest), &counts)
        .inspect_err(|_| push.set_report(report.clone()))?;
    report.cells = changes.cells;
    report.left_out = changes.left_out;
    push.set_report(report.clone());
    Ok(CheckedScene { gaussians: Arc::new(gaussians), hashes, options, profile, report })
}

/// A committed version that is not yet opened as the latest.
struct Committed {
    version: Version,
    /// Pins the previous version as the latest until it is dropped.
    held: Option<LatestPin>,
}

fn commit_held(
    engine: &Arc<Engine>,
    push: &Push,
    request: &PushRequest,
    scene: &CheckedScene,
    base: Option<&Version>,
) -> Result<Committed, PushError> {
    // Until the new version is ready, sessions that open the latest version get the present latest
    // version. It may be later than the base, because another version may have been committed
    // during the preview.
    let held = pin_latest(engine, &request.twin)?;
    let content = NewContent {
        gaussians: &scene.gaussians,
        hashes: &scene.hashes,
        options: &scene.options,
        profile: scene.profile,
    };
    let version = commit(engine.catalog(), push, request, content, base)?;
    Ok(Committed { version, held })
}

/// Pins the version that is the latest now; `None` if the twin is new.
pub(crate) fn pin_latest(engine: &Arc<Engine>, twin: &str) -> Result<Option<LatestPin>, PushError> {
    let versions = match engine.catalog().versions(twin) {
        Ok(versions) => versions,
        // No session can open a twin that does not exist, so there is nothing to hold back.
        Err(StoreError::NoTwin { .. }) => return Ok(None),
        Err(error) => return Err(error.into()),
    };
    Ok(versions.last().map(|latest| engine.pin_latest(twin, latest.number)))
}

/// Loads those parts of the version that sessions on the twin see now, so that they need not wait
/// when they switch. The version is already committed: sections that cannot be loaded now are
/// loaded when it is opened.
pub(crate) async fn preload(
    engine: &Arc<Engine>,
    twin: &str,
    version: u64,
    frames: Vec<Vec<Viewpoint>>,
) {
    let prepared = engine.preload(twin, version, frames);
    match timeout(wildcity_session::limits::PRELOAD_TIMEOUT, prepared).await {
        Ok(Ok(())) => {}
        // Neither case fails the push: sessions then load the sections when they need them.
        Ok(Err(error)) => tracing::warn!(twin, "not loaded ahead: {error}"),
        Err(_) => tracing::warn!(twin, "not loaded ahead in time"),
    }
}
