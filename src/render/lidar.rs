//! LiDAR sweeps: what the beams of a LiDAR hit.
//!
//! **A return is where a beam has lost half of its light.** A Gaussian's alpha on a beam is its
//! response at the point of the beam that is closest in standard deviations (Wu et al. 2024,
//! 3DGUT), at most the profile's cap, and 0 below its cut or 1/255. Gaussians are blended in the
//! order of these points. The range is the distance to that of the Gaussian with which the
//! transmittance falls to a half or less. It is not the mean depth, which lies between two surfaces
//! where a beam grazes the nearer one. A beam that no Gaussian brings to a half has no return.
//!
//! Unlike an image, a sweep has no splats: a flat Gaussian on a road that is 1 m long is hit over
//! all of its length, and the distance of its centre would be up to 1 m off. So every beam is
//! compared with the Gaussian itself, and no blur is added: beams are thin.
//!
//! **Every column has its own time.** Its beams start where the LiDAR is then, and see actors where
//! those are then ([`Lidar::fraction`]). So a sweep of a moving LiDAR is skewed, as a real one.
//!
//! **Intensity** is the mean luminance (ITU-R BT.709) of the Gaussians that a return is made of,
//! weighted by what each contributes, without the parts of the colour that depend on the direction:
//! a twin that is trained on images knows nothing of infrared light.
//!
//! The reference backend computes this in f64, each beam against each Gaussian; `cpu::lidar` and
//! `gpu::lidar` say how the others do.

use std::sync::Arc;

use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::chunk::column;
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::lidar::Lidar;
use wildcity_scene::{Chunk, RenderProfile, Scene, SemanticClass, sh};

use crate::{FIRST_ACTOR_INSTANCE, RenderError, TWIN_INSTANCE, gaussian_class};

/// The transmittance at which a beam returns.
pub(crate) const HALF: f64 = 0.5;

/// Shortest standard deviation that a beam can tell from 0, in metres. It keeps f32 from
/// overflowing; nothing in a city is as thin.
pub(crate) const THINNEST_M: f64 = 1e-7;

/// A LiDAR with its motion during a sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct LidarView {
    pub lidar: Arc<Lidar>,
    /// The LiDAR's pose at the sweep's time, when its last column is fired.
    pub world_from_lidar: Pose,
    /// Its pose a sweep earlier, when the last column of the previous sweep was fired.
    pub world_from_lidar_first: Pose,
}

/// The returns of a sweep, each `[rows, columns]`, row by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sweep {
    /// Distance along the beam, in metres; 0 without a return.
    pub range_m: Vec<f32>,
    /// Mean luminance of what is hit, from 0 up; 0 without a return.
    pub intensity: Vec<f32>,
    /// The owner of what is hit, as in [`Target::instances`](crate::Target::instances).
    pub instance: Vec<u16>,
    /// What is hit: the number of the Gaussian among all of the scene's, in the order of its chunks
    /// and then those of its actors; 0 without a return.
    pub gaussian: Vec<u32>,
}

impl Sweep {
    /// Bytes of a beam.
    pub(crate) const BEAM_BYTES: usize = 4 + 4 + 2 + 4;

    pub(crate) fn empty(beams: usize) -> Self {
        Self {
            range_m: vec![0.0; beams],
            intensity: vec![0.0; beams],
            instance: vec![0; beams],
            gaussian: vec![0; beams],
        }
    }

