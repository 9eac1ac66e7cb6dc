//! Maps from GeoJSON.
//!
//! Coordinates are metres in the twin's axes, or longitude and latitude (degrees, WGS 84) if an
//! origin is given: then they are converted to east, north and up from this origin. Each feature
//! has the property `layer`:
//!
//! | layer | geometry | properties |
//! |---|---|---|
//! | `lane` | LineString: the middle, in driving direction | `id`, `width_m`; optional `kind`, `next`, `intersection`, `limit_mps` |
//! | `drivable`, `intersection`, `crosswalk` | Polygon | |
//! | `stop_line` | LineString of two points | optional `lights` |
//!
//! and nuPlan's layers of areas: `generic_drivable_areas`, `carpark_areas`, `road_segments`,
//! `intersections`, `crosswalks`; and of lanes: `baseline_paths` (with `lane_fid` or
//! `lane_connector_fid`), `lanes_polygons` and `gen_lane_connectors_scaled_width_polygons` (with
//! `fid`, `left_boundary_fid`, `right_boundary_fid`, connectors with `exit_lane_fid` and
//! `entry_lane_fid`), and `boundaries` (with `fid`). Other layers are refused by name.

use std::collections::BTreeMap;

use glam::{DMat3, DVec3};
use serde_json::{Map, Value};

use wildcity_sim::map::{Area, AreaKind, Lane, LaneKind, MapFile, StopLine};

use crate::{ConvertError, utf8_text};

/// The semi-major axis of WGS 84, in metres, and the square of its eccentricity.
const EQUATOR_M: f64 = 6_378_137.0;
const ECCENTRICITY_2: f64 = 6.694_379_990_141_316e-3;

/// A feature of a file.
struct Feature<'a> {
    index: usize,
    layer: &'a str,
    properties: &'a Map<String, Value>,
    geometry: &'a Value,
    origin: Option<&'a Origin>,
}

/// Origin of the axes east, north and up.
struct Origin {
    at_m: DVec3,
    enu_from_ecef: DMat3,
}

/// Lanes of nuPlan, which are in several features.
#[derive(Default)]
struct NuPlan {
    /// Middles by the lane's or connector's fid.
    paths: BTreeMap<String, Vec<[f64; 3]>>,
    boundaries: BTreeMap<String, Vec<[f64; 3]>>,
    /// Lanes and connectors by fid: left and right boundary, whether it is a connector, following
    /// lane.
    lanes: Vec<NuPlanLane>,
}

struct NuPlanLane {
    feature: usize,
    fid: String,
    left: String,
    right: String,
    connects: Option<[String; 2]>,
}

/// Reads a GeoJSON map; `origin` is the longitude and latitude, in degrees, of the twin's origin,
/// if coordinates are degrees.
///
/// # Errors
/// Names the feature at fault.
pub fn read(bytes: &[u8], origin: Option<[f64; 2]>) -> Result<MapFile, ConvertError> {
    let value: Value = serde_json::from_str(utf8_text(bytes)?)
        .map_err(|error| ConvertError::new("file", format!("not JSON: {error}")))?;
    if value["type"] != "FeatureCollection" {
        let message = "write a FeatureCollection with the property `layer` on every feature";
        return Err(ConvertError::new("type", message));
    }
    let none = Vec::new();
    let features = value["features"].as_array().unwrap_or(&none);
    let origin = origin.map(Origin::at).transpose()?;
    let mut map = MapFile::new(Vec::new(), Vec::new());
    let mut nuplan = NuPlan::default();
    for (index, feature) in features.iter().enumerate() {
        let missing = |field: &str| {
            ConvertError::new(format!("features[{index}]"), format!("has no {field}; write one"))
        };
        let properties = feature["properties"].as_object().ok_or_else(|| missing("properties"))?;
        let layer = properties
            .get("layer")
            .and_then(Value::as_str)
            .ok_or_else(|| missing("properties.layer"))?;
        let geometry = &feature["geometry"];
        let feature = Feature { index, layer, properties, geometry, origin: origin.as_ref() };
        feature.read(&mut map, &mut nuplan)?;
    }
    // After all features, because the parts of a lane may come in any order.
    nuplan.add_to(&mut map)?;
    if map.lanes.is_empty() && map.areas.is_empty() {
        return Err(ConvertError::new("features", "there is no lane and no area"));
    }
    map.check().map_err(|error| ConvertError::new(error.path, error.message))?;
    Ok(map)
}

