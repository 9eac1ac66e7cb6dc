//! The frame of an OpenDRIVE file: its numbers, its place on the earth, and its coordinates near
//! the origin.

use roxmltree::{Document, Node};
use wildcity_scene::geo::{GeoAnchor, ProjectedOrigin};

use super::FARTHEST_M;
use crate::{ConvertError, xml};

/// Most elements and texts of a file: those of a city.
const NODES: u32 = 50_000_000;

/// The numbers of the elements that give a road its shape.
const NUMBERS: [(&str, &[&str]); 14] = [
    ("road", &["length"]),
    ("geometry", &["s", "x", "y", "hdg", "length"]),
    ("arc", &["curvature"]),
    ("spiral", &["curvStart", "curvEnd"]),
    ("poly3", &["a", "b", "c", "d"]),
    ("paramPoly3", &["aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV"]),
    ("elevation", &["s", "a", "b", "c", "d"]),
    ("superelevation", &["s", "a", "b", "c", "d"]),
    ("shape", &["s", "t", "a", "b", "c", "d"]),
    ("laneOffset", &["s", "a", "b", "c", "d"]),
    ("laneSection", &["s"]),
    ("width", &["sOffset", "a", "b", "c", "d"]),
    ("border", &["sOffset", "a", "b", "c", "d"]),
    ("height", &["sOffset", "inner", "outer"]),
];

/// A file whose coordinates are near the origin.
pub(super) struct Framed {
    /// The text, with coordinates near the origin.
    pub(super) text: String,
    /// What was added to the x and y of the file, in metres.
    pub(super) shift_m: [f64; 2],
    /// The place of the origin on the earth, if the file says it.
    pub(super) geo: Option<GeoAnchor>,
    /// What a user should know: by how much the file was moved, and what it lacks.
    pub(super) notes: Vec<String>,
}

/// Moves the coordinates of a file to `origin`, which is an easting and a northing, or else by the
/// offset of its header.
pub(super) fn framed(text: &str, origin: Option<[f64; 2]>) -> Result<Framed, ConvertError> {
    let document = xml::parse(text, NODES)?;
    check_numbers(&document)?;
    let offset = header_offset(&document)?;
    let places = geometry_places(&document);
    let mut notes = Vec::new();
    let (shift_m, origin_m) = chosen_shift(&places, origin, offset.as_ref(), &mut notes)?;
    let text =
        if shift_m == [0.0, 0.0] { text.to_owned() } else { moved(text, &document, shift_m) };
    // Far from the origin, coordinates are those of the projection already, and so are heights.
    let is_local = places.iter().flatten().all(|axis| axis.abs() <= f64::from(FARTHEST_M));
    let offset = offset.filter(|_| is_local);
    let geo = origin_m.and_then(|origin_m| anchor_from(&document, origin_m, offset.as_ref()));
    if let Some((line, projection)) = projection(&document).filter(|_| geo.is_none()) {
        notes.push(format!(
            "line {line}, <geoReference>: {projection:?} does not place the origin on the earth; give its place with \
             `wildcity twin geo`"
        ));
    }
    Ok(Framed { text, shift_m, geo, notes })
}

/// Where the header's offset moves the file.
struct Offset {
    xy_m: [f64; 2],
    z_m: f64,
    hdg_rad: f64,
    line: u32,
}

fn wrong(node: Node<'_, '_>, message: String) -> ConvertError {
    let line = node.document().text_pos_at(node.range().start).row;
    ConvertError::new(format!("line {line}, <{}>", node.tag_name().name()), message)
}

/// Refuses numbers that are none: the reader of roads would take them for 0.
fn check_numbers(document: &Document<'_>) -> Result<(), ConvertError> {
    for node in document.descendants().filter(Node::is_element) {
        let name = node.tag_name().name();
        let Some((_, numbers)) = NUMBERS.iter().find(|(element, _)| *element == name) else {
            continue;
        };
        for attribute in node.attributes().filter(|one| numbers.contains(&one.name())) {
            let value: Option<f64> = attribute.value().trim().parse().ok();
            if !value.is_some_and(f64::is_finite) {
                let name = attribute.name();
                let value = attribute.value();
                return Err(wrong(node, format!("{name}={value:?}; write a finite number")));
            }
        }
    }
    Ok(())
}

