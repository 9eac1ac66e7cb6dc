//! The payload of NVIDIA's NuRec: MessagePack in a gzip stream, within USDZ.
//!
//! Source: what NVIDIA's 3dgrut writes. `nre_data.state_dict` has, per layer of
//! `.gaussians_nodes.LAYER`, arrays of f16 or f32 with their shapes: positions, rotations (w, x, y,
//! z), scales (ln), densities (logit), features_albedo (degree 0) and features_specular (the higher
//! degrees, coefficient-major, then red, green, blue), of which n_active_features degrees count. A
//! layer of tracked objects is skipped, because it has no fixed place ([`read_tracked`] reads it:
//! gaussian_cuboid_ids names the track of each Gaussian, and positions are relative to the middle
//! of the track's cuboid). A layer whose name is a class (`road`) has this class. Positions are in
//! the payload's axes; the USD layers around it, which may rotate and move it, are not read.

mod msgpack;
mod settings;

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;

use flate2::bufread::GzDecoder;
use half::f16;

use crate::limits;
use wildcity_scene::{Gaussians, SemanticClass, sh};

use super::notes::Reading;
use super::objects::{self, TrackedObject};
use super::unpack_budget::UnpackBudget;
use super::validate::{self, Field};
use super::{IngestError, check_count};
use msgpack::Value;

const FORMAT: &str = "NuRec";
const LAYERS: &str = ".gaussians_nodes.";

/// Fields of a layer that are read, or that hold nothing for the picture.
const READ_FIELDS: [&str; 10] = [
    "positions",
    "rotations",
    "scales",
    "densities",
    "features_albedo",
    "features_specular",
    "n_active_features",
    "gaussian_cuboid_ids",
    "extra_signal",
    "shape",
];

/// Reads the static Gaussians of a payload.
pub(super) fn read(
    payload: &[u8],
    budget: &mut UnpackBudget,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let bytes = unpack(payload, budget)?;
    let root = msgpack::parse(&bytes).map_err(|reason| bad("MessagePack", reason))?;
    let payload = Payload::from_root(&root)?;
    // A layer with tracks holds objects in the axes of their cuboids. Drawn with the rest, they
    // would all lie in each other at the origin.
    let is_static = |name: &&str| payload.layer_tracks(name).is_empty();
    let layers: Vec<&str> = payload.names.iter().copied().filter(is_static).collect();
    let moving: Vec<&str> = payload.names.iter().copied().filter(|name| !is_static(name)).collect();
    if !moving.is_empty() {
        reading.warn_skipped("layers of moving objects", &moving);
    }
    if layers.is_empty() {
        return Err(bad("a layer of static Gaussians", "is missing".into()));
    }
    payload.warn_skipped(reading);
    if let Some(data) = root.get("nre_data") {
        settings::check_data(data, reading);
    }
    let mut all = Gaussians::default();
    for name in layers {
        // A cancelled push ends between two layers.
        budget.check_stop()?;
        match payload.settings.get(name) {
            Some(settings) => settings::warn_skipped(settings, name, reading),
            None => reading.warn(format!(
                "layer {name} has no settings in config.layers: it is drawn as Gaussians, whatever kernel it was trained \
                 with"
            )),
        }
        let mut layer = payload.layer(name)?.read()?;
        layer.classes = layer_class(name).map(|class| vec![class; layer.len()]);
        all.append(&layer);
        // Checked as layers are added, so that the sum cannot pass the limit by more than one
        // layer.
        check_count(all.len() as u64)?;
    }
    reading.accept(all, &Field::plain_name)
}

/// Reads the tracked objects of a payload: layers with tracks, split by track.
pub(super) fn read_tracked(
    payload: &[u8],
    budget: &mut UnpackBudget,
) -> Result<Vec<TrackedObject>, IngestError> {
    let bytes = unpack(payload, budget)?;
    let root = msgpack::parse(&bytes).map_err(|reason| bad("MessagePack", reason))?;
    let payload = Payload::from_root(&root)?;
    let mut found = Vec::new();
    for &name in &payload.names {
        let tracks = payload.layer_tracks(name);
        if tracks.is_empty() {
            continue;
        }
        budget.check_stop()?;
        let layer = payload.layer(name)?;
        let mut gaussians = layer.read()?;
        check_count(gaussians.len() as u64)?;
        // As for a scene: values at the ends of their ranges are clamped before the bounds are
        // checked.
        gaussians.clamp_activations();
        validate::check(&gaussians, &Field::plain_name)?;
        let ids = layer.cuboid_ids(gaussians.len(), tracks.len())?;
        // A negative id is no index: its Gaussian is of no track, and is left out.
        let track = |id: i64| match tracks.get(usize::try_from(id).ok()?)? {
            Value::Text(track) => Some((*track).to_owned()),
            Value::Count(number) => Some(number.to_string()),
            // Other values cannot be printed: the index tells such tracks apart.
            _ => Some(id.to_string()),
        };
        found.extend(objects::split(&gaussians, &ids, track));
    }
    Ok(found)
}

/// The class of the Gaussians of a layer, if its name is that of one: `road` is one in the scenes
/// of NVIDIA's reconstructions, and `background`, which has all else, is none.
fn layer_class(name: &str) -> Option<SemanticClass> {
    SemanticClass::from_name(name).filter(|class| *class != SemanticClass::None)
}

