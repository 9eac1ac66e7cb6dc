//! safetensors with the names of a gsplat checkpoint.
//!
//! means [N,3], quats [N,4] (w, x, y, z), scales [N,3] (ln), opacities [N] (logit), sh0 [N,1,3] and
//! shN [N,K,3], or both in one as coeffs [N,1+K,3]. F32 throughout; means may be F64. A tensor
//! semantic_class [N] of U8 has values of [`SemanticClass`]. Tensors of other names are named in a
//! warning, but for those of a sky.

use std::io::{self, Read};

use ::safetensors::Dtype;
use ::safetensors::tensor::{Metadata, TensorInfo};

use crate::limits;
use wildcity_scene::{Gaussians, SemanticClass, sh};

use super::notes::Reading;
use super::validate::{self, Field};
use super::{IngestError, Progress, check_count, classes};

/// Reads a safetensors file of a known size, from front to back.
pub(super) fn read(
    mut input: impl Read,
    file_bytes: u64,
    reading: &mut Reading,
    progress: Progress<'_>,
) -> Result<Gaussians, IngestError> {
    let (metadata, body_start) = read_metadata(&mut input, file_bytes)?;
    let plan = ReadPlan::from_metadata(&metadata)?;
    if metadata.info(POINT_IDS).is_some() {
        reading.warn(format!(
            "tensor {POINT_IDS}: these are tracked objects, each in its own axes, and lie in each other at the origin; \
             `wildcity actor import --tracked` makes an asset of each"
        ));
    }
    let skipped = plan.skipped(&metadata);
    if !skipped.is_empty() {
        reading.warn_skipped("tensors", &skipped.iter().map(String::as_str).collect::<Vec<_>>());
    }
    let one_tensor = plan.one_tensor;
    let gaussians = read_tensors(input, body_start, file_bytes, plan, progress)?;
    reading.accept(gaussians, &|field| file_name(field, one_tensor))
}

/// Reads the tensors of a plan, from front to back. The Gaussians are not checked.
fn read_tensors(
    input: impl Read,
    body_start: u64,
    file_bytes: u64,
    mut plan: ReadPlan<'_>,
    progress: Progress<'_>,
) -> Result<Gaussians, IngestError> {
    let coefficients = sh::coefficients(plan.sh_degree);
    let mut gaussians = Gaussians::with_capacity(plan.sh_degree, plan.count);
    // Colours may come in two tensors, which each fill a part of every row: the rows exist before.
    gaussians.sh.resize(3 * coefficients * plan.count, 0.0);
    let mut body = Body { input, body_start, done: body_start, file_bytes, progress };

    // The file is read once from front to back, so tensors are taken in the order of their bytes.
    plan.tensors.sort_by_key(|(_, tensor)| tensor.data_offsets);
    for (column, tensor) in plan.tensors {
        let g = &mut gaussians;
        match column {
            Column::Means => body.rows(tensor, |row| g.means_m.push(row))?,
            Column::Quats => body.rows(tensor, |row| g.quats_wxyz.push(row.map(|q| q as f32)))?,
            Column::Scales => body.rows(tensor, |row| g.ln_scales.push(row.map(|s| s as f32)))?,
            Column::Opacities => body.rows(tensor, |[o]| g.logit_opacities.push(o as f32))?,
            Column::Classes => g.classes = Some(body.classes(tensor)?),
            // Coefficient `first` to `first + of_tensor - 1` of each Gaussian, as in memory.
            Column::Colours { first } => {
                let of_tensor = tensor.shape[1];
                let mut row = 0;
                body.rows(tensor, |rgb: [f64; 3]| {
                    // Row r of the tensor has its coefficient r mod K of Gaussian r / K. K is
                    // `of_tensor`, and not the number of coefficients in memory.
                    let at = 3 * (row / of_tensor * coefficients + first + row % of_tensor);
                    g.sh[at..at + 3].copy_from_slice(&rgb.map(|c| c as f32));
                    row += 1;
                })?;
            }
        }
    }
    (body.progress)(file_bytes, file_bytes);
    Ok(gaussians)
}

