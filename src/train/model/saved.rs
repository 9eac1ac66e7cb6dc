//! The parameters and moments of a model, as a file has them.

use serde::ser::SerializeSeq;
use serde::{Deserialize, Serialize, Serializer};
use wildcity_scene::chunk::{LANES, Lanes};

/// The parameters and moments of a model, as a file has them: lane group by lane group.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct ModelState {
    pub(super) sh_degree: u8,
    pub(super) count: u64,
    pub(super) origin_m: [f64; 3],
    pub(super) values: Vec<f32>,
    pub(super) moments: [Vec<f32>; 2],
    pub(super) is_ground: Vec<bool>,
    pub(super) classes: Option<Vec<u8>>,
}

/// The same, as it is written: without a copy.
#[derive(Serialize)]
pub(crate) struct SavedModel<'a> {
    pub(super) sh_degree: u8,
    pub(super) count: u64,
    pub(super) origin_m: [f64; 3],
    pub(super) values: Flat<'a>,
    pub(super) moments: [Flat<'a>; 2],
    pub(super) is_ground: &'a [bool],
    pub(super) classes: Option<Vec<u8>>,
}

/// Lanes as one list of numbers.
pub(super) struct Flat<'a>(pub(super) &'a [Lanes]);

impl Serialize for Flat<'_> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let mut list = to.serialize_seq(Some(self.0.len() * LANES))?;
        let values = self.0.iter().flat_map(|Lanes(values)| values);
        values.into_iter().try_for_each(|value| list.serialize_element(value))?;
        list.end()
    }
}