    /// The class of what each beam hits in the scene that the sweep is of, as in
    /// [`Target::semantics`](crate::Target::semantics).
    ///
    /// # Errors
    /// The scene has 2^32 Gaussians or more.
    pub fn classes(&self, scene: &Scene) -> Result<Vec<SemanticClass>, RenderError> {
        let keys = Keys::new(scene)?;
        let chunks: Vec<(Body<'_>, &Chunk)> = chunks(scene).collect();
        let class = |(range_m, key): (&f32, &u32)| {
            if *range_m == 0.0 {
                return SemanticClass::None;
            }
            let number = keys.chunk(*key);
            let (body, chunk) = chunks[number];
            let default = body.placed.map_or(SemanticClass::Unlabelled, |placed| placed.class);
            gaussian_class(chunk, (key - keys.first(number)) as usize, default)
        };
        Ok(self.range_m.iter().zip(&self.gaussian).map(class).collect())
    }
}

impl LidarView {
    /// A LiDAR at rest.
    pub fn at_rest(lidar: Arc<Lidar>, world_from_lidar: Pose) -> Self {
        Self { lidar, world_from_lidar, world_from_lidar_first: world_from_lidar }
    }

    /// The LiDAR's pose when a column is fired.
    pub fn world_from_lidar_at(&self, column: usize) -> Pose {
        let fraction = self.lidar.fraction(column);
        self.world_from_lidar_first.interpolate(&self.world_from_lidar, fraction)
    }
}

/// Gaussians that move together: the twin, or an actor.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Body<'a> {
    /// `None` for the twin, whose axes are the world's.
    pub(crate) placed: Option<&'a PlacedChunk>,
    pub(crate) instance: u16,
}

impl Body<'_> {
    /// Factors of its colours.
    pub(crate) fn tint(&self) -> [f32; 3] {
        self.placed.map_or([1.0; 3], |placed| placed.tint)
    }

    /// Whether two chunks move together.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        match (self.placed, other.placed) {
            (None, None) => true,
            // Each placed chunk is a body of its own, even if two have the same pose.
            (Some(one), Some(other)) => std::ptr::eq(one, other),
            _ => false,
        }
    }

    /// The LiDAR's pose in the body's axes when a column is fired.
    pub(crate) fn body_from_lidar(&self, view: &LidarView, column: usize) -> Pose {
        let world_from_lidar = view.world_from_lidar_at(column);
        let Some(placed) = self.placed else { return world_from_lidar };
        let world_from_body = placed
            .world_from_actor_at_start
            .interpolate(&placed.world_from_actor, view.lidar.fraction(column));
        // The difference of positions first: both may be thousands of kilometres from the origin.
        let body_from_world = world_from_body.rotation.inverse();
        Pose {
            position_m: body_from_world
                * (world_from_lidar.position_m - world_from_body.position_m),
            rotation: body_from_world * world_from_lidar.rotation,
        }
    }
}

/// The chunks of a scene with their bodies, in order of global ids.
pub(crate) fn chunks(scene: &Scene) -> impl Iterator<Item = (Body<'_>, &Chunk)> {
    let twin = Body { placed: None, instance: TWIN_INSTANCE };
    let of_twin = scene.chunks.iter().map(move |chunk| (twin, &**chunk));
    let of_actors = scene.placed.iter().map(|placed| {
        let instance = FIRST_ACTOR_INSTANCE + placed.actor;
        (Body { placed: Some(placed), instance }, &*placed.chunk)
    });
    of_twin.chain(of_actors)
}

/// The places of Gaussians among all of a scene, by which those at the same range are ordered.
#[derive(Debug)]
pub(crate) struct Keys {
    /// That of the first Gaussian of each chunk.
    firsts: Vec<u32>,
    /// The key of the first Gaussian of each owner, and the owner as in [`Sweep::instance`].
    owners: Vec<(u32, u16)>,
}

impl Keys {
    /// # Errors
    /// The scene has 2^32 Gaussians or more.
    pub(crate) fn new(scene: &Scene) -> Result<Self, RenderError> {
        let mut keys = Self { firsts: Vec::new(), owners: Vec::new() };
        let mut next = 0_u32;
        for (body, chunk) in chunks(scene) {
            keys.firsts.push(next);
            if keys.owners.last().is_none_or(|(_, owner)| *owner != body.instance) {
                keys.owners.push((next, body.instance));
            }
            let after = u32::try_from(chunk.len()).ok().and_then(|len| next.checked_add(len));
            let limit = u64::from(u32::MAX);
            let what = "Gaussians in a scene with LiDARs";
            next = after.ok_or(RenderError::TooMany { what, limit })?;
        }
        Ok(keys)
    }