/// Reads Gaussians with the number of the object that each belongs to: the tensor `point_ids`, [N]
/// or [N,1], I32 or I64.
pub(super) fn read_tracked(
    input: &mut impl Read,
    file_bytes: u64,
    progress: Progress<'_>,
) -> Result<(Gaussians, Vec<i64>), IngestError> {
    // Tensors may be in any order, so the whole file is held, as that of a scene in parts.
    let mut bytes = Vec::new();
    // The limit bounds the memory. A longer file fails below, as one that was cut.
    input.take(limits::SCENE_PART_BYTES).read_to_end(&mut bytes)?;
    let mut file = &bytes[..];
    let (metadata, body_start) = read_metadata(&mut file, file_bytes)?;
    let plan = ReadPlan::from_metadata(&metadata)?;
    let one_tensor = plan.one_tensor;
    let mut gaussians = read_tensors(file, body_start, file_bytes, plan, progress)?;
    gaussians.clamp_activations();
    validate::check(&gaussians, &|field| file_name(field, one_tensor))?;
    let place = "tensor point_ids";
    let info = metadata.info(POINT_IDS).ok_or_else(|| bad(place, "is missing".into()))?;
    let (start, end) = info.data_offsets;
    let body = bytes
        .get(body_start as usize + start..body_start as usize + end)
        .ok_or_else(|| bad(place, "reaches beyond the file".into()))?;
    let ids: Vec<i64> = match info.dtype {
        Dtype::I32 => body.as_chunks().0.iter().map(|id| i32::from_le_bytes(*id).into()).collect(),
        Dtype::I64 => body.as_chunks().0.iter().map(|id| i64::from_le_bytes(*id)).collect(),
        other => return Err(bad(place, format!("is {other:?}; I32 or I64 is read"))),
    };
    if ids.len() != gaussians.len() {
        let reason = format!("has {} numbers for {} Gaussians", ids.len(), gaussians.len());
        return Err(bad(place, reason));
    }
    Ok((gaussians, ids))
}

/// Reads the header and checks it against the size of the file. Offsets and shapes were checked
/// against each other by the crate.
fn read_metadata(input: &mut impl Read, file_bytes: u64) -> Result<(Metadata, u64), IngestError> {
    let mut length = [0; 8];
    input.read_exact(&mut length)?;
    let length = u64::from_le_bytes(length);
    let limit = limits::SAFETENSORS_HEADER_BYTES as u64;
    // Checked before allocating, because the length is untrusted.
    if length > limit {
        return Err(bad("length", format!("{length} bytes; at most {limit} are read")));
    }
    let mut header = vec![0; length as usize];
    // The only cause besides a broken disk is a file that ends within its header.
    if input.read_exact(&mut header).is_err() {
        return Err(bad("length", format!("{length} bytes do not fit a file of {file_bytes}")));
    }
    let metadata: Metadata =
        serde_json::from_slice(&header).map_err(|e| bad("JSON", e.to_string()))?;
    let promised = metadata.data_len() as u128;
    let held = u128::from(file_bytes.saturating_sub(8 + length));
    if promised != held {
        let content = format!("{} tensors", metadata.offset_keys().len());
        return Err(IngestError::Size { format: "safetensors", promised, held, content });
    }
    Ok((metadata, 8 + length))
}

/// The tensors to read. Their shapes match.
struct ReadPlan<'a> {
    count: usize,
    sh_degree: u8,
    tensors: Vec<(Column, &'a TensorInfo)>,
    /// Whether all colours are in the tensor coeffs.
    one_tensor: bool,
}

/// Prefix of the tensors of a sky, which `--sky` reads, and the name of another one.
const SKY_PREFIX: &str = "sky_head.";
const OF_SKY: &str = "appearance_embedding.weight";
/// The tensor with the object of each Gaussian.
const POINT_IDS: &str = "point_ids";