fn number(node: Node<'_, '_>, name: &str) -> Result<f64, ConvertError> {
    let Some(text) = node.attribute(name) else { return Ok(0.0) };
    let value: Option<f64> = text.trim().parse().ok().filter(|value: &f64| value.is_finite());
    value.ok_or_else(|| wrong(node, format!("{name}={text:?}; write a finite number")))
}

fn header_offset(document: &Document<'_>) -> Result<Option<Offset>, ConvertError> {
    let header = document.root_element().children().find(|node| node.has_tag_name("header"));
    let offset = header.and_then(|node| node.children().find(|node| node.has_tag_name("offset")));
    let Some(node) = offset else { return Ok(None) };
    let [x, y, z, hdg] = ["x", "y", "z", "hdg"].map(|name| number(node, name));
    let line = document.text_pos_at(node.range().start).row;
    Ok(Some(Offset { xy_m: [x?, y?], z_m: z?, hdg_rad: hdg?, line }))
}

/// The coordinates in the file's frame: of geometries, and of signals that have their own.
fn is_place(node: &Node<'_, '_>) -> bool {
    node.has_tag_name("geometry") || node.has_tag_name("positionInertial")
}

fn geometry_places(document: &Document<'_>) -> Vec<[f64; 2]> {
    let places = document.descendants().filter(|node| node.has_tag_name("geometry"));
    places
        .filter_map(|node| {
            let [x, y] = ["x", "y"].map(|name| node.attribute(name)?.trim().parse().ok());
            Some([x?, y?])
        })
        .collect()
}

/// The shift of the coordinates, and the origin afterwards in the map's projection, if it is known.
fn chosen_shift(
    places: &[[f64; 2]],
    origin: Option<[f64; 2]>,
    offset: Option<&Offset>,
    notes: &mut Vec<String>,
) -> Result<([f64; 2], Option<[f64; 2]>), ConvertError> {
    let most_m = f64::from(FARTHEST_M);
    let is_near = |[dx, dy]: [f64; 2]| {
        places.iter().all(|[x, y]| (x + dx).abs() <= most_m && (y + dy).abs() <= most_m)
    };
    let is_local = is_near([0.0, 0.0]);
    match (origin, offset) {
        (None, None) if is_local => Ok(([0.0, 0.0], None)),
        (None, Some(offset)) if is_local => Ok(([0.0, 0.0], Some(offset.xy_m))),
        (None, Some(offset)) if is_near(offset.xy_m) => {
            let [x, y] = offset.xy_m;
            check_heading(offset)?;
            notes.push(format!(
                "line {}, <offset>: added to all coordinates, so that the origin is at easting {:?}, northing {:?}; \
                 heights stay as they are",
                offset.line, -x, -y
            ));
            Ok((offset.xy_m, Some([-x, -y])))
        }
        // Neither the file's own coordinates nor its offset are near the origin: the error proposes
        // one.
        (None, _) => {
            let bounds = [0, 1].map(|axis| {
                let values = places.iter().map(|place| place[axis]);
                [
                    values.clone().fold(f64::INFINITY, f64::min),
                    values.fold(-f64::INFINITY, f64::max),
                ]
            });
            // No origin brings both ends near.
            if bounds.iter().any(|[least, most]| most - least > 2.0 * most_m) {
                let message =
                    format!("its roads are more than {} m apart; cut the map", 2.0 * most_m);
                return Err(ConvertError::new("OpenDRIVE", message));
            }
            // The corner in the south-west, rounded down to a kilometre; for a larger map, its
            // middle.
            let [east, north] = bounds.map(|[least, most]| {
                if most - least < most_m {
                    (least / 1000.0).floor() * 1000.0
                } else {
                    (0.5 * (least + most)).round()
                }
            });
            let message = format!(
                "its roads are more than {most_m} m from the origin, where they are not exact: give the easting and \
                 the northing of the twin's origin, such as --origin {east:?},{north:?}"
            );
            Err(ConvertError::new("OpenDRIVE", message))
        }
        (Some([east, north]), offset) => {
            // By the standard, the offset takes coordinates to the projection. Coordinates far from
            // the origin are those of the projection already.
            let offset = offset.filter(|_| is_local);
            offset.map(check_heading).transpose()?;
            let [x, y] = offset.map_or([0.0, 0.0], |offset| offset.xy_m);
            // Coordinates with the offset are those of the projection, from which those of the
            // origin are subtracted.
            let shift_m = [x - east, y - north];
            if !is_near(shift_m) {
                let message = format!(
                    "with --origin {east:?},{north:?} its roads are more than {most_m} m from the origin; give a place \
                     on the map"
                );
                return Err(ConvertError::new("OpenDRIVE", message));
            }
            Ok((shift_m, Some([east, north])))
        }
    }
}

