//! The payload of NVIDIA's NuRec: MessagePack in a gzip stream, within USDZ.
//!
//! Source: what NVIDIA's 3dgrut writes. `nre_data.state_dict` has, per layer of
//! `.gaussians_nodes.LAYER`, arrays of f16 or f32 with their shapes: positions, rotations (w, x, y,
//! z), scales (ln), densities (logit), features_albedo (degree 0) and features_specular (the higher
//! degrees, coefficient-major, then red, green, blue), of which n_active_features degrees count. A
//! layer of tracked objects is skipped, because it has no fixed place. Positions are in the
//! payload's axes; the USD layers around it, which may rotate and move it, are not read.

mod msgpack;

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;

use flate2::bufread::GzDecoder;
use half::f16;

use crate::limits;
use wildcity_scene::{Gaussians, sh};

use super::unpack_budget::UnpackBudget;
use super::validate::{self, Field};
use super::{IngestError, check_count};
use msgpack::Value;

const FORMAT: &str = "NuRec";
const LAYERS: &str = ".gaussians_nodes.";

/// Reads a payload.
pub(super) fn read(payload: &[u8], budget: &mut UnpackBudget) -> Result<Gaussians, IngestError> {
    let limit = budget.left_bytes();
    let mut bytes = Vec::new();
    let mut decoder = GzDecoder::new(payload);
    let read = decoder.by_ref().take(limit + 1).read_to_end(&mut bytes);
    read.map_err(|e| bad("the gzip stream", format!("is damaged: {e}; copy it again")))?;
    budget.unpack(FORMAT, "the gzip stream", bytes.len() as u128)?;
    let rest = decoder.into_inner();
    if !rest.is_empty() {
        return Err(bad("the gzip stream", format!("is followed by {} bytes", rest.len())));
    }
    let root = msgpack::parse(&bytes).map_err(|reason| bad("MessagePack", reason))?;
    let missing = |name: &str| bad(name, "is missing".into());
    let data = root.get("nre_data").ok_or_else(|| missing("nre_data"))?;
    let state = data.get("state_dict").ok_or_else(|| missing("nre_data.state_dict"))?;
    // Maps are searched once per layer and field, so they are indexed.
    let tracks = state.get("._extra_state").and_then(|extra| extra.get("obj_track_ids"));
    let tracks = tracks.map(Value::index).unwrap_or_default();
    let settings = data.get("config").and_then(|config| config.get("layers"));
    let settings = settings.map(Value::index).unwrap_or_default();

    let names = state.keys().filter_map(|key| key.strip_prefix(LAYERS)?.strip_suffix(".positions"));
    let is_static = |layer: &&str| match tracks.get(layer) {
        Some(Value::Array(ids)) => ids.is_empty(),
        _ => true,
    };
    // A key may be repeated: the first one counts.
    let mut seen = BTreeSet::new();
    let layers: Vec<&str> = names.filter(is_static).filter(|&name| seen.insert(name)).collect();
    if layers.is_empty() {
        return Err(missing("a layer of static Gaussians"));
    }
    if layers.len() > limits::NUREC_LAYERS {
        let reason = format!("{} layers; at most {} are read", layers.len(), limits::NUREC_LAYERS);
        return Err(bad("nre_data.state_dict", reason));
    }
    let fields = state.index();
    let mut all = Gaussians::default();
    for name in layers {
        budget.check_stop()?;
        if let Some(settings) = settings.get(name) {
            check_activations(settings, name)?;
        }
        let part = Layer { fields: &fields, name }.read()?;
        all.append(&part);
        check_count(all.len() as u64)?;
    }
    validate::check(&all, &Field::plain_name)?;
    Ok(all)
}

/// Checks that parameters have the activations that this reader assumes.
fn check_activations(settings: &Value<'_>, layer: &str) -> Result<(), IngestError> {
    let wanted = [
        ("density_activation", "sigmoid"),
        ("scale_activation", "exp"),
        ("rotation_activation", "normalize"),
    ];
    for (key, wanted) in wanted {
        match settings.get(key) {
            Some(Value::Text(found)) if *found != wanted => {
                let reason = format!("is {found:?}; {wanted:?} is read");
                return Err(bad(&format!("config.layers.{layer}.{key}"), reason));
            }
            _ => (),
        }
    }
    Ok(())
}

/// The arrays of one layer.
struct Layer<'a> {
    fields: &'a BTreeMap<&'a str, &'a Value<'a>>,
    name: &'a str,
}