impl Feature<'_> {
    fn read(&self, map: &mut MapFile, nuplan: &mut NuPlan) -> Result<(), ConvertError> {
        match self.layer {
            "lane" => map.lanes.push(self.lane()?),
            "stop_line" => {
                let line = self.line()?;
                let [from, to] = line[..] else {
                    return Err(self.wrong("geometry", "a stop line has two points"));
                };
                let lights = self.texts("lights")?;
                map.stop_lines.push(StopLine { line: [from, to], lights });
            }
            "drivable" | "generic_drivable_areas" | "carpark_areas" | "road_segments" => {
                self.add_areas(map, AreaKind::Drivable)?;
            }
            "intersection" | "intersections" => self.add_areas(map, AreaKind::Intersection)?,
            "crosswalk" | "crosswalks" => self.add_areas(map, AreaKind::Crosswalk)?,
            "baseline_paths" => {
                let lane = self.id("lane_fid").or_else(|_| self.id("lane_connector_fid"))?;
                nuplan.paths.insert(lane, self.line()?);
            }
            "boundaries" => {
                nuplan.boundaries.insert(self.id("fid")?, self.line()?);
            }
            "lanes_polygons" | "gen_lane_connectors_scaled_width_polygons" => {
                let is_connector = self.layer != "lanes_polygons";
                let connects = if is_connector {
                    Some([self.id("exit_lane_fid")?, self.id("entry_lane_fid")?])
                } else {
                    None
                };
                nuplan.lanes.push(NuPlanLane {
                    feature: self.index,
                    fid: self.id("fid").or_else(|_| self.id("lane_fid"))?,
                    left: self.id("left_boundary_fid")?,
                    right: self.id("right_boundary_fid")?,
                    connects,
                });
            }
            other => {
                let message = format!(
                    "layer {other:?} is not read; remove it, or name it lane, drivable, intersection, crosswalk, \
                     stop_line or one of nuPlan's layers"
                );
                return Err(self.wrong("properties.layer", &message));
            }
        }
        Ok(())
    }

    fn lane(&self) -> Result<Lane, ConvertError> {
        let center = self.line()?;
        let width_m = self.number("width_m")?.ok_or_else(|| {
            self.wrong("properties.width_m", "is missing; write the lane's width in metres")
        })?;
        let is_width = (0.1..=100.0).contains(&width_m);
        if !is_width {
            return Err(self.wrong("properties.width_m", "0.1 to 100 m is accepted"));
        }
        let kind = match self.properties.get("kind").and_then(Value::as_str) {
            None | Some("driving") => LaneKind::Driving,
            Some("bicycle") => LaneKind::Bicycle,
            Some("sidewalk") => LaneKind::Sidewalk,
            Some("parking") => LaneKind::Parking,
            Some("other") => LaneKind::Other,
            Some(_) => {
                let message = "write driving, bicycle, sidewalk, parking or other";
                return Err(self.wrong("properties.kind", message));
            }
        };
        Ok(Lane {
            id: self.id("id")?,
            kind,
            // A positive distance is to the left.
            left: beside(&center, 0.5 * width_m),
            right: beside(&center, -0.5 * width_m),
            center,
            next: self.texts("next")?,
            intersection: self.properties.get("intersection") == Some(&Value::Bool(true)),
            limit_mps: self.number("limit_mps")?,
        })
    }

    fn add_areas(&self, map: &mut MapFile, kind: AreaKind) -> Result<(), ConvertError> {
        let coordinates = &self.geometry["coordinates"];
        let polygons: Vec<&Value> = match self.geometry["type"].as_str() {
            Some("Polygon") => vec![coordinates],
            Some("MultiPolygon") => {
                coordinates.as_array().map_or(Vec::new(), |all| all.iter().collect())
            }
            _ => return Err(self.wrong("geometry.type", "write a Polygon or a MultiPolygon")),
        };
        for rings in polygons {
            let rings = rings.as_array().map_or(&[][..], Vec::as_slice);
            // An area has one outline: a hole would be filled in silence.
            let [outline] = rings else {
                let message = "an area is one ring; split a polygon with holes";
                return Err(self.wrong("geometry.coordinates", message));
            };
            let mut outline = self.points(outline)?;
            // GeoJSON repeats the first point.
            if outline.len() > 1 && outline.first() == outline.last() {
                outline.pop();
            }
            map.areas.push(Area { kind, outline });
        }
        Ok(())
    }

    fn line(&self) -> Result<Vec<[f64; 3]>, ConvertError> {
        let coordinates = &self.geometry["coordinates"];
        match self.geometry["type"].as_str() {
            Some("LineString") => self.points(coordinates),
            // Of several lines, the order in which a lane passes them is unknown.
            Some("MultiLineString") if coordinates.as_array().is_some_and(|all| all.len() == 1) => {
                self.points(&coordinates[0])
            }
            _ => Err(self.wrong("geometry.type", "write a LineString")),
        }
    }

    fn points(&self, value: &Value) -> Result<Vec<[f64; 3]>, ConvertError> {
        let wrong = || self.wrong("geometry.coordinates", "write [x, y] or [x, y, z] of numbers");
        let points = value.as_array().ok_or_else(wrong)?;
        let point = |value: &Value| {
            let axes = value.as_array()?;
            // A missing height is 0.
            let axis = |at: usize| axes.get(at).map_or(Some(0.0), Value::as_f64);
            let point = [axes.first()?.as_f64()?, axes.get(1)?.as_f64()?, axis(2)?];
            Some(self.origin.map_or(point, |origin| origin.to_enu(point)))
        };
        points.iter().map(|value| point(value).ok_or_else(wrong)).collect()
    }

    /// An id: a text or a whole number.
    fn id(&self, field: &str) -> Result<String, ConvertError> {
        let missing =
            || self.wrong(&format!("properties.{field}"), "write a text or a whole number");
        match self.properties.get(field) {
            Some(Value::String(text)) => Ok(text.clone()),
            Some(Value::Number(number)) => Ok(number.to_string()),
            _ => Err(missing()),
        }
    }

    fn number(&self, field: &str) -> Result<Option<f64>, ConvertError> {
        match self.properties.get(field) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => value
                .as_f64()
                .map(Some)
                .ok_or_else(|| self.wrong(&format!("properties.{field}"), "write a number")),
        }
    }

    fn texts(&self, field: &str) -> Result<Vec<String>, ConvertError> {
        let wrong = || self.wrong(&format!("properties.{field}"), "write a list of texts");
        match self.properties.get(field) {
            None | Some(Value::Null) => Ok(Vec::new()),
            Some(Value::Array(items)) => items
                .iter()
                .map(|item| item.as_str().map(str::to_owned).ok_or_else(wrong))
                .collect(),
            Some(_) => Err(wrong()),
        }
    }

    fn wrong(&self, field: &str, message: &str) -> ConvertError {
        ConvertError::new(format!("features[{}].{field}", self.index), message)
    }
}

