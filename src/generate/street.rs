//! The plan of the street: what stands where, and the order of painting.

use super::buildings::{self, Building};
use super::cars::Car;
use super::furniture;
use super::light::Light;
use super::plants::Tree;
use super::random::Random;
use super::road::{self, FRONT_M, KERB_M, LANE_T_M, PAVEMENT_M};
use super::route::{BEYOND_M, Route};
use super::surface::Painter;
use super::{Street, StreetSettings, backdrop};

/// Middle of the parking bays, in metres from the centre line.
const BAY_T_M: f64 = 4.78;
/// Where trees, lamps and signs stand, in metres from the centre line.
const FURNITURE_T_M: f64 = KERB_M + 0.75;
/// No cars or trees this close to the middle of the crossing, in metres.
const CLEAR_M: f64 = 15.0;
/// Distance between parking bays, in metres.
const BAY_M: f64 = 6.3;
/// Distance between trees of one side, in metres; a lamp stands half way between two.
const TREE_M: f64 = 17.0;

pub(super) fn build(settings: &StreetSettings) -> Street {
    let StreetSettings { seed, length_m, crossing_m, density } = *settings;
    let route = Route::new(length_m);
    let buildings = buildings::plan(&route, crossing_m, seed);
    let (cars, trees) = (park(&route, settings), plant(&route, settings));

    let mut occluders: Vec<_> = buildings.iter().map(Building::occluder).collect();
    occluders.extend(cars.iter().flat_map(Car::occluders));
    occluders.extend(trees.iter().map(Tree::occluder));
    let light = Light::new(occluders);

    let mut painter = Painter::new(&light, density);
    road::paint(&mut painter, &route, crossing_m, seed);
    for building in &buildings {
        building.paint(&mut painter);
    }
    for car in &cars {
        car.paint(&mut painter);
    }
    for tree in &trees {
        tree.paint(&mut painter);
    }
    furnish(&mut painter, &route, settings);
    backdrop::paint(&mut painter, &route, seed);
    let trajectory = route.drive("log", LANE_T_M, 8.0);
    Street { gaussians: painter.gaussians, trajectory }
}

/// Cars in two of three bays, looking the way their side drives.
fn park(route: &Route, settings: &StreetSettings) -> Vec<Car> {
    let mut cars = Vec::new();
    for (side, name) in [(-1.0, "car, right"), (1.0, "car, left")] {
        for (index, s_m) in along(route, BAY_M).enumerate() {
            let beyond_m = route.beyond_m(s_m);
            let mut random = Random::new(settings.seed, name, index);
            let free = random.chance(0.34)
                || beyond_m > 45.0
                || (s_m - settings.crossing_m).abs() < CLEAR_M + 2.0;
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
fn plant(route: &Route, settings: &StreetSettings) -> Vec<Tree> {
    let mut trees = Vec::new();
    for (side, name) in [(-1.0, "tree, right"), (1.0, "tree, left")] {
        for (index, s_m) in along(route, TREE_M).enumerate() {
            let s_m = s_m + if side < 0.0 { 0.0 } else { 6.0 };
            let mut random = Random::new(settings.seed, name, index);
            let free = random.chance(0.12) || (s_m - settings.crossing_m).abs() < CLEAR_M;
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
fn furnish(painter: &mut Painter, route: &Route, settings: &StreetSettings) {
    for side in [-1.0, 1.0] {
        let name = if side < 0.0 { "furniture, right" } else { "furniture, left" };
        for (index, s_m) in along(route, TREE_M).enumerate() {
            let s_m = s_m + 0.5 * TREE_M + if side < 0.0 { 0.0 } else { 6.0 };
            if (s_m - settings.crossing_m).abs() < CLEAR_M {
                continue;
            }
            let mut random = Random::new(settings.seed, name, index);
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
        let station = |away_m: f64| route.at(settings.crossing_m + ahead * away_m);
        let at = |away_m: f64, t_m: f64| station(away_m).beside(side * t_m, PAVEMENT_M);
        // Each lane's light stands on its own side before the zebra; the others look at the
        // side street.
        let mine = ahead * side > 0.0;
        let facing = if mine { ahead * station(10.6).forward } else { side * station(4.6).left };
        let away_m = if mine { 10.4 } else { 4.6 };
        furniture::traffic_light(painter, at(away_m, KERB_M + 0.5), facing, mine);
        for post in 0..3 {
            let t_m = KERB_M + 0.35;
            furniture::bollard(painter, at(10.9 + 1.4 * f64::from(post + 1), t_m));
        }
    }
}

/// Stations along the whole street, `step_m` apart.
fn along(route: &Route, step_m: f64) -> impl Iterator<Item = f64> + use<> {
    let from_m = -BEYOND_M + 14.0;
    let count = ((route.length_m + 2.0 * BEYOND_M - 24.0) / step_m) as usize;
    (0..count).map(move |i| from_m + step_m * i as f64)
}
