//! Assets of actors: the street's parked cars in more detail, a truck, a bus, a pedestrian, a
//! cyclist and a crate. Actors without an asset of their own are drawn as one of them.
//!
//! They are lit from above ([`Light::overhead`]), since an actor turns and its light does not.
//! Pictures were used to check that they look right next to the parked cars.

use glam::{DQuat, DVec3};

use wildcity_scene::{ActorBox, ActorClass, Gaussians};

use super::car_kinds::{BUS, HATCHBACK, MOVING_VAN, SEDAN, TRUCK};
use super::cars::Car;
use super::cyclist;
use super::light::Light;
use super::pedestrian;
use super::random::smooth;
use super::surface::{Paint, Painter};

/// Cells along an edge, as a multiple of those of a parked car: spacings of 2 to 4 cm.
const DETAIL: usize = 4;

/// An actor that is made by a program and not scanned.
#[derive(Clone, Debug, PartialEq)]
pub struct ActorModel {
    /// The name of its asset.
    pub name: &'static str,
    pub class: ActorClass,
    pub box_: ActorBox,
    /// Its Gaussians, of SH degree 1, in its own axes: the origin is on the ground, x points
    /// forward and z up.
    pub gaussians: Gaussians,
}

impl ActorModel {
    /// The names of all models.
    pub const NAMES: [&'static str; 8] =
        ["hatchback", "sedan", "van", "truck", "bus", "pedestrian", "bicycle", "crate"];
}

/// Counts changes of the models: assets of another revision are made again.
pub const ACTOR_REVISION: u32 = 4;

/// Cells along an edge of a truck and a bus: they have four times the surface of a car.
const LARGE_DETAIL: usize = 2;

/// All models: a red hatchback, a silver sedan, a white van, a truck, a bus, a pedestrian in
/// mid-stride, a cyclist, and a wooden crate of 1 m.
pub fn actor_models() -> Vec<ActorModel> {
    let cars = [
        ("hatchback", &HATCHBACK, Paint::matt(0.62, 0.12, 0.11), DETAIL),
        ("sedan", &SEDAN, Paint::matt(0.60, 0.62, 0.65), DETAIL),
        ("van", &MOVING_VAN, Paint::matt(0.86, 0.87, 0.88), DETAIL),
        ("truck", &TRUCK, Paint::matt(0.80, 0.79, 0.74), LARGE_DETAIL),
        ("bus", &BUS, Paint::matt(0.72, 0.60, 0.16), LARGE_DETAIL),
    ];
    let light = Light::overhead();
    let mut models: Vec<ActorModel> = Vec::new();
    for (name, kind, paint, detail) in cars {
        let car = Car::model(kind, paint);
        let mut painter = Painter::detailed(&light, detail);
        car.paint_model(&mut painter);
        let DVec3 { x: length_m, y: width_m, z: height_m } = car.size_m();
        paint_shade(&mut painter, [length_m, width_m]);
        models.push(ActorModel {
            name,
            class: ActorClass::Vehicle,
            box_: ActorBox { length_m, width_m, height_m },
            gaussians: above_ground(&painter.gaussians),
        });
    }
    // The spacings of these models are those of a near object already.
    let mut painter = Painter::detailed(&light, 1);
    pedestrian::paint(&mut painter);
    paint_shade(&mut painter, [0.8, 0.5]);
    models.push(ActorModel {
        name: "pedestrian",
        class: ActorClass::Pedestrian,
        box_: ActorBox::PEDESTRIAN,
        gaussians: painter.gaussians,
    });
    let mut painter = Painter::detailed(&light, 1);
    cyclist::paint(&mut painter);
    paint_shade(&mut painter, [1.7, 0.4]);
    models.push(ActorModel {
        name: "bicycle",
        class: ActorClass::Bicycle,
        box_: ActorBox { length_m: 1.8, width_m: 0.6, height_m: 1.75 },
        gaussians: painter.gaussians,
    });
    let mut painter = Painter::detailed(&light, 1);
    paint_crate(&mut painter);
    models.push(ActorModel {
        name: "crate",
        class: ActorClass::Object,
        box_: ActorBox { length_m: 1.0, width_m: 1.0, height_m: 1.0 },
        gaussians: painter.gaussians,
    });
    models
}

/// A crate of boards.
fn paint_crate(painter: &mut Painter) {
    // 51 break points: cells of 2 cm on a face of 1 m.
    let ends_m: Vec<f64> = (0..=50).map(|k| -0.5 + 0.02 * f64::from(k)).collect();
    let wood = Paint::matt(0.62, 0.47, 0.30);
    // Outward normal and the two directions of each face, u x v.
    let faces = [
        // No face below: the crate stands on it.
        (DVec3::X, DVec3::Y, DVec3::Z),
        (DVec3::NEG_X, DVec3::NEG_Y, DVec3::Z),
        (DVec3::Y, DVec3::NEG_X, DVec3::Z),
        (DVec3::NEG_Y, DVec3::X, DVec3::Z),
        (DVec3::Z, DVec3::X, DVec3::Y),
    ];
    for (normal, u, v) in faces {
        let place = |a_m: f64, b_m: f64| 0.5 * DVec3::Z + 0.5 * normal + a_m * u + b_m * v;
        painter.sheet(&ends_m, &ends_m, place, |a_m, b_m| {
            // A frame of 8 cm, and within it six boards with gaps of a tenth of their width.
            let is_edge = a_m.abs().max(b_m.abs()) > 0.42;
            let is_gap = ((b_m + 0.5) * 6.0).fract() < 0.1;
            Some(match (is_edge, is_gap) {
                (true, _) => wood.times(0.8),
                (false, true) => wood.times(0.35),
                (false, false) => wood,
            })
        });
    }
}

/// The soft shade on the ground below an object with its middle on the origin, which moves with it.
/// It hides 41 % of the road at most (1 - 0.78 · 0.945⁴ · 0.986⁴ of the cells around a place), so
/// that what is there is still the road.
fn paint_shade(painter: &mut Painter, [length_m, width_m]: [f64; 2]) {
    let half_m = [0.5 * length_m + 0.15, 0.5 * width_m + 0.15];
    let counts = half_m.map(|half_m| (2.0 * half_m / 0.25).ceil().max(2.0));
    let cell_m = [0, 1].map(|axis| 2.0 * half_m[axis] / counts[axis]);
    for row in 0..counts[1] as usize {
        for column in 0..counts[0] as usize {
            let x = (column as f64 + 0.5) * cell_m[0] - half_m[0];
            let y = (row as f64 + 0.5) * cell_m[1] - half_m[1];
            let inside_m = (half_m[0] - x.abs()).min(half_m[1] - y.abs());
            let opacity = 0.03 + 0.19 * smooth(inside_m / 0.4);
            let sigmas_m = DVec3::new(0.6 * cell_m[0], 0.6 * cell_m[1], 0.002);
            let mean_m = DVec3::new(x, y, 0.02);
            let rgb = DVec3::splat(0.05);
            painter.gaussian(mean_m, DQuat::IDENTITY, sigmas_m, opacity, rgb, DVec3::ZERO);
        }
    }
}

/// The Gaussians with centres above the ground. A wheel arch is a whole disc, and a road need not
/// hide its lower part.
fn above_ground(gaussians: &Gaussians) -> Gaussians {
    gaussians.select((0..gaussians.len()).filter(|&i| gaussians.means_m[i][2] >= 0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_model_fills_its_box() {
        let models = actor_models();
        let names: Vec<&str> = models.iter().map(|model| model.name).collect();
        assert_eq!(names, ActorModel::NAMES);
        for ActorModel { name, box_, gaussians, .. } in models {
            box_.check().unwrap();
            let half_m = 0.5 * DVec3::new(box_.length_m, box_.width_m, box_.height_m);
            let mut low_m = DVec3::INFINITY;
            let mut high_m = DVec3::NEG_INFINITY;
            for &mean_m in &gaussians.means_m {
                low_m = low_m.min(DVec3::from_array(mean_m));
                high_m = high_m.max(DVec3::from_array(mean_m));
            }
            // Door mirrors reach beyond a car's width, as they do beyond the width in its papers.
            // Surfels reach beyond the box by their size, too, and the shade by 0.15 m.
            let beyond_m = DVec3::new(0.15, 0.2, 0.05);
            let wanted_low_m = DVec3::new(-half_m.x, -half_m.y, 0.0);
            let wanted_high_m = DVec3::new(half_m.x, half_m.y, 2.0 * half_m.z);
            assert!(low_m.cmpge(wanted_low_m - beyond_m).all(), "{name}: {low_m}");
            assert!(high_m.cmple(wanted_high_m + beyond_m).all(), "{name}: {high_m}");
            let fills = (high_m - low_m) / (wanted_high_m - wanted_low_m);
            assert!(fills.cmpge(DVec3::splat(0.8)).all(), "{name} fills {fills} of its box");
            // From a crate to a bus.
            assert!((4_000..120_000).contains(&gaussians.len()), "{name}: {}", gaussians.len());
        }
    }
}
