//! Positions: in the world, or relative to an entity.

use std::collections::BTreeMap;

use super::Entity;
use super::element::Element;
use crate::ConvertError;

/// A place with a heading.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Place {
    /// Position, in metres.
    pub(super) xyz_m: [f64; 3],
    /// Heading, in radians.
    pub(super) yaw_rad: f64,
}

impl Place {
    /// The place straight ahead.
    pub(super) fn ahead(&self, way_m: f64) -> Self {
        let (sin, cos) = self.yaw_rad.sin_cos();
        let [x, y, z] = self.xyz_m;
        Self { xyz_m: [x + way_m * cos, y + way_m * sin, z], ..*self }
    }
}

/// The place of a `<Position>`.
pub(super) fn place_of(
    position: Element<'_>,
    entities: &BTreeMap<String, Entity>,
) -> Result<Place, ConvertError> {
    let kind = position.only_child()?;
    let of_entity = |kind: &Element<'_>| -> Result<Place, ConvertError> {
        let name = kind.text("entityRef")?;
        let place = entities.get(&name).and_then(|entity| entity.place);
        place.ok_or_else(|| {
            kind.wrong(&format!("{name:?} has no position before this one; place it first"))
        })
    };
    let offset = |kind: &Element<'_>, axis: &str| Ok(kind.find_number(axis)?.unwrap_or(0.0));
    match kind.name() {
        "WorldPosition" => {
            kind.only(&[])?;
            // Pitch and roll are those of the ground.
            Ok(Place {
                xyz_m: [kind.number("x")?, kind.number("y")?, offset(&kind, "z")?],
                yaw_rad: offset(&kind, "h")?,
            })
        }
        "RelativeWorldPosition" => {
            let base = of_entity(&kind)?;
            let [x, y, z] = base.xyz_m;
            let xyz_m =
                [x + offset(&kind, "dx")?, y + offset(&kind, "dy")?, z + offset(&kind, "dz")?];
            Ok(Place { xyz_m, yaw_rad: heading_rad(&kind, base.yaw_rad)? })
        }
        "RelativeObjectPosition" => {
            let base = of_entity(&kind)?;
            let (sin, cos) = base.yaw_rad.sin_cos();
            let [dx, dy] = [offset(&kind, "dx")?, offset(&kind, "dy")?];
            let [x, y, z] = base.xyz_m;
            let xyz_m =
                [x + cos * dx - sin * dy, y + sin * dx + cos * dy, z + offset(&kind, "dz")?];
            Ok(Place { xyz_m, yaw_rad: heading_rad(&kind, base.yaw_rad)? })
        }
        _ => Err(kind.unread()),
    }
}

/// The heading of an `<Orientation>`: absolute, or relative to an entity, whose heading is returned without an
/// `<Orientation>`.
fn heading_rad(kind: &Element<'_>, base_rad: f64) -> Result<f64, ConvertError> {
    kind.only(&["Orientation"])?;
    let Some(orientation) = kind.find("Orientation")? else { return Ok(base_rad) };
    let heading_rad = orientation.find_number("h")?.unwrap_or(0.0);
    match orientation.find_text("type")?.as_deref() {
        None | Some("relative") => Ok(base_rad + heading_rad),
        Some("absolute") => Ok(heading_rad),
        Some(other) => Err(orientation.wrong(&format!("type={other:?}; relative or absolute"))),
    }
}
