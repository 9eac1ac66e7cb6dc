//! The assets of an episode's actors, and the parts of them that a frame draws.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use wildcity_scene::actor::{ActorAsset, ActorViewpoint, ContactShadow, PlacedChunk};
use wildcity_scene::geometry::Pose;
use wildcity_scene::{ActorBox, ActorClass, RenderProfile, SemanticClass, ViewSet};
use wildcity_sim::scenario::{AssetInfo, Assets};
use wildcity_twin::residency::{Cache, ResidencyError, ResidentActor, Viewpoint};
use wildcity_twin::store::{Catalog, StoredActor};

use super::default_assets::{generated_actors, nearest};
use crate::engine::answer_budget::BudgetShare;

/// The asset of each actor, by its index; `None` for an actor that is not drawn. Copies share the
/// assets.
#[derive(Clone, Debug, Default)]
pub(crate) struct ActorAssets {
    actors: Arc<[Option<Arc<ResidentActor>>]>,
    /// The share of the budget for answers that their scenario takes, until the last copy is
    /// dropped.
    _share: Option<Arc<BudgetShare>>,
}

/// Data of a frame by which each of its views chooses the levels of detail of actors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameDetail<'a> {
    pub(crate) viewpoints: &'a [Viewpoint],
    /// How long each view is exposed, in microseconds.
    pub(crate) exposures_us: &'a [i64],
    pub(crate) profile: &'a RenderProfile,
}

/// The assets of a store, as scenarios look them up. Remembers what it found: many actors have the
/// same asset.
#[derive(Debug)]
pub struct StoredAssets<'a> {
    catalog: &'a Catalog,
    found: RefCell<BTreeMap<String, Result<AssetInfo, String>>>,
    generated: GeneratedActors,
}

/// The generated assets of a store, once they are needed; none if they cannot be made, as in a
/// store that is read only.
pub(crate) type GeneratedActors = Arc<OnceLock<Vec<StoredActor>>>;

impl<'a> StoredAssets<'a> {
    /// The assets of a store. If an actor needs a generated one that is missing, it is made.
    pub fn new(catalog: &'a Catalog) -> Self {
        Self::sharing(catalog, Arc::default())
    }

    /// As [`Self::new`], with the generated assets that others have found.
    pub(crate) fn sharing(catalog: &'a Catalog, generated: GeneratedActors) -> Self {
        Self { catalog, found: RefCell::default(), generated }
    }
}

impl Assets for StoredAssets<'_> {
    fn find(&self, name: &str) -> Result<AssetInfo, String> {
        let mut found = self.found.borrow_mut();
        let entry = found.entry(name.to_owned());
        let find = || {
            let actor = self.catalog.find_actor(name).map_err(|error| error.to_string())?;
            Ok(info(&actor))
        };
        // An error is kept as well: other actors of this name get the same answer.
        entry.or_insert_with(find).clone()
    }

    fn default_for(&self, class: ActorClass, box_: &ActorBox) -> Result<Option<AssetInfo>, String> {
        // Made once for all episodes. After a failure the list stays empty, so that it is reported
        // once.
        let generated = self.generated.get_or_init(|| {
            generated_actors(self.catalog).unwrap_or_else(|reason| {
                tracing::warn!("actors that name no asset are not drawn: {reason}");
                Vec::new()
            })
        });
        Ok(nearest(generated, class, box_).map(info))
    }
}

fn info(actor: &StoredActor) -> AssetInfo {
    let description = &actor.description;
    AssetInfo { hash: actor.hash.clone(), class: description.class, box_: description.box_ }
}