    /// The key of the first Gaussian of a chunk, which is given by its number in the scene.
    pub(crate) fn first(&self, chunk: usize) -> u32 {
        self.firsts[chunk]
    }

    /// The number of a Gaussian's chunk.
    fn chunk(&self, key: u32) -> usize {
        // The last one that begins at the key or before; empty ones begin where the next one does.
        self.firsts.partition_point(|first| *first <= key).saturating_sub(1)
    }

    /// The owner of a Gaussian.
    pub(crate) fn instance(&self, key: u32) -> u16 {
        // The last one that begins at the key or before; an empty one begins where the next does.
        let after = self.owners.partition_point(|(first, _)| *first <= key);
        self.owners[after.saturating_sub(1)].1
    }
}

/// What a sweep is computed of.
pub(crate) struct Task<'a> {
    pub(crate) profile: &'a RenderProfile,
    pub(crate) view: &'a LidarView,
    pub(crate) bodies: Vec<ChunksOfBody<'a>>,
    pub(crate) keys: Keys,
}

impl<'a> Task<'a> {
    /// # Errors
    /// The scene has 2^32 Gaussians or more.
    pub(crate) fn new(
        scene: &'a Scene,
        profile: &'a RenderProfile,
        view: &'a LidarView,
    ) -> Result<Self, RenderError> {
        Ok(Self { profile, view, bodies: by_body(scene), keys: Keys::new(scene)? })
    }
}

/// The chunks of a body, one at least, with their numbers in the scene.
pub(crate) type ChunksOfBody<'a> = Vec<(usize, Body<'a>, &'a Chunk)>;

/// The chunks of each body.
fn by_body(scene: &Scene) -> Vec<ChunksOfBody<'_>> {
    let mut bodies: Vec<ChunksOfBody<'_>> = Vec::new();
    for (number, (body, chunk)) in chunks(scene).enumerate() {
        match bodies.last_mut() {
            // The chunks of the twin come first, one after the other.
            Some(last) if last[0].1.is_same(&body) => last.push((number, body, chunk)),
            _ => bodies.push(vec![(number, body, chunk)]),
        }
    }
    bodies
}

/// Shares of red, green and blue in luminance (ITU-R BT.709).
pub(crate) const LUMINANCE: [f32; 3] = [0.2126, 0.7152, 0.0722];

/// The luminance of a Gaussian's colour, without the parts that depend on the direction; `value`
/// returns a column of it.
pub(crate) fn luminance(body: &Body<'_>, value: impl Fn(usize) -> f32) -> f32 {
    let tint = body.tint();
    let channel = |c: usize| tint[c] * (sh::C0 as f32 * value(column::SH + c) + 0.5).max(0.0);
    (0..3).map(|c| LUMINANCE[c] * channel(c)).sum()
}

/// The least alpha that counts: the profile's cut, but at least 1/255, which bounds the hits of a
/// beam ([`MOST_HITS`]).
pub(crate) fn alpha_cut(profile: &RenderProfile) -> f64 {
    profile.alpha_cut.max(1.0 / 255.0)
}

/// Most hits of a beam up to its return: (254/255)^177 < 0.5, and one to spare.
pub(crate) const MOST_HITS: usize = 178;

/// The squared number of standard deviations at which alpha falls below the cut, for a Gaussian's
/// peak opacity; not positive if it is below the cut itself. As for splats, a merged Gaussian with
/// an opacity above 1 ends where one of opacity 1 does.
pub(crate) fn reach2(log2_opacity: f64, profile: &RenderProfile) -> f64 {
    2.0 * std::f64::consts::LN_2 * (log2_opacity.min(0.0) - alpha_cut(profile).log2())
}