impl Layer<'_> {
    fn read(&self) -> Result<Gaussians, IngestError> {
        let means = self.array("positions", Some(3), None)?;
        let rows = Some(means.rows);
        let quats = self.array("rotations", Some(4), rows)?;
        let scales = self.array("scales", Some(3), rows)?;
        let densities = self.array("densities", Some(1), rows)?;
        let albedo = self.array("features_albedo", Some(3), rows)?;
        let specular = self.array("features_specular", None, rows)?;
        let held =
            (0..=sh::MAX_DEGREE).find(|&d| 3 * (sh::coefficients(d) - 1) == specular.columns);
        let held = held.ok_or_else(|| {
            let reason = format!("{} columns; 0, 9, 24 or 45 make an SH degree", specular.columns);
            bad(&self.key("features_specular"), reason)
        })?;
        let sh_degree = self.active_degree().map_or(held, |active| held.min(active));
        let count = check_count(means.rows as u64)?;
        let mut g = Gaussians::with_capacity(sh_degree, count);
        g.means_m.extend((0..count).map(|i| means.row(i).map(f64::from)));
        g.quats_wxyz.extend((0..count).map(|i| quats.row(i)));
        g.ln_scales.extend((0..count).map(|i| scales.row(i)));
        g.logit_opacities.extend((0..count).map(|i| densities.value(i, 0)));
        for i in 0..count {
            g.sh.extend(albedo.row::<3>(i));
            g.sh.extend((0..3 * (sh::coefficients(sh_degree) - 1)).map(|k| specular.value(i, k)));
        }
        Ok(g)
    }

    fn key(&self, field: &str) -> String {
        format!("{LAYERS}{}.{field}", self.name)
    }

    /// The SH degree that training had reached, stored as i64.
    fn active_degree(&self) -> Option<u8> {
        match self.fields.get(&*self.key("n_active_features")) {
            Some(Value::Bytes(bytes)) => {
                let degree = i64::from_le_bytes(**bytes.first_chunk().as_ref()?);
                u8::try_from(degree).ok()
            }
            _ => None,
        }
    }

    fn array(
        &self,
        field: &str,
        columns: Option<usize>,
        rows: Option<usize>,
    ) -> Result<Array<'_>, IngestError> {
        let key = self.key(field);
        let shape = match self.fields.get(&*format!("{key}.shape")) {
            Some(Value::Array(shape)) => shape.iter().map(Value::as_usize).collect(),
            _ => None,
        };
        let shape: Option<Vec<usize>> = shape;
        let Some(&[found_rows, found_columns]) = shape.as_deref() else {
            return Err(bad(&format!("{key}.shape"), "is not two numbers".into()));
        };
        if columns.is_some_and(|c| c != found_columns) || rows.is_some_and(|r| r != found_rows) {
            let any = |n: Option<usize>| n.map_or("any".into(), |n| n.to_string());
            let reason =
                format!("[{found_rows}, {found_columns}], not [{}, {}]", any(rows), any(columns));
            return Err(bad(&format!("{key}.shape"), reason));
        }
        let Some(Value::Bytes(bytes)) = self.fields.get(&*key) else {
            return Err(bad(&key, "is not an array of bytes".into()));
        };
        let values = found_rows as u128 * found_columns as u128;
        let is_f32 = values * 4 == bytes.len() as u128;
        if !is_f32 && values * 2 != bytes.len() as u128 {
            let reason = format!(
                "{} bytes, which is not the size of {values} numbers of f16 or f32",
                bytes.len()
            );
            return Err(bad(&key, reason));
        }
        Ok(Array { bytes, is_f32, rows: found_rows, columns: found_columns })
    }
}

/// A matrix of numbers.
struct Array<'a> {
    bytes: &'a [u8],
    is_f32: bool,
    rows: usize,
    columns: usize,
}

impl Array<'_> {
    fn value(&self, row: usize, column: usize) -> f32 {
        let index = row * self.columns + column;
        match self.is_f32 {
            true => f32::from_le_bytes(self.bytes.as_chunks().0[index]),
            false => f16::from_le_bytes(self.bytes.as_chunks().0[index]).to_f32(),
        }
    }

    fn row<const N: usize>(&self, row: usize) -> [f32; N] {
        std::array::from_fn(|column| self.value(row, column))
    }
}

fn bad(place: &str, reason: String) -> IngestError {
    IngestError::Body { format: FORMAT, place: place.into(), reason }
}
