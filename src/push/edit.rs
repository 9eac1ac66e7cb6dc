//! Edits: a new version with the same Gaussians on level ground, with a drive and a rig, which a
//! person has placed with the mouse.

use std::sync::Arc;

use glam::DVec3;

use wildcity_scene::align::{
    Alignment, AlignmentError, GroundPlane, GroundSearch, PathError, SceneExtent, drive_through,
    find_ground, plane_through, scale_from_points, scene_extent,
};
use wildcity_scene::{Gaussians, Rig};
use wildcity_session::Engine;
use wildcity_twin::store::Edit;

use crate::blocking::run_blocking;
use crate::error::PushError;
use crate::limits;
use crate::publish::{Viewpoints, pin_latest, preload};
use crate::queue::PushQueue;
use crate::status::PushedVersion;

/// Request for an edit. Points are in the axes and the unit of the base.
#[derive(Clone, Debug)]
pub struct EditRequest {
    /// Name of the twin.
    pub twin: String,
    /// The version that is edited; the latest if there is none.
    pub base: Option<u64>,
    /// Three points of the ground, and one above it.
    pub ground: Option<([DVec3; 3], DVec3)>,
    /// Two points, and their distance in metres.
    pub scale: Option<([DVec3; 2], f64)>,
    /// A drive through points.
    pub drive: Option<DriveRequest>,
    /// The rig of the new version.
    pub rig: Option<Rig>,
}

/// A drive through points.
#[derive(Clone, Debug)]
pub struct DriveRequest {
    pub name: String,
    pub points: Vec<DVec3>,
    /// Its speed, in m/s.
    pub speed_m_s: f64,
}

impl EditRequest {
    /// The edit of the store.
    ///
    /// # Errors
    /// Names the field that cannot be used, and the requirement.
    pub fn edit(&self) -> Result<Edit, PushError> {
        let Self { ground, scale, drive, rig, .. } = self;
        let is_empty = ground.is_none() && scale.is_none() && drive.is_none() && rig.is_none();
        if is_empty {
            return Err(PushError::InvalidField {
                field: "ground".to_owned(),
                reason: "nothing is edited: give ground, scale, drive or rig".to_owned(),
            });
        }
        let mut alignment = Alignment::IDENTITY;
        // The ground comes first and the scale second: the scale multiplies the aligned axes and
        // leaves the ground at z = 0.
        if let Some((points, above)) = *ground {
            let plane = plane_through(points, above).map_err(alignment_error("ground.points"))?;
            alignment = Alignment::onto(&plane);
        }
        if let Some((points, distance_m)) = *scale {
            let metres = scale_from_points(points, distance_m).map_err(alignment_error("scale"))?;
            alignment = alignment.scaled(metres).map_err(alignment_error("scale"))?;
        }
        // The points are in the axes of the base, and the drive is stored in those of the new
        // version.
        let trajectories = match drive {
            None => Vec::new(),
            Some(DriveRequest { name, points, speed_m_s }) => {
                let points_m: Vec<DVec3> = points.iter().map(|&p| alignment.point_m(p)).collect();
                vec![drive_through(name, &points_m, *speed_m_s).map_err(path_error)?]
            }
        };
        Ok(Edit { alignment, trajectories, rig: rig.clone() })
    }
}

fn alignment_error(field: &'static str) -> impl Fn(AlignmentError) -> PushError {
    move |error| PushError::InvalidField { field: field.to_owned(), reason: error.to_string() }
}

fn path_error(error: PathError) -> PushError {
    let field = match error {
        PathError::Points { .. } | PathError::Length { .. } => "drive.points".to_owned(),
        PathError::Place { index } => format!("drive.points[{index}]"),
        PathError::Speed(_) => "drive.speed".to_owned(),
        PathError::Name(name) => return PushError::InvalidName { field: "drive.name", name },
    };
    PushError::InvalidField { field, reason: error.to_string() }
}

/// Makes the version when no other push of the twin runs. Before it becomes the latest, loads the
/// sections that sessions see.
///
/// # Errors
/// The request cannot be used; [`wildcity_twin::store::StoreError::Overlap`]; or as a commit.
pub async fn publish_edit(
    engine: &Arc<Engine>,
    queue: &PushQueue,
    request: EditRequest,
    viewpoints: Viewpoints<'_>,
) -> Result<PushedVersion, PushError> {
    let edit = request.edit()?;
    let twin = request.twin;
    let catalog = engine.catalog().clone();
    // The base is read before the permit, because the memory to wait for depends on its size.
    let base = {
        let twin = twin.clone();
        run_blocking(move || Ok(catalog.version(&twin, request.base)?)).await?
    };
    // Only an alignment changes Gaussians, and then each of them is read and written again. A drive
    // or a rig changes the manifest only.
    let needed =
        if edit.alignment == Alignment::IDENTITY { 0 } else { base.manifest.stored_bytes() };
    let permit = queue.permit(&twin, needed).await?;
    let (version, held) = {
        let engine = engine.clone();
        let twin = twin.clone();
        run_blocking(move || {
            let _permit = permit;
            // The pin comes before the commit, so that no session opens the new version between the
            // commit and the preload.
            let held = pin_latest(&engine, &twin)?;
            let version = engine.catalog().edit(&base, edit, &mut |_, _| {})?;
            Ok((version, held))
        })
        .await?
    };
    tracing::info!(twin, version = version.number, "edited");
    // From here on nothing fails: the version exists, and a preload is only a help.
    preload(engine, &twin, version.number, viewpoints(&twin)).await;
    drop(held);
    Ok(PushedVersion { number: version.number, hash: version.hash })
}

