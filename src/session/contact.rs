//! Contact of the ego with the twin (`wildcity.static@1`), which every session looks for unless it
//! is switched off.
//!
//! The ego touches the twin where the solid Gaussians in its box have more area than on the
//! recorded drives near by: the recorded car drove there, so what its box overlapped is no
//! obstacle. The drives within the same block of 16 m, or a few metres beside it, decide. The
//! largest area on all drives of a city would hide a parked car where the road is clear, because of
//! one bush that hangs over the road elsewhere.
//!
//! Solid Gaussians are read block by block around the ego, at full detail: what is drawn, and from
//! where, does not matter. A contact is a function of the version, of the ego's box and of its
//! motion in the step.

use std::collections::HashMap;
use std::sync::Arc;

use glam::{DVec2, DVec3};
use parking_lot::Mutex;

use wildcity_scene::Chunk;
use wildcity_scene::chunk::{BLOCK_M, column};
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::{ChunkEntry, Section};
use wildcity_sim::Ego;
use wildcity_sim::contact::{
    MAX_SWEPT_SPEED_MPS, SOLID_OPACITY, SolidPoint, SolidSums, Solids, StaticLimit, TestedBox,
};
use wildcity_sim::traffic::{EgoBox, EgoMotion, EgoState};
use wildcity_twin::store::Catalog;

use crate::blocking::Stop;
use crate::engine::solid_blocks::{SectionKey, SolidBlocks};
use crate::error::SessionError;
use crate::scenario::{Event, EventKind};
use crate::spatial_index::{Block, SectionId, SpatialIndex, block_at};

/// Recorded drives up to this far outside of a block decide what is a contact in it, in metres.
const BESIDE_M: f64 = 4.0;
/// Largest distance between two places at which the area is measured along a recorded drive, in
/// metres.
const MEASURED_M: f64 = 0.5;

/// An ego is tested again when it has moved by this, in metres, or turned by this, in radians. What
/// it meets stays in its box for longer.
const TESTED_M: f64 = 0.25;
const TESTED_RAD: f64 = 0.05;

/// The solid Gaussians of a version, for an ego of one size. Copies share what they have read.
#[derive(Clone, Debug)]
pub(crate) struct TwinSolids {
    catalog: Catalog,
    index: Arc<SpatialIndex>,
    blocks: Arc<SolidBlocks>,
    ego_box: EgoBox,
    limits: Arc<Mutex<HashMap<Block, StaticLimit>>>,
}

/// Where a contact begins.
struct Met {
    /// Time since the start of the step, in microseconds.
    since_us: i64,
    state: EgoState,
    area_m2: f64,
}

/// Sections that a computation has looked up, so that it does not look them up for each pose.
struct Near<'a> {
    sections: HashMap<SectionId, Arc<Solids>>,
    /// Whether the result is still of use: no section is read for a client that has left.
    is_wanted: &'a dyn Fn() -> bool,
}

impl<'a> Near<'a> {
    fn new(is_wanted: &'a dyn Fn() -> bool) -> Self {
        Self { sections: HashMap::new(), is_wanted }
    }
}

impl TwinSolids {
    pub(crate) fn new(
        catalog: Catalog,
        index: Arc<SpatialIndex>,
        blocks: Arc<SolidBlocks>,
        ego_box: EgoBox,
    ) -> Self {
        Self { catalog, index, blocks, ego_box, limits: Arc::default() }
    }

    /// The contacts that begin while the ego goes from one state through others, step by step. Each
    /// step takes `dt_us`, and the first begins at `begin_us`. Blocks while it reads what is near.
    ///
    /// What the ego overlaps already at the beginning, as at the start of an episode or after a
    /// switch of the version, is not a new contact before it has left it.
    ///
    /// # Errors
    /// The twin cannot be read, or the result is of no use any more.
    pub(crate) fn contacts(
        &self,
        from: &Ego,
        egos: &[Ego],
        begin_us: i64,
        dt_us: i64,
        stop: &Stop,
    ) -> Result<Vec<Vec<Event>>, SessionError> {
        let is_wanted = || stop.check().is_continue();
        let mut near = Near::new(&is_wanted);
        let mut from = EgoState::new(from);
        // Unknown until the ego moves: the test reads sections that an ego at rest does not need.
        let mut touches: Option<bool> = None;
        let mut steps = Vec::with_capacity(egos.len());
        for (ego, step) in egos.iter().zip(0..) {
            let motion = EgoMotion::new(from, ego);
            let mut events = Vec::new();
            // An ego that stands does not begin to touch anything.
            if motion.from != motion.to {
                let touched = match touches {
                    Some(touches) => touches,
                    None => self.contact_m2(&mut near, &motion.from.world_from_rig)?.is_some(),
                };
                let step_us = begin_us + step * dt_us;
                let touched = self.step_contacts(&mut near, &motion, dt_us, touched, |met| {
                    let impact_mps = met.state.velocity_mps.length();
                    let kind = EventKind::StaticContact { area_m2: met.area_m2, impact_mps };
                    events.push(Event { time_us: step_us + met.since_us, kind });
                })?;
                touches = Some(touched);
            }
            steps.push(events);
            from = motion.to;
        }
        Ok(steps)
    }

