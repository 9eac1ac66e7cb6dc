//! The plan of the street: the positions of its objects, and the order of painting.

use super::buildings::{self, Building};
use super::cars::Car;
use super::furniture;
use super::light::{Light, Occluder};
use super::plants::Tree;
use super::random::Random;
use super::road::{self, FRONT_M, KERB_M, LANE_T_M, PAVEMENT_M};
use super::route::Route;
use super::surface::Painter;
use super::{Street, StreetSettings, backdrop, yards};
use wildcity_scene::SemanticClass;

/// Middle of the parking bays, in metres from the centre line.
const BAY_T_M: f64 = 4.78;
/// Distance of trees, lamps and signs from the centre line, in metres.
const FURNITURE_T_M: f64 = KERB_M + 0.75;
/// No cars or trees this close to the middle of the crossing, in metres.
const CLEAR_M: f64 = 15.0;
/// Distance between parking bays, in metres.
const BAY_M: f64 = 6.3;
/// Distance between trees of one side, in metres; a lamp stands half way between two.
const TREE_M: f64 = 17.0;

pub(super) fn build(settings: &StreetSettings) -> Street {
    let StreetSettings { seed, length_m, crossing_m, density } = *settings;
    let plan = Plan::new(Route::new(length_m), crossing_m, [seed; 2]);
    let light = Light::new(plan.occluders().collect());
    let mut painter = Painter::new(&light, density).with_classes();
    // The backdrop belongs to a street by itself; streets of a city have none.
    plan.paint(&mut painter);
    backdrop::paint(&mut painter, &plan.route, seed);
    let trajectory = plan.route.drive("log", LANE_T_M);
    Street { gaussians: painter.gaussians, trajectory }
}

/// The objects of a street.
#[derive(Debug)]
pub(super) struct Plan {
    pub(super) route: Route,
    crossing_m: f64,
    seed: u64,
    grain_seed: u64,
    buildings: Vec<Building>,
    cars: Vec<Car>,
    trees: Vec<Tree>,
}

impl Plan {
    /// The street along `route` with a side street at station `crossing_m`. The first seed is that
    /// of all objects, the second that of the ground's grain, which continues from one street to
    /// the next.
    pub(super) fn new(route: Route, crossing_m: f64, [seed, grain_seed]: [u64; 2]) -> Self {
        Self {
            buildings: buildings::plan(&route, crossing_m, seed),
            cars: park(&route, crossing_m, seed),
            trees: plant(&route, crossing_m, seed),
            route,
            crossing_m,
            seed,
            grain_seed,
        }
    }

    /// The bodies that cast shadows.
    pub(super) fn occluders(&self) -> impl Iterator<Item = Occluder> + '_ {
        let buildings = self.buildings.iter().map(Building::occluder);
        let cars = self.cars.iter().flat_map(Car::occluders);
        buildings.chain(cars).chain(self.trees.iter().map(Tree::occluder))
    }

    pub(super) fn paint(&self, painter: &mut Painter) {
        painter.labelled(SemanticClass::Road, |painter| {
            road::paint(painter, &self.route, self.crossing_m, [self.grain_seed, self.seed]);
        });
        painter.labelled(SemanticClass::Building, |painter| {
            self.buildings.iter().for_each(|building| building.paint(painter));
        });
        painter.labelled(SemanticClass::Car, |painter| {
            self.cars.iter().for_each(|car| car.paint(painter));
        });
        painter.labelled(SemanticClass::Vegetation, |painter| {
            self.trees.iter().for_each(|tree| tree.paint(painter));
        });
        painter.labelled(SemanticClass::Static, |painter| {
            furnish(painter, &self.route, self.crossing_m, self.seed);
        });
        yards::paint(painter, &self.route, self.crossing_m, self.seed);
    }
}

/// Cars in two of three bays, which face in the driving direction of their side.
fn park(route: &Route, crossing_m: f64, seed: u64) -> Vec<Car> {
    let mut cars = Vec::new();
    for (side, name) in [(-1.0, "car, right"), (1.0, "car, left")] {
        for (index, s_m) in along(route, BAY_M).enumerate() {
            let beyond_m = route.beyond_m(s_m);
            // A stream for each bay, so that a free bay changes no other car.
            let mut random = Random::new(seed, name, index);
            let free =
                random.chance(0.34) || beyond_m > 45.0 || (s_m - crossing_m).abs() < CLEAR_M + 2.0;
            if free {
                continue;
            }
            let station = route.at(s_m + random.range(-0.3, 0.3));
            let middle_m = station.beside(side * (BAY_T_M + random.range(-0.06, 0.08)), 0.0);
            let forward = if side < 0.0 { station.forward } else { -station.forward };
            let spacing = if beyond_m < 10.0 { 1.0 } else { 1.8 };
            cars.push(Car::new(middle_m, forward, spacing, random));
        }
    }
    cars
}

