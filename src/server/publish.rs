//! What a push does: read its files, look at them, write a version, and make it ready.
//!
//! Nobody sees anything of it before the version is written whole.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use tokio::time::timeout;

use crate::limits;
use wildcity_scene::chunk::cell_at;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Gaussians, RenderProfile};
use wildcity_session::{Engine, LatestPin, ProposedChange};
use wildcity_twin::ingest::{self, IngestError};
use wildcity_twin::store::{
    Catalog, CommitKind, NewSky, StorageOptions, StoreError, Version, VersionChange,
    VersionSettings,
};

use super::Server;
use super::fault::Fault;
use super::push::{Ask, AskedCells, Push};
use super::report::{FileReport, Ranges, Report, State, cells};
use super::spool::Upload;
use super::uploads::blocking;

/// Carries out a push in its turn, and ends it.
pub(super) async fn run(server: Arc<Server>, push: Arc<Push>, ask: Ask, uploads: Vec<Arc<Upload>>) {
    let done = async {
        let turn = server.pushes.turn.acquire().await;
        let _turn = turn.map_err(|_| Fault::ShuttingDown)?;
        publish(&server, &push, Arc::new(ask), uploads).await
    };
    let ended = tokio::select! {
        done = done => done,
        () = server.stopped() => Err(Fault::ShuttingDown),
    };
    let ended = ended.map_err(|fault| {
        let state = if fault.is_content() { State::Refused } else { State::Failed };
        tracing::warn!(?state, "a push ended: {fault}");
        (state, fault)
    });
    let outcome = match &ended {
        Ok(_) => "ready",
        Err((State::Refused, _)) => "refused",
        Err(_) => "failed",
    };
    server.metrics.pushed(outcome);
    push.end(ended);
}

/// What the files hold, as one.
struct Scene {
    gaussians: Arc<Gaussians>,
    /// BLAKE3 of each source, and how it was read.
    sources: Vec<String>,
    options: Vec<String>,
    report: Report,
}

async fn publish(
    server: &Arc<Server>,
    push: &Arc<Push>,
    ask: Arc<Ask>,
    uploads: Vec<Arc<Upload>>,
) -> Result<(u64, String), Fault> {
    push.enter(State::Ingesting);
    let (told, asked) = (push.clone(), ask.clone());
    let scene = blocking(move || read(&told, &asked, &uploads)).await?;

    push.enter(State::Validating);
    let (catalog, asked) = (server.engine.catalog().clone(), ask.clone());
    let base = blocking(move || find_base(&catalog, &asked)).await?.map(Arc::new);
    let scene = validate(server, push, &ask, scene, base.clone()).await?;

    push.enter(State::Committing);
    let (engine, told, asked) = (server.engine.clone(), push.clone(), ask.clone());
    let (held, version) = blocking(move || {
        // Until it is ready, who opens the latest gets what is the latest now: comparing took its time.
        let held = pin_latest(&engine, &asked.twin)?;
        let version = commit(engine.catalog(), &told, &asked, &scene, base.as_deref())?;
        Ok((held, version))
    })
    .await?;
    tracing::info!(twin = ask.twin, version = version.number, "pushed");

    push.enter(State::Prefetching);
    // Where sessions drive on that twin now, whoever switches need not wait.
    let driving = server.sessions.list().into_iter().filter(|(_, about, _)| about.twin == ask.twin);
    let frames = driving.map(|(_, about, _)| about.eyes).collect();
    let prepared = server.engine.preload(&ask.twin, version.number, frames);
    match timeout(wildcity_session::limits::PRELOAD_TIMEOUT, prepared).await {
        Ok(Ok(())) => {}
        // It is committed and sound: whoever opens it waits, or is told why it does not fit.
        Ok(Err(error)) => tracing::warn!(twin = ask.twin, "not loaded ahead: {error}"),
        Err(_) => tracing::warn!(twin = ask.twin, "not loaded ahead in time"),
    }
    drop(held);
    Ok((version.number, version.hash))
}

