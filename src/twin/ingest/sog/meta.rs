//! meta.json in both versions, and tables that map the bytes of the images to values.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde::de::IgnoredAny;

use crate::ingest::activation;
use wildcity_scene::sh;

/// Keys of meta.json that are not read and have no effect on the picture.
const WITHOUT_EFFECT: [&str; 1] = ["asset"];

/// The keys of meta.json that are used.
#[derive(Deserialize)]
pub(super) struct Meta {
    /// How the scene was trained.
    pub(super) model: Option<String>,
    /// The same in the first text of the format: with anti-aliasing or without.
    pub(super) antialias: Option<bool>,
    version: Option<u32>,
    count: Option<u64>,
    pub(super) means: Means,
    pub(super) scales: Coded,
    pub(super) quats: Quats,
    pub(super) sh0: Coded,
    #[serde(rename = "shN")]
    pub(super) sh_n: Option<Higher>,
    #[serde(flatten)]
    others: BTreeMap<String, IgnoredAny>,
}

impl Meta {
    /// Names of the keys that are not read, but for those without an effect.
    pub(super) fn skipped(&self) -> impl Iterator<Item = &str> {
        let names = self.others.keys().map(String::as_str);
        names.filter(|name| !WITHOUT_EFFECT.contains(name))
    }
}

#[derive(Deserialize)]
pub(super) struct Means {
    shape: Option<Vec<u64>>,
    mins: [f64; 3],
    maxs: [f64; 3],
    /// Low and high bytes.
    pub(super) files: (String, String),
}

/// Scales or colours: version 1 has mins and maxs, version 2 a codebook.
#[derive(Deserialize)]
pub(super) struct Coded {
    mins: Option<Vec<f64>>,
    maxs: Option<Vec<f64>>,
    codebook: Option<Vec<f64>>,
    pub(super) files: (String,),
}

#[derive(Deserialize)]
pub(super) struct Quats {
    pub(super) files: (String,),
}

/// Colours of higher degrees.
#[derive(Deserialize)]
pub(super) struct Higher {
    count: Option<u64>,
    bands: Option<u8>,
    mins: Option<f64>,
    maxs: Option<f64>,
    codebook: Option<Vec<f64>>,
    pub(super) files: (String, String),
}

/// Maps from bytes to values.
pub(super) struct Tables {
    pub(super) count: u64,
    /// Smallest and largest value of each axis.
    pub(super) means: [[f64; 2]; 3],
    pub(super) scales: [[f32; 256]; 3],
    pub(super) colours: [[f32; 256]; 3],
    pub(super) logits: [f32; 256],
    pub(super) higher: Option<HigherTable>,
}

pub(super) struct HigherTable {
    pub(super) values: [f32; 256],
    /// Number of entries of the palette, if meta.json has it.
    pub(super) entries: Option<u64>,
    pub(super) bands: Option<u8>,
}

impl Tables {
    /// # Errors
    /// Says what is missing or wrong.
    pub(super) fn from_meta(meta: &Meta) -> Result<Self, String> {
        let means = std::array::from_fn(|axis| [meta.means.mins[axis], meta.means.maxs[axis]]);
        match meta.version {
            None => {
                let colours = ranged::<4>("sh0", &meta.sh0)?;
                let higher = meta.sh_n.as_ref().map(|higher| match (higher.mins, higher.maxs) {
                    (Some(least), Some(most)) => {
                        Ok(HigherTable { values: spread(least, most), entries: None, bands: None })
                    }
                    _ => Err("shN has no mins and maxs, as version 1 must".to_owned()),
                });
                let shape = meta.means.shape.as_deref();
                let count = *shape.and_then(<[u64]>::first).ok_or("means has no shape")?;
                let [r, g, b, logits] = colours;
                let scales = ranged::<3>("scales", &meta.scales)?;
                let colours = [r, g, b];
                Ok(Self { count, means, scales, colours, logits, higher: higher.transpose()? })
            }
            Some(2) => {
                let higher = meta.sh_n.as_ref().map(|higher| {
                    let bands = higher.bands.ok_or("shN has no bands")?;
                    if bands == 0 || bands > sh::MAX_DEGREE {
                        return Err(format!("shN has {bands} bands; 1 to 3 are read"));
                    }
                    Ok(HigherTable {
                        values: codebook("shN", &higher.codebook)?,
                        entries: Some(higher.count.ok_or("shN has no count")?),
                        bands: Some(bands),
                    })
                });
                Ok(Self {
                    count: meta.count.ok_or("there is no count")?,
                    means,
                    // All three axes share one codebook, and so do all three channels.
                    scales: [codebook("scales", &meta.scales.codebook)?; 3],
                    colours: [codebook("sh0", &meta.sh0.codebook)?; 3],
                    // Alpha is the opacity itself in this version.
                    logits: std::array::from_fn(|byte| activation::logit(byte as f64 / 255.0)),
                    higher: higher.transpose()?,
                })
            }
            Some(version) => Err(format!("version {version}; 2, and 1 without a number, are read")),
        }
    }
}

/// Version 1: bytes between mins and maxs.
fn ranged<const N: usize>(name: &str, coded: &Coded) -> Result<[[f32; 256]; N], String> {
    let bounds = coded.mins.as_deref().zip(coded.maxs.as_deref());
    match bounds {
        Some((mins, maxs)) if mins.len() == N && maxs.len() == N => {
            Ok(std::array::from_fn(|i| spread(mins[i], maxs[i])))
        }
        _ => Err(format!("{name} has no mins and maxs of {N} numbers, as version 1 must")),
    }
}

fn spread(least: f64, most: f64) -> [f32; 256] {
    std::array::from_fn(|byte| (least + (most - least) * (byte as f64 / 255.0)) as f32)
}

/// Version 2: a value per byte.
fn codebook(name: &str, values: &Option<Vec<f64>>) -> Result<[f32; 256], String> {
    let values = values.as_deref().unwrap_or_default();
    let values: Vec<f32> = values.iter().map(|&value| value as f32).collect();
    let count = values.len();
    values.try_into().map_err(|_| format!("{name} has a codebook of {count} values, not 256"))
}