    /// Shows `visit` the contacts that begin in a step, in which the ego `touched` the twin at its
    /// start. Returns whether it does at its end.
    fn step_contacts(
        &self,
        near: &mut Near<'_>,
        motion: &EgoMotion,
        dt_us: i64,
        mut touched: bool,
        mut visit: impl FnMut(Met),
    ) -> Result<bool, SessionError> {
        if !motion.smooth && motion.mean_speed_mps(dt_us) > MAX_SWEPT_SPEED_MPS {
            // Of a jump only the end is tested, and whatever is met there is new.
            let state = motion.to;
            let area_m2 = self.contact_m2(near, &state.world_from_rig)?;
            if let Some(area_m2) = area_m2 {
                visit(Met { since_us: dt_us, state, area_m2 });
            }
            return Ok(area_m2.is_some());
        }
        // `tested` is the last state that was tested, and `skipped` are the states after it.
        let mut tested = motion.from;
        let mut skipped: Vec<(i64, EgoState)> = Vec::new();
        for (since_us, state) in motion.sub_steps(dt_us) {
            skipped.push((since_us, state));
            // The end of the step is always tested, because the next step starts from `touched`.
            if since_us < dt_us && is_beside(&tested, &state) {
                continue;
            }
            let touches = self.contact_m2(near, &state.world_from_rig)?.is_some();
            if touches && !touched {
                // The first of the sub-steps since the last test.
                for (since_us, state) in skipped.drain(..) {
                    if let Some(area_m2) = self.contact_m2(near, &state.world_from_rig)? {
                        visit(Met { since_us, state, area_m2 });
                        break;
                    }
                }
            }
            skipped.clear();
            tested = state;
            touched = touches;
        }
        Ok(touched)
    }

