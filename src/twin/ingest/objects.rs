//! Gaussians by the moving object that they belong to.

use std::collections::BTreeMap;

use wildcity_scene::Gaussians;

/// The Gaussians of one moving object.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackedObject {
    /// The track's name in the file, or its number.
    pub track: String,
    /// Its Gaussians, in the object's axes. Axes and unit are the file's.
    pub gaussians: Gaussians,
}

/// The Gaussians by their number, in order of numbers. Those without a name are left out.
pub(super) fn split(
    gaussians: &Gaussians,
    ids: &[i64],
    name: impl Fn(i64) -> Option<String>,
) -> Vec<TrackedObject> {
    let mut indices: BTreeMap<i64, Vec<usize>> = BTreeMap::new();
    for (index, &id) in ids.iter().enumerate() {
        indices.entry(id).or_default().push(index);
    }
    let object = |(id, indices): (i64, Vec<usize>)| {
        Some(TrackedObject { track: name(id)?, gaussians: gaussians.select(indices) })
    };
    indices.into_iter().filter_map(object).collect()
}
