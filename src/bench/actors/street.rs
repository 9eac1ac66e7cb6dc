//! A street with cars: as actors, and as a part of the twin.

use std::f64::consts::PI;

use anyhow::Context;
use glam::{DQuat, DVec3};
use serde_json::{Value, json};

use wildcity_generate::actor_models;
use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Gaussians, Rig, Trajectory};
use wildcity_twin::store::{Catalog, NewVersion, StorageOptions, Version};

use wildcity::cli::progress;

/// The twin without cars.
pub(super) const BARE: &str = "bare";
/// The same with cars.
pub(super) const BAKED: &str = "baked";

/// Distance between the middles of two cars in a lane, in metres.
const SPACING_M: f64 = 6.0;
/// Distance of the oncoming lane to the left, in metres.
const LANE_M: f64 = 3.5;
/// Distance of the ego to the next cars in its own lane, in metres, beyond half of the spacing.
const FREE_M: f64 = 10.0;
/// Standard deviation of a half of a flat Gaussian, and distance of its middle from the whole's, as
/// shares of the whole's standard deviation: a cell of the painter's (0.66 standard deviations of a
/// cell) becomes two cells.
const HALF: [f64; 2] = [0.5, 0.25 / 0.66];

/// The cars, and the drive between them.
pub(super) struct Cars {
    pub(super) rig: Rig,
    drive: Trajectory,
    asset: String,
    places: Vec<Pose>,
}

/// Commits [`BARE`] and [`BAKED`] to a catalog and stores the car's asset there: `count` cars of
/// `gaussians` each.
pub(super) fn commit(
    source: &Catalog,
    version: &Version,
    [count, gaussians]: [u32; 2],
    into: &Catalog,
) -> anyhow::Result<Cars> {
    let manifest = &version.manifest;
    let drive = manifest
        .trajectories
        .first()
        .with_context(|| format!("twin {:?} has no trajectory", manifest.twin))?;
    let places = places(drive, count).with_context(|| format!("twin {:?}", manifest.twin))?;
    let rig = manifest.rig.clone().or_else(|| Rig::preset(wildcity_session::limits::RIG));

    // The car.
    let model = actor_models()
        .into_iter()
        .find(|model| model.name == "sedan")
        .context("there is no generated sedan")?;
    let car = refined(model.gaussians, gaussians as usize);
    let provenance = Provenance::new(format!("sedan of {} Gaussians", car.len()));
    let description = AssetDescription {
        name: "car".to_owned(),
        class: model.class,
        box_: model.box_,
        provenance: provenance.clone(),
    };
    let made = ActorAsset::new(&car, description)?;
    let asset = into.put_actor(&made, manifest.record)?.hash;

    // The twins.
    let mut all = Gaussians { sh_degree: manifest.sh_degree, ..Gaussians::default() };
    source.visit_full_detail(version, &|_| true, &mut |section| all.append(&section))?;
    let write = |name: &str, all: &Gaussians| {
        let bar = progress::count("writing");
        let new = NewVersion {
            profile: manifest.profile,
            trajectories: vec![drive.clone()],
            storage: StorageOptions { record: manifest.record, levels: true },
            ..NewVersion::from_gaussians(name, all, provenance.clone())
        };
        let written = into.commit(new, &mut progress::show(&bar));
        bar.finish_and_clear();
        written
    };
    write(BARE, &all)?;
    for place in &places {
        let mut placed = car.clone();
        placed.transform(place);
        all.append(&placed);
    }
    write(BAKED, &all)?;
    let rig = rig.context("the default rig preset is missing")?;
    Ok(Cars { rig, drive: drive.clone(), asset, places })
}

impl Cars {
    /// The ego's pose at this distance after the middle of the drive, in metres.
    pub(super) fn ego_at(&self, ahead_m: f64) -> Pose {
        self.drive.at_station(0.5 * self.drive.length_m() + ahead_m)
    }

    /// A scenario in which every car stands at its place.
    pub(super) fn scenario(&self) -> Value {
        let car = |(index, place): (usize, &Pose)| {
            let xyz = place.position_m.to_array();
            let stand = json!({ "xyz": xyz, "q": place.q_wxyz() });
            json!({ "name": format!("car-{index}"), "asset": self.asset, "stand": stand })
        };
        let cars: Vec<Value> = self.places.iter().enumerate().map(car).collect();
        json!({ "format": "wildcity.scenario/1", "name": "cars", "twin": { "name": BARE }, "actors": cars })
    }
}

