//! A city: streets end to start along one route of any length, made cell by cell.
//!
//! The route runs east and bends by up to 47° to both sides, so it never crosses itself. Streets
//! are made from west to east: a cell is complete once it lies west of all streets that are still
//! to come. Only two or three streets are in memory at a time, for a route of any length.

use std::collections::{BTreeMap, VecDeque};

use glam::DVec3;
use rayon::prelude::*;

use wildcity_scene::chunk::{self, CELL_M};
use wildcity_scene::geometry::Pose;
use wildcity_scene::{Gaussians, Trajectory};
use wildcity_sim::map::MapFile;

use super::light::Light;
use super::map::{MappedStreet, build_map};
use super::random::Random;
use super::road::LANE_T_M;
use super::route::{self, BEYOND_M, Bends, Route, Wave};
use super::street::Plan;
use super::surface::Painter;
use super::{CitySettings, GenerateError};

/// Shortest and longest street, except for the last two, in metres: long enough that side streets
/// do not meet behind the houses where the route bends.
const STREET_M: [f64; 2] = [150.0, 220.0];
/// Extent of a street from its centre line, in metres: the side street's 82, the house at its
/// end, 13, and eaves.
const ASIDE_M: f64 = 110.0;
/// Most streets that are painted at once: each is 115 MB at 5 million Gaussians per km.
const PAINTED_AT_ONCE: usize = 4;
/// Distance of the drive from both ends of the route, in metres.
const INDENT_M: f64 = 8.0;

/// All Gaussians of one cell.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// Grid cell (x, y), as in [`wildcity_scene::Chunk::cell`].
    pub cell: [i32; 2],
    /// Raw Gaussians of SH degree 1, in world axes.
    pub gaussians: Gaussians,
}

/// An iterator over the cells of a city from west to east, each once. The same settings give the
/// same cells on any number of threads.
#[derive(Debug)]
pub struct City {
    settings: CitySettings,
    streets: Streets,
    /// Planned streets that are not painted yet, preceded by the one that was painted last.
    planned: VecDeque<Plan>,
    painted_any: bool,
    /// Gaussians of cells that are not complete yet.
    open: BTreeMap<[i32; 2], Gaussians>,
    done: VecDeque<Cell>,
}

/// Begins a city.
///
/// # Errors
/// Names the first setting out of range.
pub fn city(settings: &CitySettings) -> Result<City, GenerateError> {
    settings.check()?;
    Ok(City {
        streets: Streets::new(settings),
        settings: settings.clone(),
        planned: VecDeque::new(),
        painted_any: false,
        open: BTreeMap::new(),
        done: VecDeque::new(),
    })
}

/// The recorded drive through a city, from end to end in the right lane: a keyframe every 0.5 m at
/// a constant speed.
///
/// # Errors
/// Names the first setting out of range.
pub fn city_drive(settings: &CitySettings) -> Result<Trajectory, GenerateError> {
    settings.check()?;
    let mut station_m = INDENT_M;
    let mut poses: Vec<Pose> = Vec::new();
    for Site { route, .. } in Streets::new(settings) {
        // Each street up to its end, and the last one to the indent before the end of the route.
        let to_s_m = route.driven_m[1].min(settings.length_m - INDENT_M);
        // `station_m` goes on from street to street, so that keyframes stay 0.5 m apart
        // across the joint.
        poses.extend(route.poses(LANE_T_M, &mut station_m, to_s_m));
    }
    Ok(Trajectory { name: "log".into(), keyframes: route::keyframes(poses, settings.speed_m_s) })
}

/// The map of a city, from end to end: the lanes of all its streets, linked, with their
/// intersections.
///
/// # Errors
/// Names the first setting out of range.
pub fn city_map(settings: &CitySettings) -> Result<MapFile, GenerateError> {
    settings.check()?;
    let sites: Vec<(Route, f64)> = Streets::new(settings)
        .map(|site| {
            // The same draw as for painting: the map has the crossing where the Gaussians have it.
            let crossing_m = site.crossing_m(&mut site.random(settings.seed));
            (site.route, crossing_m)
        })
        .collect();
    let streets: Vec<MappedStreet<'_>> = sites
        .iter()
        .map(|(route, crossing_m)| MappedStreet { route, crossing_m: *crossing_m })
        .collect();
    Ok(build_map(&streets))
}

impl Iterator for City {
    type Item = Cell;

    fn next(&mut self) -> Option<Cell> {
        // A batch of streets may complete no cell.
        while self.done.is_empty() && self.paint() {}
        self.done.pop_front()
    }
}

impl City {
    /// Paints the next streets, and moves the cells that are complete to the output. Returns
    /// whether there was a street left.
    fn paint(&mut self) -> bool {
        let count = rayon::current_num_threads().min(PAINTED_AT_ONCE);
        // `planned[0]` was painted in the previous batch, and stays for its shadows.
        let first = usize::from(self.painted_any);
        // Houses of neighbouring streets cast shadows on each other.
        while self.planned.len() < first + count + 1
            && let Some(site) = self.streets.next()
        {
            self.planned.push_back(site.plan(self.settings.seed));
        }
        let last = self.planned.len().min(first + count);
        if first == last {
            return false;
        }
        let density = self.settings.spacing_density();
        let planned = self.planned.make_contiguous();
        let painted: Vec<Gaussians> =
            (first..last).into_par_iter().map(|at| paint(planned, at, density)).collect();
        for gaussians in painted {
            self.file(&gaussians);
        }
        // The last painted one stays as the neighbour of the next.
        self.planned.drain(..last - 1);
        self.painted_any = true;
        // The west end of the next street; without one, everything is complete.
        let to_come_m =
            self.planned.get(1).map(|next| next.route.at(next.route.ends_m[0]).point_m.x);
        self.close(to_come_m.map_or(f64::INFINITY, |x_m| x_m - ASIDE_M));
        true
    }