/// The column of Gaussians that a tensor is read into.
enum Column {
    Means,
    Quats,
    Scales,
    Opacities,
    Classes,
    /// SH coefficients, from `first` on.
    Colours {
        first: usize,
    },
}

impl<'a> ReadPlan<'a> {
    fn from_metadata(metadata: &'a Metadata) -> Result<Self, IngestError> {
        let find = |name: &str| {
            let missing = || bad(&format!("tensor {name}"), "is missing".into());
            metadata.info(name).ok_or_else(missing)
        };
        let shaped = |name: &str, wanted: &[Option<usize>]| {
            let info = find(name)?;
            let kinds: &[Dtype] = match name {
                "means" => &[Dtype::F32, Dtype::F64],
                classes::NAME => &[Dtype::U8],
                _ => &[Dtype::F32],
            };
            if !kinds.contains(&info.dtype) {
                let kinds: Vec<_> = kinds.iter().map(|kind| format!("{kind:?}")).collect();
                let wanted = kinds.join(" or ");
                let reason = format!("is {:?}; {wanted} is read", info.dtype);
                return Err(bad(&format!("tensor {name}"), reason));
            }
            let fits = info.shape.len() == wanted.len()
                && info.shape.iter().zip(wanted).all(|(&d, w)| w.is_none_or(|w| w == d));
            if !fits {
                let any = |w: &Option<usize>| w.map_or("any".into(), |w| w.to_string());
                let wanted: Vec<_> = wanted.iter().map(any).collect();
                let reason = format!("has shape {:?}, not [{}]", info.shape, wanted.join(", "));
                return Err(bad(&format!("tensor {name}"), reason));
            }
            Ok(info)
        };
        let means = shaped("means", &[None, Some(3)])?;
        let n = Some(means.shape[0]);
        // With both, sh0 is read, and coeffs is named among the tensors that are skipped.
        let one_tensor = metadata.info("sh0").is_none() && metadata.info("coeffs").is_some();
        let colours = if one_tensor {
            vec![shaped("coeffs", &[n, None, Some(3)])?]
        } else {
            let mut colours = vec![shaped("sh0", &[n, Some(1), Some(3)])?];
            // Without shN the scene is of degree 0.
            if metadata.info("shN").is_some() {
                colours.push(shaped("shN", &[n, None, Some(3)])?);
            }
            colours
        };
        // Saturating, because a shape with a zero may have any other dimension.
        let coefficients = colours.iter().fold(0, |sum: usize, c| sum.saturating_add(c.shape[1]));
        let sh_degree = (0..=sh::MAX_DEGREE)
            .find(|&d| sh::coefficients(d) == coefficients)
            .ok_or_else(|| {
                let (name, before) = if one_tensor { ("coeffs", 0) } else { ("shN", 1) };
                let allowed = [1, 4, 9, 16].map(|k: usize| (k - before).to_string()).join(", ");
                let reason = format!("has {} coefficients, not {allowed}", coefficients - before);
                bad(&format!("tensor {name}"), reason)
            })?;
        let mut tensors = vec![
            (Column::Means, means),
            (Column::Quats, shaped("quats", &[n, Some(4)])?),
            (Column::Scales, shaped("scales", &[n, Some(3)])?),
            (Column::Opacities, shaped("opacities", &[n])?),
        ];
        if metadata.info(classes::NAME).is_some() {
            tensors.push((Column::Classes, shaped(classes::NAME, &[n])?));
        }
        // coeffs and sh0 start at coefficient 0, shN at 1.
        let colours = colours.into_iter().enumerate();
        tensors.extend(colours.map(|(first, tensor)| (Column::Colours { first }, tensor)));
        Ok(Self { count: check_count(means.shape[0] as u64)?, sh_degree, tensors, one_tensor })
    }

