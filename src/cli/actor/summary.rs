//! The summary that `wildcity actor import` and `wildcity actor push` print of the asset that they
//! made.

use std::fmt;

use crate::cli::output;

/// An asset, in two lines.
pub(super) struct Summary<'a> {
    pub(super) name: &'a str,
    pub(super) class: &'a str,
    /// Length, width and height of its box, in metres.
    pub(super) size_m: [f64; 3],
    pub(super) gaussians: u64,
    pub(super) sh_degree: u8,
    pub(super) levels: usize,
    pub(super) bytes: u64,
    pub(super) hash: &'a str,
}

impl fmt::Display for Summary<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, class, size_m, gaussians, sh_degree, levels, bytes, hash } = self;
        let [length_m, width_m, height_m] = size_m;
        let megabytes = *bytes as f64 / 1e6;
        write!(f, "actor {name}: {class}, ")?;
        write!(f, "{length_m:.2} m long, {width_m:.2} m wide, {height_m:.2} m high; ")?;
        let levels = output::counted(*levels, "level");
        write!(f, "{gaussians} Gaussians of SH degree {sh_degree} in {levels} of detail, ")?;
        write!(f, "{megabytes:.1} MB\nblake3 {hash}")
    }
}
