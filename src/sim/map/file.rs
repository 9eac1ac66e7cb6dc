//! The file `wildcity.map/1`: lanes and areas of a twin, in its world axes and metres.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::limits;
use crate::scenario::FileError;
use crate::scenario::error::{check_format, in_range, json, typed};

/// Lanes and areas.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct MapFile {
    /// `wildcity.map/1`.
    pub format: String,
    /// The lanes.
    #[serde(default)]
    pub lanes: Vec<Lane>,
    /// The areas.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub areas: Vec<Area>,
    /// Stop lines.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub stop_lines: Vec<StopLine>,
}

/// A lane.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Lane {
    /// Id within the map.
    pub id: String,
    /// Its users. If absent, vehicles.
    #[serde(default, skip_serializing_if = "LaneKind::is_driving")]
    pub kind: LaneKind,
    /// The middle, in driving direction.
    pub center: Vec<[f64; 3]>,
    /// The left edge, in driving direction.
    pub left: Vec<[f64; 3]>,
    /// The right edge, in driving direction.
    pub right: Vec<[f64; 3]>,
    /// Lanes that continue it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub next: Vec<String>,
    /// Whether it leads through an intersection.
    #[serde(default, skip_serializing_if = "is_false")]
    pub intersection: bool,
    /// Speed limit, in m/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit_mps: Option<f64>,
}

/// Users of a lane.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum LaneKind {
    /// Vehicles.
    #[default]
    Driving,
    /// Bicycles.
    Bicycle,
    /// Pedestrians.
    Sidewalk,
    /// Parked vehicles.
    Parking,
    /// Anything else: shoulders, borders.
    Other,
}

/// An area.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Area {
    /// Its kind.
    pub kind: AreaKind,
    /// Its outline, without repeating the first point.
    pub outline: Vec<[f64; 3]>,
}

/// Kinds of areas.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum AreaKind {
    /// Vehicles may be there. Lanes for vehicles need no area.
    Drivable,
    /// An intersection.
    Intersection,
    /// A crosswalk.
    Crosswalk,
}

/// A stop line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct StopLine {
    /// Its two ends.
    pub line: [[f64; 3]; 2],
    /// Ids of the traffic lights that it obeys; none at a stop sign.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub lights: Vec<String>,
}

impl LaneKind {
    fn is_driving(&self) -> bool {
        *self == Self::Driving
    }
}

fn is_false(value: &bool) -> bool {
    !value
}

impl MapFile {
    /// The format that this build reads and writes.
    pub const FORMAT: &str = "wildcity.map/1";

    /// A map of these lanes and areas.
    pub fn new(lanes: Vec<Lane>, areas: Vec<Area>) -> Self {
        Self { format: Self::FORMAT.to_owned(), lanes, areas, stop_lines: Vec::new() }
    }

    /// Reads and checks a map.
    ///
    /// # Errors
    /// Names the place of the first mistake.
    pub fn parse(bytes: &[u8]) -> Result<Self, FileError> {
        let file: Self = typed(json(bytes, "map", limits::MAP_BYTES)?, "map")?;
        file.check()?;
        Ok(file)
    }

    /// Checks ids, links, coordinates and the number of points.
    ///
    /// # Errors
    /// Names the place of the first mistake.
    pub fn check(&self) -> Result<(), FileError> {
        check_format(Some(&self.format), Self::FORMAT)?;
        let mut indices: BTreeMap<&str, usize> = BTreeMap::new();
        for (index, lane) in self.lanes.iter().enumerate() {
            let within = |error: FileError| error.within(&format!("lanes[{index}]"));
            if lane.id.is_empty() || lane.id.len() > limits::LANE_ID_BYTES {
                let message = format!("{:?}; 1 to {} bytes", lane.id, limits::LANE_ID_BYTES);
                return Err(within(FileError::new("id", message)));
            }
            if indices.insert(&lane.id, index).is_some() {
                let message = format!("{:?} is there twice; give each lane its own id", lane.id);
                return Err(within(FileError::new("id", message)));
            }
            for (name, line) in
                [("center", &lane.center), ("left", &lane.left), ("right", &lane.right)]
            {
                check_points(name, line, 2).map_err(within)?;
            }
            if let Some(limit_mps) = lane.limit_mps {
                // From slower than walking to faster than any car, in m/s.
                in_range("limit_mps", limit_mps, [0.1, 200.0]).map_err(within)?;
            }
        }
        // A second pass, because a lane may continue in one that the file lists later.
        for (index, lane) in self.lanes.iter().enumerate() {
            for (at, next) in lane.next.iter().enumerate() {
                if !indices.contains_key(next.as_str()) {
                    let path = format!("lanes[{index}].next[{at}]");
                    let message = format!("there is no lane {next:?}; name a lane of this map");
                    return Err(FileError::new(path, message));
                }
            }
        }
        for (index, area) in self.areas.iter().enumerate() {
            let within = |error: FileError| error.within(&format!("areas[{index}]"));
            check_points("outline", &area.outline, 3).map_err(within)?;
        }
        for (index, line) in self.stop_lines.iter().enumerate() {
            let within = |error: FileError| error.within(&format!("stop_lines[{index}]"));
            check_points("line", &line.line, 2).map_err(within)?;
        }
        Ok(())
    }

    /// The map as JSON, one lane or area per line.
    pub fn to_json(&self) -> String {
        // One lane per line keeps differences of two maps readable. `serde_json`'s pretty form
        // would use a line for every number.
        let lines = |items: Vec<String>| items.join(",\n  ");
        // Serializing plain values into memory cannot fail.
        let json = |item: serde_json::Result<String>| item.unwrap_or_default();
        let lanes = self.lanes.iter().map(|lane| json(serde_json::to_string(lane))).collect();
        let areas = self.areas.iter().map(|area| json(serde_json::to_string(area))).collect();
        let stops = self.stop_lines.iter().map(|stop| json(serde_json::to_string(stop))).collect();
        format!(
            "{{\"format\": {:?},\n \"lanes\": [\n  {}],\n \"areas\": [\n  {}],\n \"stop_lines\": [\n  {}]}}\n",
            self.format,
            lines(lanes),
            lines(areas),
            lines(stops),
        )
    }
}

fn check_points(path: &str, points: &[[f64; 3]], least: usize) -> Result<(), FileError> {
    if points.len() < least || points.len() > limits::LINE_POINTS {
        let message =
            format!("{} points; {least} to {} are accepted", points.len(), limits::LINE_POINTS);
        return Err(FileError::new(path, message));
    }
    // The comparison in `in_range` also refuses NaN and infinity, which the geometry cannot use.
    let most_m = wildcity_scene::geometry::Pose::MAX_COORDINATE_M;
    for (index, point) in points.iter().enumerate() {
        for (axis, value) in point.iter().enumerate() {
            in_range(&format!("{path}[{index}][{axis}]"), *value, [-most_m, most_m])?;
        }
    }
    Ok(())
}
