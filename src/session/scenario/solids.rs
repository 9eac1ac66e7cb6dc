//! The solid Gaussians of a twin along a route, for scenarios that end at a contact with the twin.

use std::sync::Arc;

use glam::DVec3;

use wildcity_scene::Gaussians;
use wildcity_scene::geometry::Bounds;
use wildcity_sim::contact::{SOLID_OPACITY, SolidPoint, Solids};
use wildcity_sim::scenario::{ContactRule, FileError, Scenario};
use wildcity_twin::store::{Catalog, Version};

use super::load::ScenarioError;
use crate::error::SessionError;

/// Distance from the route up to which Gaussians are tested, in metres. Farther away there is no contact.
const REACH_M: f64 = 50.0;
/// Distance between the places of the route from which that is measured, in metres.
const SPACING_M: f64 = 10.0;

/// The solid Gaussians that the ego may meet; `None` if the scenario does not end at a contact with the twin. Blocks.
///
/// # Errors
/// The scenario has no route, or the twin cannot be read.
pub(crate) fn solids_of(
    scenario: &Scenario,
    catalog: &Catalog,
    version: &Version,
) -> Result<Option<Arc<Solids>>, SessionError> {
    if scenario.end.contact != Some(ContactRule::Static) {
        return Ok(None);
    }
    let Some(route) = &scenario.route else {
        let message =
            "\"static\" looks at the twin beside the route, and there is none: write route";
        let cause = FileError { path: "end.contact".to_owned(), message: message.to_owned() };
        return Err(ScenarioError::File { file: "scenario".to_owned(), cause }.into());
    };
    let parts = (route.course.length_m() / SPACING_M).ceil() as u32;
    let places_m: Vec<DVec3> =
        (0..=parts).map(|part| route.course.point_m(SPACING_M * f64::from(part))).collect();
    let is_near =
        |bounds: &Bounds| places_m.iter().any(|place_m| bounds.distance_m(*place_m) <= REACH_M);
    let mut points: Vec<SolidPoint> = Vec::new();
    catalog.visit_full_detail(version, &is_near, &mut |gaussians| {
        let all = (0..gaussians.len()).map(|index| point(&gaussians, index));
        points.extend(all.filter(|point| point.opacity >= SOLID_OPACITY));
    })?;
    let drives = &version.manifest.trajectories;
    Ok(Some(Arc::new(Solids::new(points, drives, &scenario.traffic.ego_box))))
}

/// A Gaussian of the twin, activated.
fn point(gaussians: &Gaussians, index: usize) -> SolidPoint {
    let logit = f64::from(gaussians.logit_opacities[index]);
    SolidPoint {
        mean_m: DVec3::from_array(gaussians.means_m[index]),
        sigma_m: DVec3::from_array(gaussians.ln_scales[index].map(|ln| f64::from(ln).exp())),
        opacity: 1.0 / (1.0 + (-logit).exp()),
    }
}
