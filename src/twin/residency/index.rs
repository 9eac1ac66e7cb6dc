//! A spatial index over the blocks of a version, so that a frame looks only at the blocks near it
//! and not at a whole city; and the sections that a frame draws.

use std::collections::BTreeMap;
use std::ops::Range;

use wildcity_scene::geometry::Bounds;
use wildcity_scene::manifest::Section;
use wildcity_scene::{Manifest, RenderProfile, Selection, ViewSet};

use super::ResidencyError;
use super::demand::{SectionRef, SelectedSections, Viewpoint, coarsest_level};

/// Cells along the edge of a group: 1 km. 20 km of road are then about twenty groups, and the 200
/// cells within 300 m of a viewpoint lie in at most four of them.
const GROUP_CELLS: i32 = 16;

/// Finds the sections that a frame draws: the blocks of a version in order, below the bounding
/// boxes of their cells and of groups of cells.
///
/// A view draws one section of every block within `reach_m` of it. Which one depends only on its
/// own camera, the profile, and the manifest's table, and not on the other views of the frame.
///
/// An error of `e` metres at a distance of `d` metres is `f e / d` pixels wide, with `f` the focal
/// length in pixels. A view draws a block at the coarsest level for which that is at most `tau_px`,
/// with the view's focal length and its distance from the bounding box of everything in the block.
/// The amount of memory has no influence.
#[derive(Debug)]
pub struct BlockIndex {
    groups: Vec<Group>,
    cells: Vec<Cell>,
    blocks: Vec<Block>,
}

#[derive(Debug)]
struct Group {
    bounds: Bounds,
    cells: Vec<usize>,
}

#[derive(Debug)]
struct Cell {
    bounds: Bounds,
    blocks: Range<usize>,
}

/// A block: its sections in order of level.
#[derive(Debug)]
pub(super) struct Block {
    /// Bounding box of everything in it, in metres.
    pub(super) bounds: Bounds,
    chunk: usize,
    sections: Range<usize>,
}

impl BlockIndex {
    /// Builds the index of a version's table.
    pub fn new(manifest: &Manifest) -> Self {
        let mut groups: BTreeMap<[i32; 2], Group> = BTreeMap::new();
        let mut cells = Vec::with_capacity(manifest.chunks.len());
        let mut blocks = Vec::new();
        for (chunk, entry) in manifest.chunks.iter().enumerate() {
            let first_block = blocks.len();
            let mut next_section = 0;
            let mut bounds = Bounds::EMPTY;
            // Sections are sorted by (block, level), so that a block's are neighbours.
            for block in entry.sections.chunk_by(|a, b| a.block == b.block) {
                let sections = next_section..next_section + block.len();
                next_section = sections.end;
                // The box of level 0 stands for the block at every level, so that the level that is
                // chosen does not change the distance that it is chosen by.
                let block = Block { bounds: entry.section_bounds(&block[0]), chunk, sections };
                bounds = bounds.union(&block.bounds);
                blocks.push(block);
            }

            // Rounded towards minus infinity: `/` would put cells -15 to 15 into one group around
            // the origin.
            let group_cell = entry.cell.map(|cell| cell.div_euclid(GROUP_CELLS));
            let empty = || Group { bounds: Bounds::EMPTY, cells: Vec::new() };
            let group = groups.entry(group_cell).or_insert_with(empty);
            group.bounds = group.bounds.union(&bounds);
            group.cells.push(chunk);
            cells.push(Cell { bounds, blocks: first_block..blocks.len() });
        }
        Self { groups: groups.into_values().collect(), cells, blocks }
    }

    /// The sections that views at these viewpoints draw, of all of them together. `manifest` is the
    /// one that this index was built from.
    pub fn demand(
        &self,
        manifest: &Manifest,
        viewpoints: &[Viewpoint],
        profile: &RenderProfile,
    ) -> Vec<SectionRef> {
        let mut sections = Vec::new();
        self.visit_drawn(manifest, viewpoints, profile, |section, _| sections.push(section));
        sections
    }

    /// The sections that a frame draws, and which of its views draw which. `manifest` is the one
    /// that this index was built from.
    ///
    /// # Errors
    /// [`ResidencyError::Views`] for more than [`Viewpoint::MAX`] viewpoints.
    pub fn select(
        &self,
        manifest: &Manifest,
        viewpoints: &[Viewpoint],
        profile: &RenderProfile,
    ) -> Result<SelectedSections, ResidencyError> {
        let views = viewpoints.len();
        if views > Viewpoint::MAX {
            return Err(ResidencyError::Views { views });
        }
        let mut sections = Vec::new();
        let mut by_chunk: Vec<ViewSet> = Vec::new();
        self.visit_drawn(manifest, viewpoints, profile, |section, views| {
            sections.push(section);
            by_chunk.push(views.collect());
        });
        // If all views draw the same sections, the renderer needs no selection by view.
        let all: ViewSet = (0..views).collect();
        let is_shared = by_chunk.iter().all(|&set| set == all);
        let selection = (!is_shared).then_some(Selection { views, by_chunk });
        Ok(SelectedSections { sections, selection })
    }