/// Properties of a version before it is edited.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Survey {
    /// Number of the version.
    pub version: u64,
    /// Where most of the scene is.
    pub extent: SceneExtent,
    /// The ground that [`find_ground`] proposes, if it finds one.
    pub ground: Option<GroundPlane>,
}

/// Looks for the ground of a version: of all its Gaussians, or of [`limits::SURVEYED_GAUSSIANS`] of
/// them.
///
/// # Errors
/// The version cannot be read.
pub async fn survey(
    engine: &Arc<Engine>,
    queue: &PushQueue,
    twin: String,
    version: Option<u64>,
) -> Result<Survey, PushError> {
    // One at a time for each twin, as its pushes.
    let permit = queue.permit(&twin, 0).await?;
    let catalog = engine.catalog().clone();
    run_blocking(move || {
        let _permit = permit;
        let version = catalog.version(&twin, version)?;
        // Every stride-th Gaussian of each section is a sample that is spread over the scene, and
        // the same one at each call. The stride of an empty version would be 0, which `step_by`
        // refuses.
        let stride =
            version.manifest.gaussians().div_ceil(limits::SURVEYED_GAUSSIANS).max(1) as usize;
        let sh_degree = version.manifest.sh_degree;
        let mut some = Gaussians { sh_degree, ..Gaussians::default() };
        catalog.visit_full_detail(&version, &|_| true, &mut |section| {
            some.append(&section.select((0..section.len()).step_by(stride)));
        })?;
        // A scene without a ground is no error: the page then lets a person place it.
        let ground = find_ground(&some, &GroundSearch::default()).ok();
        Ok(Survey { version: version.number, extent: scene_extent(&some), ground })
    })
    .await
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request() -> EditRequest {
        let triangle = [DVec3::ZERO, DVec3::X, DVec3::Y];
        EditRequest {
            twin: "street".to_owned(),
            base: None,
            // The ground is at z = -2, and the point above it at z = -9: up is -z, so the scene
            // stands on its head.
            ground: Some((triangle.map(|p| p - 2.0 * DVec3::Z), DVec3::NEG_Z * 9.0)),
            // Two units are 8 m, so that a unit is 4 m.
            scale: Some(([DVec3::ZERO, 2.0 * DVec3::X], 8.0)),
            drive: Some(DriveRequest {
                name: "path".to_owned(),
                points: vec![DVec3::new(0.0, 0.0, -2.0), DVec3::new(5.0, 0.0, -2.0)],
                speed_m_s: 5.0,
            }),
            rig: None,
        }
    }

    #[test]
    fn the_drive_is_on_the_new_ground_in_metres() {
        let edit = request().edit().unwrap();
        let keyframes = &edit.trajectories[0].keyframes;
        // Five units of 4 m are 20 m, and a point one unit above the ground is at 4 m.
        let last = keyframes[keyframes.len() - 1].world_from_rig.position_m;
        assert!(last.z.abs() < 1e-9 && (last.length() - 20.0).abs() < 1e-9, "{last}");
        assert!((edit.alignment.point_m(DVec3::new(0.0, 0.0, -3.0)).z - 4.0).abs() < 1e-9);
    }

    #[test]
    fn what_cannot_be_used_is_named() {
        let refused = |change: &dyn Fn(&mut EditRequest)| {
            let mut changed = request();
            change(&mut changed);
            changed.edit().unwrap_err().to_string()
        };
        let line = [DVec3::ZERO, DVec3::X, 2.0 * DVec3::X];
        let on_line = refused(&|request| request.ground = Some((line, DVec3::Z)));
        assert!(on_line.starts_with("ground.points: "), "{on_line}");
        let distance = refused(&|request| request.scale = Some(([DVec3::ZERO, DVec3::X], 0.0)));
        assert!(distance.starts_with("scale: "), "{distance}");
        let speed = refused(&|request| request.drive.as_mut().unwrap().speed_m_s = 0.0);
        assert!(speed.starts_with("drive.speed: "), "{speed}");
        let name = refused(&|request| request.drive.as_mut().unwrap().name = "../x".to_owned());
        assert!(name.contains("\"../x\""), "{name}");
        let nothing = refused(&|request| {
            *request = EditRequest {
                ground: None,
                scale: None,
                drive: None,
                rig: None,
                ..request.clone()
            };
        });
        assert!(nothing.contains("nothing is edited"), "{nothing}");
    }
}
