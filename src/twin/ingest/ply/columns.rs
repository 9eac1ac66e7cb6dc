//! The columns of a Gaussian in a PLY file, and what they mean.

use wildcity_scene::{Gaussians, SemanticClass, sh};

use super::header::{Element, Property, Scalar, error};
use crate::ingest::validate::{Field, LN_SCALE};
use crate::ingest::{IngestError, activation, classes};

/// Columns that are not read and change no picture: the reference code writes normals of zero.
const WITHOUT_EFFECT: [&str; 3] = ["nx", "ny", "nz"];
/// The width of the 3D filter of mip-splatting, a standard deviation.
pub(super) const FILTER: &str = "filter_3D";

/// The columns of a vertex.
pub(super) struct Columns {
    pub(super) sh_degree: u8,
    means: Vec<Property>,
    quats: Vec<Property>,
    /// Two of a flat Gaussian, or three.
    scales: Vec<Property>,
    opacity: Property,
    dc: BaseColour,
    /// Above degree 0; coefficient-major, then red, green, blue, which is the order in memory.
    rest: Vec<Property>,
    filter: Option<Property>,
    class: Option<Property>,
}

/// The colour of degree 0.
enum BaseColour {
    Coefficients(Vec<Property>),
    /// Colours of 0 to 255.
    Bytes(Vec<Property>),
}

impl Columns {
    pub(super) fn find(vertex: &Element) -> Result<Self, IngestError> {
        let find = |names: &[String]| {
            names.iter().map(|name| vertex.property(name).cloned()).collect::<Result<Vec<_>, _>>()
        };
        let numbered = |prefix: &str, count: usize| {
            (0..count).map(|i| format!("{prefix}_{i}")).collect::<Vec<_>>()
        };
        let sh_degree = degree(vertex)?;
        // The columns f_rest_* are channel-major, which `file_name` accounts for.
        let rest = (1..sh::coefficients(sh_degree)).flat_map(|k| (0..3).map(move |c| (k, c)));
        let rest: Vec<_> = rest.map(|(k, c)| file_name(Field::Sh(k, c), sh_degree)).collect();
        // 2D Gaussian splatting writes two scales.
        let is_flat = vertex.property("scale_1").is_ok() && vertex.property("scale_2").is_err();
        Ok(Self {
            sh_degree,
            means: find(&["x", "y", "z"].map(str::to_owned))?,
            quats: find(&numbered("rot", 4))?,
            scales: find(&numbered("scale", if is_flat { 2 } else { 3 }))?,
            opacity: vertex.property("opacity")?.clone(),
            dc: BaseColour::find(vertex)?,
            rest: find(&rest)?,
            filter: vertex.property(FILTER).ok().cloned(),
            class: vertex.property(classes::NAME).ok().cloned(),
        })
    }

    /// Whether the Gaussians are flat.
    pub(super) fn is_flat(&self) -> bool {
        self.scales.len() == 2
    }

    /// Whether the Gaussians have the 3D filter of mip-splatting.
    pub(super) fn has_filter(&self) -> bool {
        self.filter.is_some()
    }

    /// The width of the 3D filter in a row.
    pub(super) fn filter(&self, row: &[u8]) -> Option<f64> {
        self.filter.as_ref().map(|filter| filter.value(row))
    }