    /// Names of the tensors that no reader of this program reads.
    fn skipped(&self, metadata: &Metadata) -> Vec<String> {
        let is_read = |name: &str| {
            let info = metadata.info(name);
            // By identity and not by name: the plan holds references into the same metadata.
            info.is_some_and(|info| self.tensors.iter().any(|(_, read)| std::ptr::eq(*read, info)))
        };
        let is_skipped =
            |name: &String| !is_read(name) && !name.starts_with(SKY_PREFIX) && name != OF_SKY;
        metadata.offset_keys().into_iter().filter(is_skipped).collect()
    }
}

/// The bytes after the header.
struct Body<'a, R> {
    input: R,
    body_start: u64,
    /// Bytes of the file that have been read.
    done: u64,
    file_bytes: u64,
    progress: Progress<'a>,
}

impl<R: Read> Body<'_, R> {
    /// Calls `take` with each row of `N` numbers of a tensor. Tensors do not overlap, so it starts
    /// no earlier than the previous one ended; what lies between is skipped.
    fn rows<const N: usize>(
        &mut self,
        tensor: &TensorInfo,
        mut take: impl FnMut([f64; N]),
    ) -> Result<(), IngestError> {
        let (start, end) = tensor.data_offsets;
        // The input may be hashed as it is read, so that what lies between is read and dropped.
        let between = (self.body_start + start as u64).saturating_sub(self.done);
        self.done += io::copy(&mut (&mut self.input).take(between), &mut io::sink())?;
        let is_f64 = tensor.dtype == Dtype::F64;
        let is_byte = tensor.dtype == Dtype::U8;
        let bytes_each = if is_f64 {
            8
        } else if is_byte {
            1
        } else {
            4
        };
        let mut row = vec![0; N * bytes_each];
        for index in 0..(end - start) / row.len() {
            self.input.read_exact(&mut row)?;
            let doubles = row.as_chunks::<8>().0;
            let singles = row.as_chunks::<4>().0;
            take(std::array::from_fn(|i| {
                if is_f64 {
                    f64::from_le_bytes(doubles[i])
                } else if is_byte {
                    row[i].into()
                } else {
                    f32::from_le_bytes(singles[i]).into()
                }
            }));
            self.done += row.len() as u64;
            if index.is_multiple_of(REPORT_EVERY) {
                (self.progress)(self.done, self.file_bytes);
            }
        }
        (self.progress)(self.done, self.file_bytes);
        Ok(())
    }

    /// Reads a tensor of classes.
    fn classes(&mut self, tensor: &TensorInfo) -> Result<Vec<SemanticClass>, IngestError> {
        let mut all = Vec::new();
        // `rows` cannot be stopped, so it goes on after a fault. The first one is reported.
        let mut faulty = None;
        self.rows(tensor, |[value]| {
            all.push(classes::class(value).unwrap_or_else(|reason| {
                // `all` does not yet hold this row, so its length is the row's index.
                faulty.get_or_insert((all.len(), reason));
                SemanticClass::Unlabelled
            }));
        })?;
        match faulty {
            None => Ok(all),
            Some((row, reason)) => Err(IngestError::Body {
                format: "safetensors",
                place: format!("row {row} of tensor {}", classes::NAME),
                reason,
            }),
        }
    }
}

/// Rows between two reports of progress.
const REPORT_EVERY: usize = 65_536;

/// The name of a field in a safetensors file.
fn file_name(field: Field, one_tensor: bool) -> String {
    match field {
        Field::Mean(axis) => format!("means[{axis}]"),
        Field::Quat(i) => format!("quats[{i}]"),
        Field::QuatLength => "length of quats".into(),
        Field::Scale(axis) => format!("scales[{axis}]"),
        Field::Opacity => "opacities".into(),
        Field::Sh(k, channel) if one_tensor => format!("coeffs[{k}][{channel}]"),
        Field::Sh(0, channel) => format!("sh0[0][{channel}]"),
        Field::Sh(k, channel) => format!("shN[{}][{channel}]", k - 1),
    }
}

fn bad(place: &str, reason: String) -> IngestError {
    IngestError::Header { format: "safetensors", place: place.into(), reason }
}
