//! Assets of actors: Gaussians in levels of detail, with a box and a class. All placements of an
//! asset share it.

use std::sync::Arc;

use glam::DVec3;

use crate::geometry::{Bounds, Pose};
use crate::manifest::Provenance;
use crate::{Chunk, Gaussians, Scene, lod};

use super::{ActorBox, ActorClass};

/// The Gaussians from which all actors of one kind are rendered.
#[derive(Clone, Debug)]
pub struct ActorAsset {
    pub description: AssetDescription,
    /// The levels of detail: level 0 without error, then fewer and fewer Gaussians with rising
    /// errors.
    pub levels: Vec<AssetLevel>,
}

/// The description of an asset: everything except its Gaussians.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AssetDescription {
    /// A readable name, `[a-z0-9._-]+`. Several assets may have one name; the hash is the identity.
    pub name: String,
    pub class: ActorClass,
    #[serde(rename = "box")]
    pub box_: ActorBox,
    /// The source from which it was made.
    pub provenance: Provenance,
}

/// One level of detail of an asset.
#[derive(Clone, Debug)]
pub struct AssetLevel {
    /// Upper bound of the geometric error, in metres, as in [`lod::Level::error_m`].
    pub error_m: f32,
    /// The Gaussians in the actor's axes, with the actor's origin.
    pub chunk: Arc<Chunk>,
}

/// Why Gaussians cannot become an asset.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AssetError {
    /// There are none, or more than [`ActorAsset::MOST_GAUSSIANS`].
    #[error("{count} Gaussians; an actor has from 1 to {most}", most = ActorAsset::MOST_GAUSSIANS)]
    Count { count: usize },
    /// A Gaussian lies farther from the origin than a box may reach.
    #[error(
        "Gaussian {index} is {distance_m:.1} m from the actor's origin; at most {most:.0} m are possible: check the \
         axes and the scale",
        most = ActorAsset::FARTHEST_M
    )]
    TooFar {
        index: usize,
        /// Its distance, in metres.
        distance_m: f64,
    },
}

/// A camera that sees an actor: its centre in the world in metres, and its longer focal length in
/// pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActorViewpoint {
    /// The camera's centre in the world, in metres.
    pub position_m: DVec3,
    /// The larger of its two focal lengths, in pixels.
    pub focal_px: f64,
}

impl ActorAsset {
    /// Most Gaussians of level 0: ten times as many as a detailed car has.
    pub const MOST_GAUSSIANS: usize = 2_000_000;

    /// Farthest that a Gaussian's centre may be from the actor's origin, in metres.
    pub const FARTHEST_M: f64 = 2.0 * ActorBox::MOST_M;

    /// Makes an asset from Gaussians in the actor's axes.
    ///
    /// # Errors
    /// There are none, or too many, or one is too far away.
    pub fn new(gaussians: &Gaussians, description: AssetDescription) -> Result<Self, AssetError> {
        let count = gaussians.len();
        if !(1..=Self::MOST_GAUSSIANS).contains(&count) {
            return Err(AssetError::Count { count });
        }
        let distances_m =
            gaussians.means_m.iter().map(|&mean_m| DVec3::from_array(mean_m).length());
        let too_far = distances_m.enumerate().find(|(_, distance_m)| {
            // Written as a negation, because a NaN distance is not near: `distance > FARTHEST_M`
            // would accept it.
            let near = *distance_m <= Self::FARTHEST_M;
            !near
        });
        if let Some((index, distance_m)) = too_far {
            return Err(AssetError::TooFar { index, distance_m });
        }
        let full = Scene::single_chunk(gaussians);
        // `lod::levels` returns only the coarser levels, with rising errors. The full chunk goes to
        // the front, so that errors rise over the whole list and `level` can search from the back.
        let coarser = lod::levels(&full)
            .map(|lod::Level { error_m, chunk }| AssetLevel { error_m, chunk: Arc::new(chunk) });
        let mut levels: Vec<AssetLevel> = coarser.collect();
        levels.insert(0, AssetLevel { error_m: 0.0, chunk: Arc::new(full) });
        Ok(Self { description, levels })
    }

    /// The box around the centres of some Gaussians, with its origin: what [`ActorBox`] is for
    /// Gaussians whose origin is on the ground under the box's centre.
    pub fn bounds(gaussians: &Gaussians) -> Bounds {
        let mut bounds = Bounds::EMPTY;
        for &mean_m in &gaussians.means_m {
            bounds.add(DVec3::from_array(mean_m), DVec3::ZERO);
        }
        bounds
    }

    /// Memory of all levels, in bytes.
    pub fn bytes(&self) -> u64 {
        self.levels.iter().map(|level| level.chunk.bytes() as u64).sum()
    }