/// Reads the files, turns them into the twin's axes, and joins them.
fn read(push: &Push, ask: &Ask, uploads: &[Arc<Upload>]) -> Result<Scene, Fault> {
    let total: u64 = uploads.iter().map(|upload| upload.announced().size).sum();
    let (mut report, mut joined) = (Report::default(), Gaussians::default());
    let (mut sources, mut options) = (Vec::new(), Vec::new());
    let mut before = 0;
    for (file, upload) in ask.files.iter().zip(uploads) {
        let name = upload.announced().name.clone();
        let progress = &mut |done: u64, _| push.progress(before + done, total);
        let refused = |error: IngestError| Fault::Content {
            reason: format!("{name}: {error}"),
            cells: Vec::new(),
        };
        let (mut gaussians, hash) = match ingest::read_hashed(&upload.path(), progress) {
            Ok(read) => read,
            Err(IngestError::Values(bad)) => {
                report.gaussians += bad.gaussians;
                report.files.push(FileReport {
                    name: name.clone(),
                    gaussians: bad.gaussians,
                    bad: bad.count,
                    first_bad: bad.first.clone(),
                });
                push.tell(report);
                return Err(refused(IngestError::Values(bad)));
            }
            Err(IngestError::File(cause)) => {
                return Err(Fault::Internal(format!("{name}: {cause}")));
            }
            Err(error) => return Err(refused(error)),
        };
        let (count, first_bad) = (gaussians.len() as u64, Vec::new());
        report.files.push(FileReport { name: name.clone(), gaussians: count, bad: 0, first_bad });
        report.gaussians += count;
        fits(&name, report.gaussians).inspect_err(|_| push.tell(report.clone()))?;
        file.axes.apply(&mut gaussians);
        joined = join(joined, gaussians);
        sources.push(hash);
        options.extend(file.options.clone());
        before += upload.announced().size;
    }
    report.sh_degree = joined.sh_degree;
    report.ranges = Ranges::of(&joined);
    push.tell(report.clone());
    if joined.is_empty() {
        let reason = "the files hold no Gaussians: nothing to push".to_owned();
        return Err(Fault::Content { reason, cells: Vec::new() });
    }
    Ok(Scene { gaussians: Arc::new(joined), sources, options, report })
}

/// Whether a push may have so many Gaussians, counted up to one of its files.
fn fits(name: &str, count: u64) -> Result<(), Fault> {
    let most = limits::PUSH_GAUSSIANS;
    if count <= most {
        return Ok(());
    }
    let reason = format!(
        "{name}: the push has {count} Gaussians with this file; at most {most} fit one: push the \
         scene in parts, some cells each"
    );
    Err(Fault::Content { reason, cells: Vec::new() })
}

/// One scene after the other; the lower SH degree gets zeros.
fn join(mut first: Gaussians, mut second: Gaussians) -> Gaussians {
    if first.is_empty() {
        return second;
    }
    let degree = first.sh_degree.max(second.sh_degree);
    first.raise_sh_degree(degree);
    second.raise_sh_degree(degree);
    first.means_m.append(&mut second.means_m);
    first.quats_wxyz.append(&mut second.quats_wxyz);
    first.ln_scales.append(&mut second.ln_scales);
    first.logit_opacities.append(&mut second.logit_opacities);
    first.sh.append(&mut second.sh);
    first
}

