//! The preview of a push: compares small images of the base and of the version that the push would
//! make.

pub(crate) mod psnr;

use std::collections::BTreeSet;
use std::sync::Arc;

use wildcity_scene::Gaussians;
use wildcity_scene::chunk::cell_at;
use wildcity_twin::store::{StoreError, Version};

use crate::error::PushError;
use crate::limits;
use crate::report::PushReport;
use crate::request::{PushRequest, profile_with};

pub use psnr::PsnrPreview;

use psnr::ProposedChange;

/// The comparison of a preview: the base with the replaced cells. `None` if there is no base, or if
/// it cannot be compared.
///
/// # Errors
/// A comparison was asked for, and the push has too many Gaussians for one; or its profile cannot
/// be used.
pub(crate) fn comparison(
    request: &PushRequest,
    gaussians: &Arc<Gaussians>,
    report: &PushReport,
    base: Option<&Arc<Version>>,
) -> Result<Option<ProposedChange>, PushError> {
    // Both sides are in memory at once at full detail, so the larger one decides.
    let replaced: u64 = report.cells.iter().map(|change| change.before).sum();
    let most = limits::PREVIEW_GAUSSIANS;
    let fits = (gaussians.len() as u64).max(replaced) <= most;
    let is_wanted = request.preview_poses.is_some() || request.min_psnr_db.is_some();
    // A comparison that was asked for must not be left out in silence. Without a wish it is left
    // out.
    if is_wanted && !fits {
        let must = format!(
            "set, for {} Gaussians in place of {replaced}; at most {most} are compared",
            gaussians.len()
        );
        return Err(PushError::OutOfRange { field: "golden".to_owned(), must });
    }
    let Some(base) = base else { return Ok(None) };
    // The scenes of both sides are rendered with one SH degree, which only a push of all cells may
    // change.
    if !fits || base.manifest.sh_degree != gaussians.sh_degree {
        return Ok(None);
    }
    // The profile belongs to the change: a push that sets only the profile changes images, too.
    let cells: BTreeSet<[i32; 2]> = report.cells.iter().map(|change| change.cell).collect();
    let profile = profile_with(base.manifest.profile, &request.profile);
    Ok(Some(ProposedChange {
        before: base.clone(),
        gaussians: within(gaussians, &cells, report.left_out),
        cells,
        profile: profile.map_err(StoreError::from)?,
    }))
}

/// The Gaussians within some cells; no copy is made if none is left out.
fn within(gaussians: &Arc<Gaussians>, cells: &BTreeSet<[i32; 2]>, left_out: u64) -> Arc<Gaussians> {
    if left_out == 0 {
        return gaussians.clone();
    }
    // What lies in other cells is not committed, so that it must not be drawn either.
    let is_within = |&index: &usize| cells.contains(&cell_at(&gaussians.means_m[index]));
    Arc::new(gaussians.select((0..gaussians.len()).filter(is_within)))
}

/// Refuses a push that differs by more than the request allows, or that cannot be compared although
/// the request demands it.
pub(crate) fn check_psnr(
    request: &PushRequest,
    gaussians: &Gaussians,
    report: &PushReport,
    base: Option<&Version>,
) -> Result<(), PushError> {
    let Some(min_db) = request.min_psnr_db else { return Ok(()) };
    // No image is no proof: the push is refused and not let through.
    if report.preview.is_empty() {
        let why = reason_for_no_preview(request, gaussians, base);
        let must = format!("{min_db}, but nothing can be compared: {why}");
        return Err(PushError::OutOfRange { field: "golden.min_psnr_db".to_owned(), must });
    }
    // Equal images have an infinite PSNR, which passes every bound.
    let worst = report.preview.iter().find(|pose| pose.psnr_db < min_db);
    if let Some(PsnrPreview { world_from_rig, psnr_db }) = worst {
        let [x, y, z] = world_from_rig.position_m.to_array();
        let reason = format!(
            "the view from ({x:.1}, {y:.1}, {z:.1}) differs from that of the version before: {psnr_db:.1} dB, \
             min_psnr_db is {min_db}"
        );
        return Err(PushError::Content { reason, cells: Vec::new() });
    }
    Ok(())
}

fn reason_for_no_preview(
    request: &PushRequest,
    gaussians: &Gaussians,
    base: Option<&Version>,
) -> String {
    // From the most general reason to the most special one; the first that holds is the remedy.
    let Some(Version { manifest, .. }) = base else {
        return "there is no version before it: leave it out".to_owned();
    };
    if manifest.sh_degree != gaussians.sh_degree {
        return format!(
            "the SH degree is {}, and {} in the version before: leave it out",
            gaussians.sh_degree, manifest.sh_degree
        );
    }
    match &request.preview_poses {
        None if manifest.trajectories.is_empty() => {
            "the twin has no recorded drive: give it one (`wildcity twin drive`), or name golden.poses".to_owned()
        }
        Some(poses) if poses.is_empty() => "golden.poses names none".to_owned(),
        _ => "no Gaussian is seen from these poses, or a camera of the twin's rig cannot be drawn smaller: name other \
              golden.poses, or leave it out"
            .to_owned(),
    }
}