    /// Names of the columns that are not read, but for those without an effect.
    pub(super) fn skipped<'a>(&self, vertex: &'a Element) -> Vec<&'a str> {
        let dc = match &self.dc {
            BaseColour::Coefficients(dc) | BaseColour::Bytes(dc) => dc,
        };
        let read = [&self.means, &self.quats, &self.scales, dc, &self.rest].into_iter().flatten();
        let read: Vec<&str> = read
            .chain([&self.opacity])
            .chain(&self.filter)
            .chain(&self.class)
            .map(|property| property.name.as_str())
            .chain(WITHOUT_EFFECT)
            .collect();
        let names = vertex.properties.iter().map(|property| property.name.as_str());
        names.filter(|name| !read.contains(name)).collect()
    }

    /// Whether the Gaussians have classes.
    pub(super) fn has_classes(&self) -> bool {
        self.class.is_some()
    }

    /// The class in a row; unlabelled without the property. The error says what is wrong with it.
    pub(super) fn class(&self, row: &[u8]) -> Result<SemanticClass, String> {
        self.class
            .as_ref()
            .map_or(Ok(SemanticClass::Unlabelled), |class| classes::class(class.value(row)))
    }

    /// Appends the Gaussian of a row, without its class.
    pub(super) fn push(&self, row: &[u8], gaussians: &mut Gaussians) {
        let value = |property: &Property| property.value(row);
        let single = |property: &Property| property.value(row) as f32;
        gaussians.means_m.push(std::array::from_fn(|i| value(&self.means[i])));
        gaussians.quats_wxyz.push(std::array::from_fn(|i| single(&self.quats[i])));
        // Flat Gaussians have no third scale. The smallest one that is accepted stands for it.
        let scale = |i: usize| self.scales.get(i).map_or(LN_SCALE[0], single);
        let filter = self.filter.as_ref().map_or(0.0, value);
        let (ln_scales, logit) =
            filtered(std::array::from_fn(scale), single(&self.opacity), filter);
        gaussians.ln_scales.push(ln_scales);
        gaussians.logit_opacities.push(logit);
        match &self.dc {
            BaseColour::Coefficients(dc) => gaussians.sh.extend(dc.iter().map(single)),
            BaseColour::Bytes(rgb) => {
                gaussians.sh.extend(rgb.iter().map(|c| activation::dc(value(c) / 255.0)));
            }
        }
        gaussians.sh.extend(self.rest.iter().map(single));
    }
}

impl BaseColour {
    /// nerfstudio's `ns-export gaussian-splat --ply-color-mode rgb` writes red, green and blue in
    /// place of f_dc.
    fn find(vertex: &Element) -> Result<Self, IngestError> {
        let find = |names: [&str; 3]| {
            names.iter().map(|name| vertex.property(name).cloned()).collect::<Result<Vec<_>, _>>()
        };
        let coefficients = find(["f_dc_0", "f_dc_1", "f_dc_2"]);
        match find(["red", "green", "blue"]) {
            Ok(rgb) if coefficients.is_err() => match rgb.iter().find(|c| c.scalar != Scalar::U8) {
                None => Ok(Self::Bytes(rgb)),
                Some(other) => {
                    let reason = format!("{} must be uchar, or give f_dc_0 to f_dc_2", other.name);
                    Err(error(format!("element {}", vertex.name), reason))
                }
            },
            _ => coefficients.map(Self::Coefficients),
        }
    }
}

/// Scales and opacity with the 3D filter of mip-splatting (Yu et al. 2024, section 4.1): the
/// Gaussian is convolved with one of the standard deviation `filter`, and keeps its integral. A
/// filter of 0 changes no bit.
fn filtered(ln_scales: [f32; 3], logit: f32, filter: f64) -> ([f32; 3], f32) {
    if filter == 0.0 {
        return (ln_scales, logit);
    }
    // The variances of the axes are squares of exp(ln scale), so 2 ln.
    let before = ln_scales.map(|ln| (2.0 * f64::from(ln)).exp());
    let after = before.map(|variance| variance + filter * filter);
    // The integral is proportional to the opacity times the product of the standard deviations, so
    // the opacity falls by the ratio of the products.
    let ratio: f64 = before.iter().zip(after).map(|(before, after)| before / after).product();
    let opacity = ratio.sqrt() / (1.0 + f64::from(-logit).exp());
    (after.map(|variance| (0.5 * variance.ln()) as f32), activation::logit(opacity))
}

/// The SH degree, from the number of f_rest columns.
pub(super) fn degree(element: &Element) -> Result<u8, IngestError> {
    let rest = element.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let degree = (0..=sh::MAX_DEGREE).find(|&d| 3 * (sh::coefficients(d) - 1) == rest);
    degree.ok_or_else(|| {
        let reason = format!("{rest} properties f_rest_*; 0, 9, 24 or 45 make an SH degree");
        error(format!("element {}", element.name), reason)
    })
}

/// The name of a field in a PLY file.
pub(super) fn file_name(field: Field, sh_degree: u8) -> String {
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