fn check_heading(offset: &Offset) -> Result<(), ConvertError> {
    if offset.hdg_rad == 0.0 {
        return Ok(());
    }
    let message = "hdg is not applied; turn the map, and remove it";
    Err(ConvertError::new(format!("line {}, <offset>", offset.line), message))
}

/// The text with other coordinates.
fn moved(text: &str, document: &Document<'_>, shift_m: [f64; 2]) -> String {
    // Only the numbers are replaced, so that the rest of the text stays as it is, byte for byte.
    let mut edits: Vec<(std::ops::Range<usize>, String)> = Vec::new();
    for node in document.descendants().filter(is_place) {
        for attribute in node.attributes() {
            let shift_m = match attribute.name() {
                "x" => shift_m[0],
                "y" => shift_m[1],
                _ => continue,
            };
            if let Ok(value) = attribute.value().trim().parse::<f64>() {
                edits.push((attribute.range_value(), format!("{:?}", value + shift_m)));
            }
        }
    }
    edits.sort_by_key(|(range, _)| range.start);
    let mut moved = String::with_capacity(text.len());
    let mut at = 0;
    // Invariant: `moved` has the text up to `at`.
    for (range, value) in edits {
        moved.push_str(&text[at..range.start]);
        moved.push_str(&value);
        at = range.end;
    }
    moved.push_str(&text[at..]);
    moved
}

/// The line of the file's projection, and its text, if it has one.
fn projection<'d>(document: &'d Document<'_>) -> Option<(u32, &'d str)> {
    let node = document.descendants().find(|node| node.has_tag_name("geoReference"))?;
    let text = node.text().map(str::trim).filter(|text| !text.is_empty())?;
    Some((document.text_pos_at(node.range().start).row, text))
}

/// The anchor of an origin in the map's projection, if that is a UTM zone of WGS84.
fn anchor_from(
    document: &Document<'_>,
    [easting_m, northing_m]: [f64; 2],
    offset: Option<&Offset>,
) -> Option<GeoAnchor> {
    let is_turned = offset.is_some_and(|offset| offset.hdg_rad != 0.0);
    let (_, projection) = projection(document)?;
    let words: Vec<&str> = projection.split_whitespace().collect();
    let value = |key: &str| words.iter().find_map(|word| word.strip_prefix(key)?.strip_prefix('='));
    // The ellipsoids WGS84 and GRS80 differ by 0.1 mm.
    let is_wgs84 = value("+datum").is_none_or(|datum| datum == "WGS84")
        && value("+ellps").is_none_or(|ellipsoid| matches!(ellipsoid, "WGS84" | "GRS80"));
    let projection = match value("+proj") {
        Some("utm") => {
            let zone: u32 = value("+zone")?.parse().ok().filter(|zone| (1..=60).contains(zone))?;
            // EPSG numbers UTM zones from 32601 in the north, and from 32701 in the south.
            format!("EPSG:{}", if words.contains(&"+south") { 32_700 } else { 32_600 } + zone)
        }
        Some(_) => return None,
        // Without `+proj` it may be a code, such as EPSG:32632.
        None => projection.to_uppercase(),
    };
    let altitude_m = offset.map_or(0.0, |offset| offset.z_m);
    let anchor =
        GeoAnchor::Projected(ProjectedOrigin { projection, easting_m, northing_m, altitude_m });
    (is_wgs84 && !is_turned && anchor.check().is_ok()).then_some(anchor)
}