    /// Adds Gaussians to their cells.
    fn file(&mut self, gaussians: &Gaussians) {
        let mut counts: BTreeMap<[i32; 2], usize> = BTreeMap::new();
        for mean_m in &gaussians.means_m {
            // Counted first, so that each cell grows once and to its exact size.
            *counts.entry(chunk::cell_at(mean_m)).or_default() += 1;
        }
        for (cell, count) in counts {
            let empty = || Gaussians::with_capacity(gaussians.sh_degree, count);
            self.open.entry(cell).or_insert_with(empty).reserve_exact(count);
        }
        for (index, mean_m) in gaussians.means_m.iter().enumerate() {
            if let Some(cell) = self.open.get_mut(&chunk::cell_at(mean_m)) {
                cell.push_from(gaussians, index);
            }
        }
    }

    /// Moves the cells west of `x_m`, which are complete, to the output.
    fn close(&mut self, x_m: f64) {
        let open = std::mem::take(&mut self.open).into_iter();
        let is_done = |cell: &[i32; 2]| CELL_M * (f64::from(cell[0]) + 0.5) < x_m;
        let (done, open): (BTreeMap<_, _>, _) = open.partition(|(cell, _)| is_done(cell));
        self.open = open;
        self.done.extend(done.into_iter().map(|(cell, gaussians)| Cell { cell, gaussians }));
    }
}

/// Paints one of the planned streets in the light that its neighbours leave.
fn paint(planned: &[Plan], at: usize, density: f64) -> Gaussians {
    // At most one street to each side: a shadow is no longer than a house is high.
    let near = &planned[at.saturating_sub(1)..planned.len().min(at + 2)];
    let light = Light::new(near.iter().flat_map(Plan::occluders).collect());
    let mut painter = Painter::new(&light, density).with_classes();
    planned[at].paint(&mut painter);
    painter.gaussians
}

/// The position of a street of the city along the route.
#[derive(Debug)]
struct Site {
    route: Route,
    index: usize,
}

impl Site {
    fn random(&self, seed: u64) -> Random {
        Random::new(seed, "street", self.index)
    }

    /// The middle of its crossing, in metres along the route: the first draw of its stream.
    fn crossing_m(&self, random: &mut Random) -> f64 {
        let [from_m, to_m] = self.route.driven_m;
        let middle_m = 0.5 * (from_m + to_m);
        // At most a tenth of the length from its middle.
        // A street of 100 m, the shortest, leaves 40 m on either side.
        middle_m + 0.1 * (to_m - from_m) * random.range(-1.0, 1.0)
    }

    fn plan(self, seed: u64) -> Plan {
        let mut random = self.random(seed);
        let crossing_m = self.crossing_m(&mut random);
        Plan::new(self.route, crossing_m, [random.seed(), seed])
    }
}

/// The streets of a city, from its start to its end.
#[derive(Clone, Debug)]
struct Streets {
    seed: u64,
    length_m: f64,
    bends: Bends,
    station_m: f64,
    point_m: DVec3,
    index: usize,
}

impl Streets {
    /// The bends of a city's route, before any street is made.
    ///
    /// Together with the streets' own 0.30 rad the heading stays within 0.82 rad of east; the
    /// curvature within `2π (0.30 / 260 + 0.40 / 3100 + 0.12 / 1100)` = 0.0088 1/m, a radius of 114
    /// m.
    fn new(settings: &CitySettings) -> Self {
        let mut random = Random::new(settings.seed, "bends", 0);
        let wide = [(0.40, 3100.0), (0.12, 1100.0)].map(|(swing_rad, period_m)| {
            let phase_rad = random.range(0.0, std::f64::consts::TAU);
            Wave { swing_rad, period_m, phase_rad }
        });
        Self {
            seed: settings.seed,
            length_m: settings.length_m,
            bends: Bends { wide },
            station_m: 0.0,
            point_m: DVec3::ZERO,
            index: 0,
        }
    }
}

impl Iterator for Streets {
    type Item = Site;

    fn next(&mut self) -> Option<Site> {
        let [shortest_m, longest_m] = STREET_M;
        let left_m = self.length_m - self.station_m;
        if left_m <= 0.0 {
            return None;
        }
        // Whole metres, so that streets meet on the nodes of their centre lines.
        let long_m = if left_m <= longest_m {
            left_m
        } else if left_m <= 2.0 * shortest_m {
            // Two streets remain: equal halves, so that the last is not too short.
            (0.5 * left_m).floor()
        } else {
            let mut random = Random::new(self.seed, "length", self.index);
            // A rest of a shortest street must remain.
            random.range(shortest_m, longest_m).min(left_m - shortest_m).floor()
        };
        let driven_m = [self.station_m, self.station_m + long_m];
        let closed = [self.index == 0, driven_m[1] >= self.length_m];
        let beyond_m = closed.map(|closed| if closed { BEYOND_M } else { 0.0 });
        let ends_m = [driven_m[0] - beyond_m[0], driven_m[1] + beyond_m[1]];
        // Every street has the same bends, and begins where the one before it ends.
        let mut route = Route::line(self.bends, ends_m, self.station_m, self.point_m);
        (route.driven_m, route.closed) = (driven_m, closed);
        self.station_m = driven_m[1];
        self.point_m = route.at(self.station_m).point_m;
        self.index += 1;
        Some(Site { route, index: self.index - 1 })
    }
}