/// The bytes of a gzip stream.
fn unpack(payload: &[u8], budget: &mut UnpackBudget) -> Result<Vec<u8>, IngestError> {
    let limit = budget.left_bytes();
    let mut bytes = Vec::new();
    let mut decoder = GzDecoder::new(payload);
    // One byte over the limit is enough to make the budget below refuse the stream.
    let read = decoder.by_ref().take(limit + 1).read_to_end(&mut bytes);
    read.map_err(|e| bad("the gzip stream", format!("is damaged: {e}; copy it again")))?;
    budget.unpack(FORMAT, "the gzip stream", bytes.len() as u128)?;
    // Data after the stream is a second payload or damage, and neither is read.
    let rest = decoder.into_inner();
    if !rest.is_empty() {
        return Err(bad("the gzip stream", format!("is followed by {} bytes", rest.len())));
    }
    Ok(bytes)
}

/// The maps of a payload that are read. They are searched once per layer and field, so they are
/// indexed.
struct Payload<'a> {
    /// The layers' names, in the order of the file.
    names: Vec<&'a str>,
    fields: BTreeMap<&'a str, &'a Value<'a>>,
    tracks: BTreeMap<&'a str, &'a Value<'a>>,
    settings: BTreeMap<&'a str, &'a Value<'a>>,
}

impl<'a> Payload<'a> {
    fn from_root(root: &'a Value<'a>) -> Result<Self, IngestError> {
        let missing = |name: &str| bad(name, "is missing".into());
        let data = root.get("nre_data").ok_or_else(|| missing("nre_data"))?;
        let state = data.get("state_dict").ok_or_else(|| missing("nre_data.state_dict"))?;
        let tracks = state.get("._extra_state").and_then(|extra| extra.get("obj_track_ids"));
        let settings = data.get("config").and_then(|config| config.get("layers"));
        let keys = state.keys();
        // Every layer has positions, so these keys name all layers.
        let names = keys.filter_map(|key| key.strip_prefix(LAYERS)?.strip_suffix(".positions"));
        // A key may be repeated: the first one counts.
        let mut seen = BTreeSet::new();
        let names: Vec<&str> = names.filter(|&name| seen.insert(name)).collect();
        if names.len() > limits::NUREC_LAYERS {
            let reason =
                format!("{} layers; at most {} are read", names.len(), limits::NUREC_LAYERS);
            return Err(bad("nre_data.state_dict", reason));
        }
        Ok(Self {
            names,
            fields: state.index(),
            tracks: tracks.map(Value::index).unwrap_or_default(),
            settings: settings.map(Value::index).unwrap_or_default(),
        })
    }

    /// Warns of what the model has besides the layers of Gaussians.
    fn warn_skipped(&self, reading: &mut Reading) {
        // The last part is the field, or `shape` for the shape of one. A layer's name may contain
        // dots.
        let is_read = |key: &&str| {
            let field = key.strip_prefix(LAYERS).and_then(|rest| rest.rsplit('.').next());
            field.is_some_and(|field| READ_FIELDS.contains(&field)) || *key == "._extra_state"
        };
        let skipped: Vec<&str> = self.fields.keys().copied().filter(|key| !is_read(key)).collect();
        if !skipped.is_empty() {
            reading.warn_skipped("entries of nre_data.state_dict", &skipped);
        }
    }

    /// The tracks of a layer; none for a static one.
    fn layer_tracks(&self, layer: &str) -> &'a [Value<'a>] {
        match self.tracks.get(layer) {
            Some(Value::Array(ids)) => ids,
            _ => &[],
        }
    }

    /// A layer of Gaussians.
    fn layer(&self, name: &'a str) -> Result<Layer<'_>, IngestError> {
        if let Some(settings) = self.settings.get(name) {
            settings::check(settings, name)?;
        }
        Ok(Layer { fields: &self.fields, name })
    }
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
        // Degree d has (d + 1)² coefficients, of which one is in `features_albedo`; each has 3
        // channels.
        let held = (0..=sh::MAX_DEGREE)
            .find(|&d| 3 * (sh::coefficients(d) - 1) == specular.columns)
            .ok_or_else(|| {
                let reason =
                    format!("{} columns; 0, 9, 24 or 45 make an SH degree", specular.columns);
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

    /// The index of each Gaussian's track, stored as i32 or i64.
    fn cuboid_ids(&self, rows: usize, tracks: usize) -> Result<Vec<i64>, IngestError> {
        let key = self.key("gaussian_cuboid_ids");
        let Some(Value::Bytes(bytes)) = self.fields.get(&*key) else {
            return Err(bad(&key, "is not an array of bytes".into()));
        };
        // The width is not recorded, so the number of bytes decides it.
        let ids: Vec<i64> = if bytes.len() == 4 * rows {
            bytes.as_chunks().0.iter().map(|id| i32::from_le_bytes(*id).into()).collect()
        } else if bytes.len() == 8 * rows {
            bytes.as_chunks().0.iter().map(|id| i64::from_le_bytes(*id)).collect()
        } else {
            let reason =
                format!("{} bytes, which is not the size of {rows} i32 or i64", bytes.len());
            return Err(bad(&key, reason));
        };
        // Negative ids mean no track, and pass.
        let beyond = ids.iter().find(|&&id| usize::try_from(id).is_ok_and(|id| id >= tracks));
        match beyond {
            Some(id) => Err(bad(&key, format!("{id} is a track; there are {tracks}"))),
            None => Ok(ids),
        }
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
        // In 128 bits, because the shape is untrusted and its product may not fit 64 bits.
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
        if self.is_f32 {
            f32::from_le_bytes(self.bytes.as_chunks().0[index])
        } else {
            f16::from_le_bytes(self.bytes.as_chunks().0[index]).to_f32()
        }
    }

    fn row<const N: usize>(&self, row: usize) -> [f32; N] {
        std::array::from_fn(|column| self.value(row, column))
    }
}

fn bad(place: &str, reason: String) -> IngestError {
    IngestError::Body { format: FORMAT, place: place.into(), reason }
}