/// Trees at even distances on both pavements.
fn plant(route: &Route, crossing_m: f64, seed: u64) -> Vec<Tree> {
    let mut trees = Vec::new();
    for (side, name) in [(-1.0, "tree, right"), (1.0, "tree, left")] {
        for (index, s_m) in along(route, TREE_M).enumerate() {
            // The left side is moved by 6 m, so that trees do not face each other.
            let s_m = s_m + if side < 0.0 { 0.0 } else { 6.0 };
            let mut random = Random::new(seed, name, index);
            let free = random.chance(0.12) || (s_m - crossing_m).abs() < CLEAR_M;
            if free {
                continue;
            }
            let foot_m = route.at(s_m).beside(side * FURNITURE_T_M, PAVEMENT_M);
            trees.push(Tree::new(foot_m, route.beyond_m(s_m) < 18.0, random));
        }
    }
    trees
}

/// Lamps, signs, bins, planters along both sides; lights and bollards at the crossing.
fn furnish(painter: &mut Painter, route: &Route, crossing_m: f64, seed: u64) {
    for side in [-1.0, 1.0] {
        let name = if side < 0.0 { "furniture, right" } else { "furniture, left" };
        for (index, s_m) in along(route, TREE_M).enumerate() {
            let s_m = s_m + 0.5 * TREE_M + if side < 0.0 { 0.0 } else { 6.0 };
            if (s_m - crossing_m).abs() < CLEAR_M {
                continue;
            }
            let mut random = Random::new(seed, name, index);
            let station = route.at(s_m);
            let foot_m = station.beside(side * FURNITURE_T_M, PAVEMENT_M);
            match index % 2 {
                0 => furniture::lamp(painter, foot_m, -side * station.left),
                _ if random.chance(0.5) => {
                    let facing = if side < 0.0 { -station.forward } else { station.forward };
                    furniture::sign(painter, foot_m, facing);
                }
                _ => furniture::bin(painter, foot_m),
            }
            if random.chance(0.45) {
                let base_m = route.at(s_m + 3.2).beside(side * (FRONT_M - 0.5), PAVEMENT_M);
                furniture::planter(painter, base_m, station.forward, 1.1, &mut random);
            }
        }
    }
    for (ahead, side) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        let station = |away_m: f64| route.at(crossing_m + ahead * away_m);
        let at = |away_m: f64, t_m: f64| station(away_m).beside(side * t_m, PAVEMENT_M);
        // The light of the lane that comes towards the crossing stands on its own side before the
        // zebra; every pole has a head for the street, which is green, and one for the side street.
        let mine = ahead * side > 0.0;
        let away_m = if mine { 10.4 } else { 4.6 };
        let heads = [(ahead * station(away_m).forward, true), (side * station(away_m).left, false)];
        furniture::traffic_light(painter, at(away_m, KERB_M + 0.5), heads);
        for post in 0..3 {
            let t_m = KERB_M + 0.35;
            furniture::bollard(painter, at(10.9 + 1.4 * f64::from(post + 1), t_m));
        }
    }
}

/// Stations along the whole street, `step_m` apart. They keep clear of the houses that close its
/// ends; at an open end, the distance to the next street's first station is the same.
fn along(route: &Route, step_m: f64) -> impl Iterator<Item = f64> + use<> {
    // 14 m at the start, 10 m at the end; at an open end half a step.
    let clear = [14.0, 10.0];
    let ends = route.ends_m;
    let clear_m = |end: usize| if route.closed[end] { clear[end] } else { 0.5 * step_m };
    let from_m = ends[0] + clear_m(0);
    let to_m = ends[1] - clear_m(1);
    let steps = ((to_m - from_m) / step_m) as usize;
    // Half a step from either end there is one station more than steps between them.
    let count = if route.closed[1] { steps } else { steps + 1 };
    (0..count).map(move |i| from_m + step_m * i as f64)
}