impl NuPlan {
    fn add_to(self, map: &mut MapFile) -> Result<(), ConvertError> {
        let mut next: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for lane in &self.lanes {
            // A connector follows the lane that it exits from, and leads to the lane that it
            // enters.
            if let Some([exit, entry]) = &lane.connects {
                next.entry(exit.clone()).or_default().push(lane.fid.clone());
                next.entry(lane.fid.clone()).or_default().push(entry.clone());
            }
        }
        let known: Vec<&String> = self.lanes.iter().map(|lane| &lane.fid).collect();
        for lane in &self.lanes {
            let place = format!("features[{}]", lane.feature);
            let missing = |what: &str, fid: &str| {
                ConvertError::new(
                    place.clone(),
                    format!("there is no {what} {fid}; add its feature"),
                )
            };
            let center = self
                .paths
                .get(&lane.fid)
                .ok_or_else(|| missing("baseline path of lane", &lane.fid))?;
            let edge = |fid: &String| {
                let edge = self.boundaries.get(fid).ok_or_else(|| missing("boundary", fid))?;
                Ok::<_, ConvertError>(along(center, edge.clone()))
            };
            let mut followers = next.get(&lane.fid).cloned().unwrap_or_default();
            // A part of a map may name lanes outside of it.
            followers.retain(|fid| known.contains(&fid));
            map.lanes.push(Lane {
                id: lane.fid.clone(),
                kind: LaneKind::Driving,
                left: edge(&lane.left)?,
                right: edge(&lane.right)?,
                center: center.clone(),
                next: followers,
                intersection: lane.connects.is_some(),
                limit_mps: None,
            });
        }
        Ok(())
    }
}