    /// Calls `see` with each section that a view draws, and the indices of the views that do.
    fn visit_drawn(
        &self,
        manifest: &Manifest,
        viewpoints: &[Viewpoint],
        profile: &RenderProfile,
        mut see: impl FnMut(SectionRef, &mut dyn Iterator<Item = usize>),
    ) {
        let RenderProfile { reach_m, tau_px, .. } = *profile;
        let nearest_m = |bounds: &Bounds| {
            let distances_m =
                viewpoints.iter().map(|viewpoint| bounds.distance_m(viewpoint.position_m));
            distances_m.fold(f64::INFINITY, f64::min)
        };
        // The level that each view draws of a block; none beyond its reach.
        let mut drawn: Vec<Option<usize>> = vec![None; viewpoints.len()];
        self.visit(reach_m, nearest_m, |block, _| {
            let levels = block.levels(manifest);
            for (drawn, Viewpoint { position_m, focal_px }) in drawn.iter_mut().zip(viewpoints) {
                let distance_m = block.bounds.distance_m(*position_m);
                let is_near = reach_m.is_none_or(|reach_m| distance_m <= reach_m);
                *drawn = is_near.then(|| coarsest_level(levels, *focal_px, distance_m, tau_px));
            }
            // Level by level and not view by view, so that a section is seen once, with all of its
            // views.
            for level in 0..levels.len() {
                let draws = |(_, drawn): &(usize, &Option<usize>)| **drawn == Some(level);
                let mut views = drawn.iter().enumerate().filter(draws).map(|(view, _)| view);
                if drawn.contains(&Some(level)) {
                    see(block.section_ref(level), &mut views);
                }
            }
        });
    }

    /// Calls `see` with each block within reach and its distance, in order.
    ///
    /// A box is never farther away than a box within it, in f64 arithmetic as well as on paper:
    /// each step of the distance rounds monotonically. So no block is lost by skipping groups and
    /// cells that are out of reach.
    pub(super) fn visit(
        &self,
        reach_m: Option<f64>,
        distance_m: impl Fn(&Bounds) -> f64,
        mut see: impl FnMut(&Block, f64),
    ) {
        let is_near = |bounds: &Bounds| reach_m.is_none_or(|reach_m| distance_m(bounds) <= reach_m);
        // Groups, then cells, then blocks: of 20 km of road, about 20 tests of groups, at most 1024
        // of cells in the four near ones, and 16 of blocks per near cell.
        let groups = self.groups.iter().filter(|group| is_near(&group.bounds));
        let mut cells: Vec<usize> = groups.flat_map(|group| group.cells.iter().copied()).collect();
        cells.retain(|&cell| is_near(&self.cells[cell].bounds));
        // Groups are in another order than cells, and a frame draws in the order of cells.
        cells.sort_unstable();
        let near_cells = cells.into_iter().map(|cell| &self.cells[cell]);
        for block in near_cells.flat_map(|cell| &self.blocks[cell.blocks.clone()]) {
            let distance_m = distance_m(&block.bounds);
            if reach_m.is_none_or(|reach_m| distance_m <= reach_m) {
                see(block, distance_m);
            }
        }
    }

    /// Number of blocks of all cells.
    pub(super) fn blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Bounding box of the whole version.
    pub(super) fn bounds(&self) -> Bounds {
        self.groups.iter().fold(Bounds::EMPTY, |all, group| all.union(&group.bounds))
    }
}

impl Block {
    /// Its sections, in order of level.
    pub(super) fn levels<'a>(&self, manifest: &'a Manifest) -> &'a [Section] {
        &manifest.chunks[self.chunk].sections[self.sections.clone()]
    }

    /// Memory that one of its sections needs, in bytes.
    pub(super) fn needed_bytes(&self, manifest: &Manifest, section: &Section) -> u64 {
        manifest.chunks[self.chunk].needed_bytes(manifest.sh_degree, section)
    }

    fn section_ref(&self, level: usize) -> SectionRef {
        SectionRef { chunk: self.chunk, section: self.sections.start + level }
    }
}