impl ActorAssets {
    /// Loads assets into memory, given by their hashes.
    ///
    /// # Errors
    /// One cannot be read, or there is no room for it.
    pub(crate) fn load<'a>(
        cache: &Cache,
        hashes: impl Iterator<Item = Option<&'a str>>,
    ) -> Result<Self, ResidencyError> {
        let assets: Result<Arc<[_]>, _> =
            hashes.map(|hash| hash.map(|hash| cache.actor(hash)).transpose()).collect();
        Ok(Self { actors: assets?, _share: None })
    }

    /// The same assets, with a share of memory that lives as long as they do.
    pub(crate) fn with_share(self, share: BudgetShare) -> Self {
        Self { _share: Some(Arc::new(share)), ..self }
    }

    /// Whether no actor is drawn.
    pub(crate) fn is_empty(&self) -> bool {
        self.actors.iter().all(Option::is_none)
    }

    /// The actors that a frame draws, given the pose of each at the frame's time, and a time before
    /// it in microseconds at which a view's exposure began.
    ///
    /// An actor that was absent at the start of an exposure appears during it, and is drawn at
    /// rest.
    pub(crate) fn placed(
        &self,
        poses: &[Option<Pose>],
        poses_before: &dyn Fn(i64) -> Vec<Option<Pose>>,
        frame: FrameDetail<'_>,
    ) -> Vec<PlacedChunk> {
        // By exposure, because most views have the same one.
        let at_start: BTreeMap<i64, Vec<Option<Pose>>> =
            frame.exposures_us.iter().map(|&us| (us, poses_before(us))).collect();
        let actors = self.actors.iter().zip(poses).enumerate();
        let placements = actors.filter_map(|(index, (actor, pose))| {
            let world_from_actor = (*pose)?;
            let start_of = |exposure_us: &i64| {
                let before = at_start.get(exposure_us).and_then(|poses| poses.get(index));
                before.copied().flatten().unwrap_or(world_from_actor)
            };
            Some(Placement {
                actor: index as u16,
                asset: actor.as_ref()?.asset(),
                world_from_actor,
                world_from_actor_at_start: frame.exposures_us.iter().map(start_of).collect(),
            })
        });
        frame.placed(placements)
    }
}

/// An actor in a frame.
#[derive(Clone, Debug)]
pub(crate) struct Placement<'a> {
    /// Its index among the actors.
    pub(crate) actor: u16,
    pub(crate) asset: &'a ActorAsset,
    /// Its pose at the frame's time.
    pub(crate) world_from_actor: Pose,
    /// Its pose at the start of each view's exposure.
    pub(crate) world_from_actor_at_start: Vec<Pose>,
}

impl FrameDetail<'_> {
    /// The actors that a frame draws, with their shadows: a chunk of each for the views that draw
    /// it at one level of detail, and whose exposures begin at one pose.
    pub(crate) fn placed<'a>(
        &self,
        actors: impl Iterator<Item = Placement<'a>>,
    ) -> Vec<PlacedChunk> {
        actors.flat_map(|placement| self.chunks(&placement)).collect()
    }

    /// The chunks of one actor.
    fn chunks(&self, placement: &Placement<'_>) -> Vec<PlacedChunk> {
        let Placement { actor, asset, world_from_actor, world_from_actor_at_start } = placement;
        let RenderProfile { tau_px, reach_m, .. } = *self.profile;
        let box_ = asset.description.box_;
        let shadow =
            Some(ContactShadow { length_m: box_.length_m as f32, width_m: box_.width_m as f32 });
        let mut chunks: Vec<PlacedChunk> = Vec::new();
        let views = self.viewpoints.iter().zip(world_from_actor_at_start).enumerate();
        for (view, (&Viewpoint { position_m, focal_px }, &at_start)) in views {
            let viewpoint = ActorViewpoint { position_m, focal_px };
            // Too far from the camera, it is not drawn.
            let Some(chunk) = asset.level(world_from_actor, &viewpoint, tau_px, reach_m) else {
                continue;
            };
            let same = chunks.iter_mut().find(|placed| {
                Arc::ptr_eq(&placed.chunk, chunk) && placed.world_from_actor_at_start == at_start
            });
            match same {
                Some(placed) => placed.views.insert(view),
                None => chunks.push(PlacedChunk {
                    world_from_actor_at_start: at_start,
                    class: SemanticClass::from_actor(asset.description.class),
                    shadow,
                    views: ViewSet::from_iter([view]),
                    ..PlacedChunk::at_rest(chunk.clone(), *world_from_actor, *actor)
                }),
            }
        }
        chunks
    }
}

/// When the exposure of a frame begins, in microseconds. In a warm-up and before the start of an
/// episode nothing moves during the exposure, neither the rig nor actors.
pub(crate) fn exposure_start_us(taken_us: i64, exposure_us: i64) -> i64 {
    if taken_us < 0 { taken_us } else { taken_us.saturating_sub(exposure_us).max(0) }
}