/// Where the cars stand: alternately in the ego's lane, around the middle of the drive, and in the
/// oncoming lane.
fn places(drive: &Trajectory, count: u32) -> anyhow::Result<Vec<Pose>> {
    let rows = count.div_ceil(2);
    // The row in the ego's lane has a gap around the middle, of FREE_M to both sides.
    let needed_m = f64::from(rows) * SPACING_M + 2.0 * FREE_M;
    let length_m = drive.length_m();
    anyhow::ensure!(
        needed_m <= length_m,
        "its drive is {length_m:.0} m long; {count} cars need {needed_m:.0} m: give fewer --cars"
    );
    let place = |index: u32| {
        let from_middle_m = (f64::from(index / 2) - 0.5 * f64::from(rows - 1)) * SPACING_M;
        let from_ahead = index % 2 == 1;
        // Away from the middle, where the ego drives.
        let free_m = if from_ahead { 0.0 } else { FREE_M.copysign(from_middle_m) };
        let station_m = 0.5 * length_m + from_middle_m + free_m;
        let beside = if from_ahead {
            Pose { position_m: LANE_M * DVec3::Y, rotation: DQuat::from_rotation_z(PI) }
        } else {
            Pose::IDENTITY
        };
        drive.at_station(station_m) * beside
    };
    Ok((0..count).map(place).collect())
}

/// Halves the largest Gaussians along their longest axes, or leaves out the last ones, until there
/// are `count`.
fn refined(mut gaussians: Gaussians, count: usize) -> Gaussians {
    if gaussians.len() >= count {
        return gaussians.select(0..count);
    }
    while gaussians.len() < count {
        // Only whole ones are halved in this round.
        let mut order: Vec<usize> = (0..gaussians.len()).collect();
        let longest =
            |index: usize| gaussians.ln_scales[index].into_iter().fold(f32::MIN, f32::max);
        order.sort_by(|&a, &b| longest(b).total_cmp(&longest(a)));
        order.truncate(count - gaussians.len());
        for index in order {
            halve(&mut gaussians, index);
        }
    }
    gaussians
}

/// Replaces a Gaussian by its half, and appends the other half.
fn halve(gaussians: &mut Gaussians, index: usize) {
    let scales = gaussians.ln_scales[index];
    let axis = (0..3).max_by(|&a, &b| scales[a].total_cmp(&scales[b])).unwrap_or(0);
    let [w, x, y, z] = gaussians.quats_wxyz[index].map(f64::from);
    let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
    let [share, beside] = HALF;
    let along_m = rotation * DVec3::AXES[axis] * (beside * f64::from(scales[axis]).exp());
    // Scales are stored as logarithms: a product becomes a sum.
    gaussians.ln_scales[index][axis] += share.ln() as f32;
    let middle_m = DVec3::from_array(gaussians.means_m[index]);
    let one = gaussians.select([index]);
    gaussians.append(&one);
    gaussians.means_m[index] = (middle_m - along_m).to_array();
    let last = gaussians.len() - 1;
    gaussians.means_m[last] = (middle_m + along_m).to_array();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refined_car_has_the_wanted_number_and_covers_the_same() {
        let model = actor_models().remove(1);
        let own = model.gaussians;
        let more = own.len() * 5 / 2;
        let car = refined(own.clone(), more);
        assert_eq!(car.len(), more);
        let middle_m = |g: &Gaussians| {
            g.means_m.iter().map(|&m| DVec3::from_array(m)).sum::<DVec3>() / g.len() as f64
        };
        assert!(middle_m(&car).distance(middle_m(&own)) < 0.1);
        let area_m2 = |g: &Gaussians| -> f64 {
            let product = |s: &[f32; 3]| {
                let mut s = s.map(|ln| f64::from(ln).exp());
                s.sort_by(f64::total_cmp);
                s[1] * s[2]
            };
            g.ln_scales.iter().map(product).sum()
        };
        assert!((area_m2(&car) / area_m2(&own) - 1.0).abs() < 0.02);
        assert_eq!(refined(own, 100).len(), 100);
    }
}