impl Origin {
    fn at([longitude_deg, latitude_deg]: [f64; 2]) -> Result<Self, ConvertError> {
        let is_place =
            (-180.0..=180.0).contains(&longitude_deg) && (-90.0..=90.0).contains(&latitude_deg);
        if !is_place {
            let message = format!(
                "{longitude_deg:?}, {latitude_deg:?}: write longitude and latitude in degrees"
            );
            return Err(ConvertError::new("origin", message));
        }
        let [longitude, latitude] = [longitude_deg, latitude_deg].map(f64::to_radians);
        let (sin_lon, cos_lon) = longitude.sin_cos();
        let (sin_lat, cos_lat) = latitude.sin_cos();
        let east = DVec3::new(-sin_lon, cos_lon, 0.0);
        let north = DVec3::new(-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat);
        let up = DVec3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat);
        Ok(Self {
            at_m: ecef_m([longitude_deg, latitude_deg, 0.0]),
            // The transpose of a rotation is its inverse.
            enu_from_ecef: DMat3::from_cols(east, north, up).transpose(),
        })
    }

    /// East, north and height of a place. The height stays that above the ellipsoid, so that a map
    /// is as level as the earth.
    fn to_enu(&self, place: [f64; 3]) -> [f64; 3] {
        let [longitude, latitude, height_m] = place;
        // The tangent plane is d² / 2 R above the ellipsoid, 8 cm at 1 km. So its own height is not
        // used.
        let enu_m = self.enu_from_ecef * (ecef_m([longitude, latitude, 0.0]) - self.at_m);
        [enu_m.x, enu_m.y, height_m]
    }
}

/// Earth-centred coordinates of longitude and latitude in degrees and height in metres (WGS 84).
fn ecef_m([longitude_deg, latitude_deg, height_m]: [f64; 3]) -> DVec3 {
    let (sin_lon, cos_lon) = longitude_deg.to_radians().sin_cos();
    let (sin_lat, cos_lat) = latitude_deg.to_radians().sin_cos();
    // The radius of curvature across the meridian: N = a / sqrt(1 - e² sin² φ).
    let normal_m = EQUATOR_M / (1.0 - ECCENTRICITY_2 * sin_lat * sin_lat).sqrt();
    DVec3::new(
        (normal_m + height_m) * cos_lat * cos_lon,
        (normal_m + height_m) * cos_lat * sin_lon,
        (normal_m * (1.0 - ECCENTRICITY_2) + height_m) * sin_lat,
    )
}

/// The line `left_m` to the left of another.
fn beside(line: &[[f64; 3]], left_m: f64) -> Vec<[f64; 3]> {
    let point = |at: usize| DVec3::from_array(line[at]);
    let last = line.len().saturating_sub(1);
    let aside = |at: usize| {
        // The direction is that from the point before to the point after; at an end, that of the
        // only neighbour. Where it has no length, the point stays.
        let way = point((at + 1).min(last)) - point(at.saturating_sub(1));
        let left = DVec3::new(-way.y, way.x, 0.0).normalize_or_zero();
        (point(at) + left_m * left).to_array()
    };
    (0..line.len()).map(aside).collect()
}

/// An edge in the direction of its lane.
fn along(center: &[[f64; 3]], mut edge: Vec<[f64; 3]>) -> Vec<[f64; 3]> {
    let ends = |line: &[[f64; 3]]| {
        let end = |point: Option<&[f64; 3]>| point.copied().map_or(DVec3::ZERO, DVec3::from_array);
        [end(line.first()), end(line.last())]
    };
    let [begin, end] = ends(center);
    let [first, last] = ends(&edge);
    // The distances of like ends, against those of crossed ends.
    if first.distance(begin) + last.distance(end) > first.distance(end) + last.distance(begin) {
        edge.reverse();
    }
    edge
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_degree_is_as_long_as_on_the_ellipsoid() {
        let origin = Origin::at([10.0, 48.0]).unwrap();
        // Length of a degree in metres, in series of the latitude φ: 111412.84 cos φ - 93.5 cos 3φ
        // + 0.118 cos 5φ to the east, 111132.92 - 559.82 cos 2φ + 1.175 cos 4φ to the north
        // (American Practical Navigator, table 7).
        let [east_m, _, _] = origin.to_enu([10.001, 48.0, 0.0]);
        // The formulas give 74,625.33 m for a degree to the east at 48° north, and 111,190.3 m to
        // the north.
        assert!((east_m - 74.625_33).abs() < 1e-3, "{east_m}");
        let [_, north_m, up_m] = origin.to_enu([10.0, 48.001, 5.0]);
        assert!((north_m - 111.190_3).abs() < 1e-3, "{north_m}");
        assert_eq!(up_m, 5.0);
        assert!(Origin::at([10.0, 91.0]).is_err());
    }
}
