//! Scores of driven episodes.
//!
//! Every score is a pure function of a [`DriveRecord`]: no renderer, no twin, no clock. Scores of
//! other projects are reproduced including their defects, and named after the project and its
//! commit. Our own, `wildcity.*@N`, are corrected versions. A score whose input is missing has a
//! reason in place of a value; it is never 0.
//!
//! | module | source |
//! |---|---|
//! | [`alpasim`], [`alpasim_plans`], [`alpasim_road`] | NVlabs/alpasim 3032e0c |
//! | [`navsim`] | autonomousvision/navsim 0a380a9, motional/nuplan-devkit e924167 |
//! | [`hugsim`] | hyzhou404/HUGSIM 62c690d |
//! | [`neuroncap`] | atonderski/neuro-ncap ecdcf28 |
//! | [`bench2drive`] | Thinklab-SJTU/Bench2Drive 7ec25d1 |
//! | [`own`] | the verdict of this project |
//! | [`statistics`] | rates and means over many episodes, with their confidence intervals |
//! | `record`, `plan` | the data of an episode that scores use |
//! | `map`, `polyline` | lanes and lines on the ground |
//! | `savgol` | the Savitzky-Golay filter of the comfort scores |

mod all;
pub mod alpasim;
mod alpasim_box;
pub mod alpasim_plans;
pub mod alpasim_road;
pub mod bench2drive;
pub mod hugsim;
mod map;
pub mod navsim;
pub mod neuroncap;
pub mod own;
mod plan;
mod polyline;
mod record;
mod savgol;
mod scored;
pub mod statistics;

pub use all::{lower_is_better, score, score_range};
pub use alpasim_box::RoundedBox;
pub use map::{Lane, LaneMap, RedArea};
pub use plan::{Plan, PlannedPose};
pub use polyline::Polyline;
pub use record::{
    DriveRecord, EgoSample, EgoShape, NO_MAP, NO_REFERENCE, ReferenceDrive, StaticContact, Track,
    TrackSample,
};
pub use savgol::savgol;
pub use scored::{Measured, Missing, Score};
