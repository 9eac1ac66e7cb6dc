//! The blocks of a version by where they lie, so that a frame looks at those near it and not at all
//! of a city.

use std::collections::BTreeMap;
use std::ops::Range;

use wildcity_scene::geometry::Bounds;
use wildcity_scene::manifest::Section;
use wildcity_scene::{Manifest, RenderProfile};

use super::demand::{coarsest_level, longest_px};
use super::{SectionRef, Viewpoint};

/// Cells along the edge of a group: 1 km, so that 20 km of road are some twenty groups, and the 200
/// cells within 300 m of an eye lie in at most four.
const GROUP_CELLS: i32 = 16;

/// The blocks of a version in order, beneath the boxes of their cells and of groups of cells.
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
    /// Box of everything in it, in metres.
    pub(super) bounds: Bounds,
    chunk: usize,
    sections: Range<usize>,
}

impl BlockIndex {
    /// Of a version's table.
    pub fn new(manifest: &Manifest) -> Self {
        let mut groups: BTreeMap<[i32; 2], Group> = BTreeMap::new();
        let (mut cells, mut blocks) = (Vec::with_capacity(manifest.chunks.len()), Vec::new());
        for (chunk, entry) in manifest.chunks.iter().enumerate() {
            let (mut section, mut bounds) = (0, Bounds::EMPTY);
            let first = blocks.len();
            for block in entry.sections.chunk_by(|a, b| a.block == b.block) {
                let sections = section..section + block.len();
                section = sections.end;
                let block = Block { bounds: entry.section_bounds(&block[0]), chunk, sections };
                bounds = bounds.union(&block.bounds);
                blocks.push(block);
            }
            let place = entry.cell.map(|cell| cell.div_euclid(GROUP_CELLS));
            let nothing = || Group { bounds: Bounds::EMPTY, cells: Vec::new() };
            let group = groups.entry(place).or_insert_with(nothing);
            group.bounds = group.bounds.union(&bounds);
            group.cells.push(chunk);
            cells.push(Cell { bounds, blocks: first..blocks.len() });
        }
        Self { groups: groups.into_values().collect(), cells, blocks }
    }

    /// What [`demand`](super::demand()) says of the manifest that this is the index of.
    pub fn demand(
        &self,
        manifest: &Manifest,
        eyes: &[Viewpoint],
        profile: &RenderProfile,
    ) -> Vec<SectionRef> {
        let focal_px = longest_px(eyes);
        let distance_m = |bounds: &Bounds| {
            let from = |eye: &Viewpoint| bounds.distance_m(eye.position_m);
            eyes.iter().map(from).fold(f64::INFINITY, f64::min)
        };
        let mut needed = Vec::new();
        self.visit(profile.reach_m, &distance_m, &mut |block, distance_m| {
            let level =
                coarsest_level(block.levels(manifest), focal_px, distance_m, profile.tau_px);
            needed.push(block.at(level));
        });
        needed
    }

    /// Shows the blocks within reach and how far away they are, in order. A box is never farther than
    /// one within it, in f64 as on paper: each step of the distance rounds monotonically.
    pub(super) fn visit(
        &self,
        reach_m: Option<f64>,
        distance_m: &dyn Fn(&Bounds) -> f64,
        see: &mut dyn FnMut(&Block, f64),
    ) {
        let near = |bounds: &Bounds| reach_m.is_none_or(|reach_m| distance_m(bounds) <= reach_m);
        let groups = self.groups.iter().filter(|group| near(&group.bounds));
        let mut cells: Vec<usize> = groups.flat_map(|group| group.cells.iter().copied()).collect();
        cells.retain(|&cell| near(&self.cells[cell].bounds));
        cells.sort_unstable();
        for block in
            cells.into_iter().flat_map(|cell| &self.blocks[self.cells[cell].blocks.clone()])
        {
            let distance_m = distance_m(&block.bounds);
            if reach_m.is_none_or(|reach_m| distance_m <= reach_m) {
                see(block, distance_m);
            }
        }
    }

    /// Box of everything.
    pub(super) fn bounds(&self) -> Bounds {
        self.groups.iter().fold(Bounds::EMPTY, |all, group| all.union(&group.bounds))
    }
}

impl Block {
    /// Its sections, in order of level.
    pub(super) fn levels<'a>(&self, manifest: &'a Manifest) -> &'a [Section] {
        &manifest.chunks[self.chunk].sections[self.sections.clone()]
    }

    fn at(&self, level: usize) -> SectionRef {
        SectionRef { chunk: self.chunk, section: self.sections.start + level }
    }
}