/// The version that a push is made from; none if it makes a new twin.
fn find_base(catalog: &Catalog, ask: &Ask) -> Result<Option<Version>, Fault> {
    match catalog.version(&ask.twin, ask.base) {
        Ok(version) => Ok(Some(version)),
        Err(StoreError::NoTwin { .. }) if ask.base.is_none() => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Keeps what is the latest version; none if the twin is new.
fn pin_latest(engine: &Arc<Engine>, twin: &str) -> Result<Option<LatestPin>, Fault> {
    let versions = match engine.catalog().versions(twin) {
        Ok(versions) => versions,
        Err(StoreError::NoTwin { .. }) => return Ok(None),
        Err(error) => return Err(error.into()),
    };
    Ok(versions.last().map(|latest| engine.pin_latest(twin, latest.number)))
}

/// Looks at what would change, and at how it looks.
async fn validate(
    server: &Arc<Server>,
    push: &Arc<Push>,
    ask: &Arc<Ask>,
    scene: Scene,
    base: Option<Arc<Version>>,
) -> Result<Scene, Fault> {
    let (told, asked, before) = (push.clone(), ask.clone(), base.clone());
    let (mut scene, changed) =
        blocking(move || changes(&told, &asked, scene, before.as_ref())).await?;
    if let Some(changed) = changed {
        let progress = |done, total| push.progress(done, total);
        scene.report.golden =
            server.engine.preview_psnr(changed, ask.poses.clone(), &progress).await?;
        push.tell(scene.report.clone());
    }
    looks_alike(ask, &scene, base.as_deref())?;
    Ok(scene)
}

/// What would change of the base; and what there is to compare, if it can be compared.
fn changes(
    push: &Push,
    ask: &Ask,
    scene: Scene,
    base: Option<&Arc<Version>>,
) -> Result<(Scene, Option<ProposedChange>), Fault> {
    let Scene { mut gaussians, sources, options, mut report } = scene;
    // What is stored of a twin has one SH degree; a lower one gets zeros.
    if let Some(base) = base
        && base.manifest.sh_degree > gaussians.sh_degree
        && ask.cells != AskedCells::All
    {
        Arc::make_mut(&mut gaussians).raise_sh_degree(base.manifest.sh_degree);
    }
    let mut after = BTreeMap::new();
    for mean_m in &gaussians.means_m {
        *after.entry(cell_at(mean_m)).or_insert(0) += 1;
    }
    let found = cells(&ask.cells, base.map(|base| &base.manifest), &after);
    let (replaced, left_out) = found.inspect_err(|_| push.tell(report.clone()))?;
    (report.cells, report.left_out) = (replaced, left_out);
    push.tell(report.clone());

    let fits = gaussians.len() <= limits::GOLDEN_GAUSSIANS;
    let wants = ask.poses.is_some() || ask.min_psnr_db.is_some();
    if wants && !fits {
        let most = limits::GOLDEN_GAUSSIANS;
        let must = format!("set, for {} Gaussians; at most {most} are compared", gaussians.len());
        return Err(Fault::OutOfRange { field: "golden".to_owned(), must });
    }
    let base = base.filter(|base| fits && base.manifest.sh_degree == gaussians.sh_degree);
    let changed = match base {
        Some(base) => {
            let changed: BTreeSet<_> = report.cells.iter().map(|change| change.cell).collect();
            Some(ProposedChange {
                before: base.clone(),
                gaussians: inside(&gaussians, &changed, left_out),
                cells: changed,
                profile: profile(ask, base.manifest.profile)?,
            })
        }
        None => None,
    };
    Ok((Scene { gaussians, sources, options, report }, changed))
}

/// Refuses what differs by more than was asked for, and what cannot be compared although it was.
fn looks_alike(ask: &Ask, scene: &Scene, base: Option<&Version>) -> Result<(), Fault> {
    let Some(least_db) = ask.min_psnr_db else { return Ok(()) };
    let golden = &scene.report.golden;
    if golden.is_empty() {
        let why = match base {
            None => "there is no version before it: leave it out".to_owned(),
            Some(Version { manifest, .. }) if manifest.sh_degree != scene.gaussians.sh_degree => {
                format!(
                    "the SH degree is {}, and {} in the version before: leave it out",
                    scene.gaussians.sh_degree, manifest.sh_degree
                )
            }
            Some(Version { manifest, .. })
                if ask.poses.is_none() && manifest.trajectories.is_empty() =>
            {
                "the twin has no trajectory: name golden.poses".to_owned()
            }
            Some(_) if ask.poses.as_ref().is_some_and(Vec::is_empty) => {
                "golden.poses names none".to_owned()
            }
            Some(_) => {
                "a camera of the twin's rig cannot be drawn smaller: leave it out".to_owned()
            }
        };
        let must = format!("{least_db}, but nothing can be compared: {why}");
        return Err(Fault::OutOfRange { field: "golden.min_psnr_db".to_owned(), must });
    }
    let worst = golden.iter().enumerate().find(|(_, golden)| golden.psnr_db < least_db);
    if let Some((index, golden)) = worst {
        let [x, y, z] = golden.world_from_rig.position_m.to_array();
        let reason = format!(
            "pose {index} at ({x:.1}, {y:.1}, {z:.1}) differs from what was there: {:.1} dB, \
             min_psnr_db is {least_db}",
            golden.psnr_db
        );
        return Err(Fault::Content { reason, cells: Vec::new() });
    }
    Ok(())
}

/// The Gaussians within some cells.
fn inside(gaussians: &Arc<Gaussians>, cells: &BTreeSet<[i32; 2]>, left_out: u64) -> Arc<Gaussians> {
    if left_out == 0 {
        return gaussians.clone();
    }
    let mut kept = Gaussians::with_capacity(gaussians.sh_degree, gaussians.len());
    for (index, mean_m) in gaussians.means_m.iter().enumerate() {
        if cells.contains(&cell_at(mean_m)) {
            kept.means_m.push(*mean_m);
            kept.quats_wxyz.push(gaussians.quats_wxyz[index]);
            kept.ln_scales.push(gaussians.ln_scales[index]);
            kept.logit_opacities.push(gaussians.logit_opacities[index]);
            kept.sh.extend(gaussians.sh_of(index));
        }
    }
    Arc::new(kept)
}

fn profile(ask: &Ask, mut profile: RenderProfile) -> Result<RenderProfile, Fault> {
    for setting in &ask.profile {
        profile.set(setting).map_err(StoreError::from)?;
    }
    Ok(profile)
}

/// Writes the version: all of its cells, or none.
fn commit(
    catalog: &Catalog,
    push: &Push,
    ask: &Ask,
    scene: &Scene,
    base: Option<&Version>,
) -> Result<Version, Fault> {
    let was = base.map(|base| &base.manifest);
    let record = ask.record.or(was.map(|was| was.record)).unwrap_or_default();
    let storage = StorageOptions { record, levels: ask.levels };
    let mut commit = catalog.begin(&ask.twin, CommitKind::Push, storage)?;
    let only = match &ask.cells {
        AskedCells::These(cells) => Some(cells),
        AskedCells::Touched | AskedCells::All => None,
    };
    commit.put(&scene.gaussians, only, &mut |done, total| push.progress(done, total))?;
    let provenance = provenance(ask, scene);
    let new_profile = profile(ask, was.map(|was| was.profile).unwrap_or_default())?;
    Ok(match base {
        Some(base) if ask.cells != AskedCells::All => {
            let profile = (!ask.profile.is_empty()).then_some(new_profile);
            let change =
                VersionChange { profile, rig: None, trajectories: None, sky: None, provenance };
            commit.change(base.number, change)?
        }
        _ => {
            let settings = VersionSettings {
                profile: new_profile,
                rig: was.and_then(|was| was.rig.clone()),
                trajectories: was.map(|was| was.trajectories.clone()).unwrap_or_default(),
                sky: was.and_then(|was| was.sky.clone()).map(NewSky::Kept),
                provenance,
            };
            commit.replace(ask.base, settings)?
        }
    })
}

/// No clock in it, nor who pushed: the same content is the same version.
fn provenance(ask: &Ask, scene: &Scene) -> Provenance {
    let source = match &scene.sources[..] {
        [one] => one.clone(),
        several => blake3::hash(several.join("\n").as_bytes()).to_hex().to_string(),
    };
    let mut options = scene.options.clone();
    options.extend((!ask.levels).then(|| "lod=off".to_owned()));
    options.extend(ask.note.as_ref().map(|note| format!("note={note}")));
    Provenance { options, ..Provenance::of(format!("blake3:{source}")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_push_has_a_largest_size() {
        assert!(fits("a.ply", limits::PUSH_GAUSSIANS).is_ok());
        let error = fits("b.ply", limits::PUSH_GAUSSIANS + 1).unwrap_err();
        assert!(error.is_content());
        let text = error.to_string();
        assert!(text.starts_with("b.ply") && text.contains("250000001"), "{text}");
    }
}