    /// Reads what an ego at a pose needs, as long as it is wanted. Blocks.
    ///
    /// # Errors
    /// The twin cannot be read, or no session wants it any more.
    pub(crate) fn read_around(
        &self,
        world_from_rig: &Pose,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<(), SessionError> {
        self.contact_m2(&mut Near::new(is_wanted), world_from_rig).map(|_| ())
    }

    /// The area that the ego meets at a pose, in m²; `None` if it is free.
    fn contact_m2(
        &self,
        near: &mut Near<'_>,
        world_from_rig: &Pose,
    ) -> Result<Option<f64>, SessionError> {
        let area_m2 = self.area_m2(near, world_from_rig)?;
        // Most places are free whatever the limit is.
        if !StaticLimit::default().is_exceeded_by(area_m2) {
            return Ok(None);
        }
        let limit = self.limit(near, block_at(world_from_rig.position_m.truncate()))?;
        Ok(limit.is_exceeded_by(area_m2).then_some(area_m2))
    }

    /// The area that the ego overlaps at a pose, in m².
    fn area_m2(&self, near: &mut Near<'_>, world_from_rig: &Pose) -> Result<f64, SessionError> {
        let tested = TestedBox::new(world_from_rig, &self.ego_box);
        let [low_m, high_m] = tested.extent_m();
        let mut area_m2 = 0.0;
        for section in self.index.sections(low_m, high_m) {
            area_m2 += self.section(near, section)?.area_m2(&tested);
        }
        Ok(area_m2)
    }

    /// The area above which there is a contact in a block.
    fn limit(&self, near: &mut Near<'_>, block: Block) -> Result<StaticLimit, SessionError> {
        // The lock is not held while sections are read. Two threads may compute the same limit,
        // with the same result.
        if let Some(limit) = self.limits.lock().get(&block) {
            return Ok(*limit);
        }
        let south_west_m = corner_m(block) - BESIDE_M;
        let north_east_m = corner_m(block) + BLOCK_M + BESIDE_M;
        let mut most_on_drive_m2: f64 = 0.0;
        // The margin is less than a block (4 m of 16 m), so that drives of the eight neighbours are
        // all that can reach into it.
        let [x, y] = block;
        for beside in (x - 1..=x + 1).flat_map(|x| (y - 1..=y + 1).map(move |y| [x, y])) {
            for [from, to] in self.index.drives(beside) {
                let way_m = from.position_m.distance(to.position_m);
                // Both ends of a part of the drive and places between them, at most `MEASURED_M`
                // apart.
                let parts = (way_m / MEASURED_M).ceil().max(1.0);
                for part in 0..=parts as u32 {
                    let pose = from.interpolate(&to, f64::from(part) / parts);
                    let place_m = pose.position_m.truncate();
                    if place_m.cmpge(south_west_m).all() && place_m.cmple(north_east_m).all() {
                        most_on_drive_m2 = most_on_drive_m2.max(self.area_m2(near, &pose)?);
                    }
                }
            }
        }
        let limit = StaticLimit { most_on_drive_m2 };
        self.limits.lock().insert(block, limit);
        Ok(limit)
    }

    /// The solid Gaussians of a section.
    fn section(&self, near: &mut Near<'_>, id: SectionId) -> Result<Arc<Solids>, SessionError> {
        if let Some(solids) = near.sections.get(&id) {
            return Ok(solids.clone());
        }
        let (chunk, section) = self.index.section(id);
        // Equal contents in two cells have one hash, but lie at two places: the origin belongs to
        // the key. Its bits are used because f64 has no hash.
        let key = (section.hash, chunk.origin_m.to_array().map(f64::to_bits));
        let solids = match self.blocks.get(&key) {
            Some(solids) => solids,
            None => self.read(key, chunk, section, near.is_wanted)?,
        };
        near.sections.insert(id, solids.clone());
        Ok(solids)
    }

    /// Reads the solid Gaussians of a section.
    fn read(
        &self,
        key: SectionKey,
        chunk: &ChunkEntry,
        section: &Section,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<Arc<Solids>, SessionError> {
        // One of many: each is a reason to look.
        if !is_wanted() {
            return Err(SessionError::DeadlineExceeded);
        }
        let reading = self.blocks.reading.begin(section.bytes.into(), is_wanted);
        let _reading = reading.ok_or(SessionError::DeadlineExceeded)?;
        // Another thread may have read it while this one waited. Of two that read it at once, both
        // insert equal contents.
        if let Some(solids) = self.blocks.get(&key) {
            return Ok(solids);
        }
        // Part by part: the sections of a dense capture have 90 MB each, and are read here in
        // addition to those that are drawn.
        let mut sums = SolidSums::default();
        self.catalog.visit_parts(self.index.version(), chunk, section, &mut |part| {
            sums.extend((0..part.len()).filter_map(|index| solid_point(part, index)));
        })?;
        let solids = Arc::new(sums.solids());
        self.blocks.insert(key, solids.clone());
        Ok(solids)
    }
}

/// Whether an ego has moved so little that it is not tested again.
fn is_beside(tested: &EgoState, now: &EgoState) -> bool {
    let from = &tested.world_from_rig;
    let to = &now.world_from_rig;
    from.position_m.distance(to.position_m) < TESTED_M
        && from.rotation.angle_between(to.rotation) < TESTED_RAD
}

/// The south-west corner of a block.
fn corner_m([x, y]: Block) -> DVec2 {
    // Cell (0, 0) has the origin at its middle, and block (0, 0) is at its south-west corner.
    BLOCK_M * DVec2::new(x as f64, y as f64) - 0.5 * wildcity_scene::chunk::CELL_M
}

/// A Gaussian of a section in world axes; `None` if it is not solid, as most are not in a capture.
fn solid_point(section: &Chunk, index: usize) -> Option<SolidPoint> {
    let value = |column| f64::from(section.value(index, column));
    let vector = |first| DVec3::new(value(first), value(first + 1), value(first + 2));
    let opacity = value(column::LOG2_OPACITY).exp2();
    (opacity >= SOLID_OPACITY).then(|| SolidPoint {
        mean_m: section.origin_m() + vector(column::MEAN),
        sigma_m: vector(column::SCALE),
        opacity,
    })
}
