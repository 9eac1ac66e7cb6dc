//! PLY as the reference code of 3D Gaussian splatting writes it (Kerbl et al. 2023), in text or in
//! bytes of either order.
//!
//! Columns are found by name, in any order and of any type: x y z, rot_0..3 (w, x, y, z),
//! scale_0..2 (ln), opacity (logit), f_dc_0..2, and f_rest_0.. of 0, 9, 24 or 45 coefficients,
//! channel-major: all of red, then green, then blue. Dialects: no scale_2 (2D Gaussian splatting),
//! filter_3D (mip-splatting), red green blue of bytes in place of f_dc (nerfstudio), and an element
//! vertex_background with one more per moving object (street_gaussians). A column semantic_class
//! has values of [`SemanticClass`]. Normals are skipped; other columns, elements and comments are
//! named in a warning.

mod body;
mod columns;
mod comments;
mod compressed;
mod header;
mod write;

use std::collections::BTreeMap;
use std::io::BufRead;

use wildcity_scene::{Gaussians, SemanticClass};

use super::capture::CapturePoint;
use super::notes::{BLUR_BRUSH_PX2, Reading};
use super::validate::NAMED_BAD_GAUSSIANS;
use super::{IngestError, Progress, check_count};
use body::Body;
use columns::{Columns, FILTER, degree, file_name};
use header::{Element, Header, error};

pub use write::write_ply;

/// Reads a PLY file of a known size.
pub(super) fn read(
    mut input: impl BufRead,
    file_bytes: u64,
    reading: &mut Reading,
    progress: Progress<'_>,
) -> Result<Gaussians, IngestError> {
    let header = Header::read(&mut input)?;
    let Some(vertex) = ["vertex", "vertex_background"].iter().find_map(|name| header.element(name))
    else {
        return Err(error("end".into(), "there is no element vertex".into()));
    };
    header.comments.iter().for_each(|comment| comments::read(comment, reading));
    for comment in &header.damaged_comments {
        reading.warn(format!("comment {comment:?} is not UTF-8: other bytes are read as \u{fffd}"));
    }
    if vertex.property("packed_position").is_ok() {
        return compressed::read(input, &header, file_bytes, reading, progress);
    }
    // Check columns before the size: a missing column changes the size, too, and its name is the
    // clearer error.
    let columns = Columns::find(vertex)?;
    header.check_size(file_bytes)?;
    let count = check_count(vertex.count)?;
    note_columns(&columns, vertex, reading);
    let skipped = header.elements.iter().filter(|other| other.name != vertex.name);
    for other in skipped.filter(|other| other.count > 0) {
        reading.warn(format!("element {} ({} rows) is not read", other.name, other.count));
    }
    let mut gaussians = Gaussians::with_capacity(columns.sh_degree, count);
    let encoding = header.encoding;
    let mut body = Body { input, encoding, done: header.bytes, file_bytes, progress };
    let mut classes = columns.has_classes().then(|| Vec::with_capacity(count));
    let mut bad_class = None;
    // Scales and opacities are NaN behind such a filter.
    let mut bad_filters = BTreeMap::new();
    for element in &header.elements {
        body.rows(element, |row| {
            // Other elements are read only to pass over their rows.
            if element.name == vertex.name {
                let bad = columns.filter(row).filter(|filter| !filter.is_finite());
                // Only as many as an error names.
                if let Some(bad) = bad.filter(|_| bad_filters.len() < NAMED_BAD_GAUSSIANS) {
                    bad_filters.insert(gaussians.len(), bad);
                }
                if let Some(classes) = &mut classes {
                    let class = columns.class(row).unwrap_or_else(|reason| {
                        bad_class.get_or_insert((gaussians.len(), reason));
                        SemanticClass::Unlabelled
                    });
                    classes.push(class);
                }
                columns.push(row, &mut gaussians);
            }
        })?;
    }
    body.check_end()?;
    // Not left out with the Gaussians that cannot be drawn: a wrong number is of another table of
    // classes, in which the others would mean something else, too.
    if let Some((row, reason)) = bad_class {
        let place = format!("row {row} of {}", vertex.name);
        return Err(IngestError::Body { format: "PLY", place, reason });
    }
    gaussians.classes = classes;
    let sh_degree = columns.sh_degree;
    let accepted = reading.accept(gaussians, &|field| file_name(field, sh_degree));
    accepted.map_err(|error| with_filters(error, &bad_filters))
}

/// Reads the vertices of a PLY file as points: x, y, z, and red, green and blue of 8 bits, or grey
/// where it has no colours.
pub(super) fn read_points(
    mut input: impl BufRead,
    file_bytes: u64,
) -> Result<Vec<CapturePoint>, IngestError> {
    let header = Header::read(&mut input)?;
    let Some(vertex) = header.element("vertex") else {
        return Err(error("end".into(), "there is no element vertex".into()));
    };
    let [x, y, z] = ["x", "y", "z"].map(|name| vertex.property(name));
    let place = [x?, y?, z?];
    let colors = ["red", "green", "blue"].map(|name| vertex.property(name).ok());
    header.check_size(file_bytes)?;
    let mut points = Vec::with_capacity(check_count(vertex.count)?);
    let mut faulty = None;
    let encoding = header.encoding;
    let progress = &mut |_, _| {};
    let mut body = Body { input, encoding, done: header.bytes, file_bytes, progress };
    for element in &header.elements {
        body.rows(element, |row| {
            if element.name == "vertex" {
                let at = place.map(|property| property.value(row));
                if !at.iter().all(|value| value.is_finite()) {
                    faulty.get_or_insert((points.len(), at));
                }
                // The cast saturates, so that values beyond 255 are full brightness.
                let rgb8 = colors.map(|color| color.map_or(128, |color| color.value(row) as u8));
                points.push(CapturePoint { at, rgb8 });
            }
        })?;
    }
    body.check_end()?;
    match faulty {
        Some((row, at)) => Err(error(format!("row {row} of vertex"), format!("is at {at:?}"))),
        None => Ok(points),
    }
}

/// The error of Gaussians, with the name of the filter where that is what is wrong.
fn with_filters(mut error: IngestError, bad_filters: &BTreeMap<usize, f64>) -> IngestError {
    if let IngestError::Values(bad) = &mut error {
        for named in &mut bad.first {
            let filter = bad_filters.get(&named.index);
            if let Some(filter) = filter.filter(|_| named.field.starts_with("scale_")) {
                named.field = FILTER.to_owned();
                named.value = filter.to_string();
                named.must = "a width is finite";
            }
        }
    }
    error
}

/// Notes what the columns say besides the Gaussians.
fn note_columns(columns: &Columns, vertex: &Element, reading: &mut Reading) {
    if columns.is_flat() {
        reading.set_flat("no property scale_2");
    }
    if columns.has_filter() {
        // mip-splatting renders with this blur and with compensation.
        reading.set_antialiased(BLUR_BRUSH_PX2, "property filter_3D".to_owned());
    }
    let skipped = columns.skipped(vertex);
    if !skipped.is_empty() {
        reading.warn_skipped("properties", &skipped);
    }
}