    /// The level with which a view draws an actor: the coarsest one with an error of at most
    /// `tau_px` pixels at the distance of the camera from the actor's box, as for the blocks of a
    /// twin. `None` for an actor that is beyond the profile's `reach_m`.
    pub fn level(
        &self,
        world_from_actor: &Pose,
        viewpoint: &ActorViewpoint,
        tau_px: f64,
        reach_m: Option<f64>,
    ) -> Option<&Arc<Chunk>> {
        // The box in the actor's axes: its origin is on the ground under the centre, so that z is
        // from 0 to the height.
        let ActorBox { length_m, width_m, height_m } = self.description.box_;
        let half_m = 0.5 * DVec3::new(length_m, width_m, height_m);
        let bounds = Bounds {
            min_m: half_m * DVec3::new(-1.0, -1.0, 0.0),
            max_m: half_m * DVec3::new(1.0, 1.0, 2.0),
        };
        let ActorViewpoint { position_m, focal_px } = *viewpoint;
        let from_actor_m = position_m - world_from_actor.position_m;
        let distance_m = bounds.distance_m(world_from_actor.rotation.inverse() * from_actor_m);
        let within_reach = reach_m.is_none_or(|reach_m| distance_m <= reach_m);
        // An error of e metres at d metres is f e / d pixels. Multiplied by d, the test holds for a
        // camera inside the box (d = 0): there only the level with an error of 0 passes.
        let small =
            |level: &&AssetLevel| focal_px * f64::from(level.error_m) <= tau_px * distance_m;
        // Errors rise, so that the last level that passes is the coarsest one. The first level
        // stands in where none passes, such as for a NaN distance.
        let level = self.levels.iter().rfind(small).or(self.levels.first());
        level.filter(|_| within_reach).map(|level| &level.chunk)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chunk::RawGaussian;

    fn ball(count: usize) -> Gaussians {
        let mut gaussians = Gaussians::with_capacity(0, count);
        for i in 0..count {
            let at = |k: usize| (i * k % 97) as f64 / 97.0;
            gaussians.means_m.push([4.0 * at(31) - 2.0, 1.8 * at(57) - 0.9, 1.5 * at(71)]);
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.ln_scales.push([-4.0; 3]);
            gaussians.logit_opacities.push(3.0);
            gaussians.sh.extend([0.2; 3]);
        }
        gaussians
    }

    fn description() -> AssetDescription {
        AssetDescription {
            name: "ball".to_owned(),
            class: ActorClass::Object,
            box_: ActorBox { length_m: 4.0, width_m: 1.8, height_m: 1.5 },
            provenance: Provenance::new("test".to_owned()),
        }
    }

    #[test]
    fn farther_actors_have_fewer_gaussians_and_none_beyond_reach() {
        let asset = ActorAsset::new(&ball(20_000), description()).unwrap();
        assert!(asset.levels.len() > 3, "{} levels", asset.levels.len());
        let at = Pose { position_m: DVec3::new(100.0, 0.0, 0.0), ..Pose::IDENTITY };
        let count = |distance_m: f64, reach_m| {
            // The face of the box is 2 m in front of the origin, and 1 m is a height within the
            // box: the distance to the box is exactly `distance_m`.
            let position_m = at.position_m - DVec3::new(2.0 + distance_m, 0.0, -1.0);
            let viewpoint = ActorViewpoint { position_m, focal_px: 1000.0 };
            asset.level(&at, &viewpoint, 1.0, reach_m).map(|chunk| chunk.len())
        };
        assert_eq!(count(0.0, None), Some(20_000));
        let counts = [0.0, 5.0, 50.0, 500.0, 5000.0].map(|m| count(m, None).unwrap());
        assert!(counts.is_sorted_by(|a, b| a >= b) && counts[4] * 10 < counts[0], "{counts:?}");
        assert_eq!(count(50.1, Some(50.0)), None);
        assert_eq!(count(49.9, Some(50.0)), count(49.9, None));
        // Without an error: all of it, however far.
        let far = ActorViewpoint { position_m: DVec3::X * 1e4, focal_px: 1.0 };
        assert_eq!(asset.level(&at, &far, 0.0, None).map(|chunk| chunk.len()), Some(20_000));
    }

    #[test]
    fn what_is_no_actor_is_refused() {
        let refused =
            |gaussians: &Gaussians| ActorAsset::new(gaussians, description()).unwrap_err();
        assert_eq!(refused(&Gaussians::default()), AssetError::Count { count: 0 });
        let mut far = ball(3);
        far.means_m[1][0] = 300.0;
        assert!(matches!(refused(&far), AssetError::TooFar { index: 1, .. }));
        far.means_m[1][0] = f64::NAN;
        assert!(matches!(refused(&far), AssetError::TooFar { index: 1, .. }));
    }

    /// An asset is one chunk, also where it crosses the edges of cells and blocks.
    #[test]
    fn an_asset_is_one_chunk_around_its_origin() {
        let mut wide = ball(5_000);
        // 4 m times 20 is 80 m: more than one cell of 64 m.
        wide.means_m.iter_mut().for_each(|m| m[0] *= 20.0);
        let asset = ActorAsset::new(&wide, description()).unwrap();
        assert_eq!(asset.levels[0].chunk.len(), 5_000);
        assert_eq!(asset.levels[0].chunk.origin_m(), DVec3::ZERO);
        let chunk = Scene::single_chunk(&wide);
        let mut one = Chunk::new([0, 0], DVec3::ZERO, 0, 1);
        one.push(&RawGaussian {
            mean_m: wide.means_m[0].map(|m| m as f32),
            quat_wxyz: wide.quats_wxyz[0],
            ln_scale: wide.ln_scales[0],
            logit_opacity: wide.logit_opacities[0],
            sh: wide.sh_at(0),
        });
        let row = |chunk: &Chunk, i: usize| [0, 3, 6, 10, 11].map(|column| chunk.value(i, column));
        let found = (0..chunk.len()).filter(|&i| row(&chunk, i) == row(&one, 0)).count();
        assert!(found >= 1, "the first Gaussian is there, unchanged");
    }
}
