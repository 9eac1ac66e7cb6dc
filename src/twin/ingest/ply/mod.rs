//! PLY as the reference code of 3D Gaussian splatting writes it (Kerbl et al. 2023).
//!
//! Columns are found by name, in any order and of any type: x y z, rot_0..3 (w, x, y, z),
//! scale_0..2 (ln), opacity (logit), f_dc_0..2, and f_rest_0.. of 0, 9, 24 or 45 coefficients,
//! channel-major: all of red, then green, then blue. Other columns, such as normals, are skipped.

mod compressed;
mod header;

use std::io::{BufRead, Read};

use wildcity_scene::{Gaussians, sh};

use super::validate::{self, Field};
use super::{IngestError, Progress, check_count};
use header::{Element, Header, Property, error};

/// Reads a PLY file of a known size.
pub(super) fn read(
    mut input: impl BufRead,
    file_bytes: u64,
    progress: Progress<'_>,
) -> Result<Gaussians, IngestError> {
    let header = Header::read(&mut input)?;
    let Some(vertex) = header.element("vertex") else {
        return Err(error("end".into(), "there is no element vertex".into()));
    };
    if vertex.property("packed_position").is_ok() {
        return compressed::read(input, &header, file_bytes, progress);
    }
    // Check columns before the size: a missing column changes the size, too, and its name is the clearer error.
    let columns = Columns::find(vertex)?;
    header.check_size(file_bytes)?;
    let count = check_count(vertex.count)?;
    let mut gaussians = Gaussians::with_capacity(columns.sh_degree, count);
    let mut body = Body { input, done: header.bytes, file_bytes, progress };
    for element in &header.elements {
        body.rows(element, |row| {
            if element.name == "vertex" {
                columns.push(row, &mut gaussians);
            }
        })?;
    }
    let sh_degree = columns.sh_degree;
    validate::check(&gaussians, &|field| file_name(field, sh_degree))?;
    Ok(gaussians)
}

/// The bytes after the header.
struct Body<'a, R> {
    input: R,
    /// Bytes of the file that have been read.
    done: u64,
    file_bytes: u64,
    progress: Progress<'a>,
}

/// Rows between two reports of progress.
const REPORT_EVERY: u64 = 16_384;

impl<R: Read> Body<'_, R> {
    /// Calls `take` with each row of the next element.
    fn rows(&mut self, element: &Element, mut take: impl FnMut(&[u8])) -> Result<(), IngestError> {
        let mut row = vec![0; element.stride];
        let count = if element.stride == 0 { 0 } else { element.count };
        for index in 0..count {
            self.input.read_exact(&mut row)?;
            take(&row);
            self.done += row.len() as u64;
            if index % REPORT_EVERY == REPORT_EVERY - 1 {
                (self.progress)(self.done, self.file_bytes);
            }
        }
        (self.progress)(self.done, self.file_bytes);
        Ok(())
    }
}

/// The columns of a vertex.
struct Columns {
    sh_degree: u8,
    means: Vec<Property>,
    quats: Vec<Property>,
    scales: Vec<Property>,
    opacity: Property,
    /// Coefficient-major, then red, green, blue, which is the order in memory.
    sh: Vec<Property>,
}

impl Columns {
    fn find(vertex: &Element) -> Result<Self, IngestError> {
        let find = |names: &[String]| {
            names.iter().map(|name| vertex.property(name).cloned()).collect::<Result<Vec<_>, _>>()
        };
        let numbered = |prefix: &str, count: usize| {
            (0..count).map(|i| format!("{prefix}_{i}")).collect::<Vec<_>>()
        };
        let sh_degree = degree(vertex)?;
        let sh = (0..sh::coefficients(sh_degree)).flat_map(|k| (0..3).map(move |c| (k, c)));
        let sh: Vec<_> = sh.map(|(k, c)| file_name(Field::Sh(k, c), sh_degree)).collect();
        Ok(Self {
            sh_degree,
            means: find(&["x", "y", "z"].map(str::to_owned))?,
            quats: find(&numbered("rot", 4))?,
            scales: find(&numbered("scale", 3))?,
            opacity: vertex.property("opacity")?.clone(),
            sh: find(&sh)?,
        })
    }

    fn push(&self, row: &[u8], gaussians: &mut Gaussians) {
        let value = |property: &Property| property.value(row);
        let single = |property: &Property| property.value(row) as f32;
        gaussians.means_m.push(std::array::from_fn(|i| value(&self.means[i])));
        gaussians.quats_wxyz.push(std::array::from_fn(|i| single(&self.quats[i])));
        gaussians.ln_scales.push(std::array::from_fn(|i| single(&self.scales[i])));
        gaussians.logit_opacities.push(single(&self.opacity));
        gaussians.sh.extend(self.sh.iter().map(single));
    }
}

/// The SH degree, from the number of f_rest columns.
fn degree(element: &Element) -> Result<u8, IngestError> {
    let rest = element.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let degree = (0..=sh::MAX_DEGREE).find(|&d| 3 * (sh::coefficients(d) - 1) == rest);
    degree.ok_or_else(|| {
        let reason = format!("{rest} properties f_rest_*; 0, 9, 24 or 45 make an SH degree");
        error(format!("element {}", element.name), reason)
    })
}

/// The name of a field in a PLY file.
fn file_name(field: Field, sh_degree: u8) -> String {
    match field {
        Field::Mean(axis) => ["x", "y", "z"][axis].into(),
        Field::Quat(i) => format!("rot_{i}"),
        Field::QuatLength => "length of rot".into(),
        Field::Scale(axis) => format!("scale_{axis}"),
        Field::Opacity => "opacity".into(),
        Field::Sh(0, channel) => format!("f_dc_{channel}"),
        Field::Sh(k, channel) => {
            format!("f_rest_{}", channel * (sh::coefficients(sh_degree) - 1) + k - 1)
        }
    }
}
