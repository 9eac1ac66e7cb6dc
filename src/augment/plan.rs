//! Where the views of a round are.

use glam::DVec3;

use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;

use crate::AugmentError;
use crate::limits::{EVERY_M, MOST_OFFSET_M, MOST_ROUNDS, ROUND_M};

/// Centimetres of a metre: names have distances to whole centimetres.
const CM: f64 = 100.0;

/// The views of one round: at regular distances along each drive, on both sides of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    round: u32,
    offsets_m: Vec<f64>,
    every_m: f64,
}

/// A pose of the rig at a lateral offset from a drive.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    /// Name of the drive.
    pub trajectory: String,
    /// Along the drive, in metres from its start.
    pub station_m: f64,
    /// Lateral offset from the drive, in metres: positive to the left.
    pub offset_m: f64,
    /// Pose of the rig in the world: that of the drive at the station, moved along the rig's y axis
    /// (left).
    pub world_from_rig: Pose,
}

impl Plan {
    /// A plan with the requested offsets and the distance of two stations, in metres; both are
    /// rounded to centimetres.
    ///
    /// ```
    /// use wildcity_augment::Plan;
    ///
    /// // Round 3 moves by 3 x 0.5 m, but not beyond what is wanted.
    /// let plan = Plan::new(3, &[1.0, 3.0, 5.0], 2.0)?;
    /// assert_eq!(plan.offsets_m(), [1.0, -1.0, 1.5, -1.5]);
    /// # Ok::<(), wildcity_augment::AugmentError>(())
    /// ```
    ///
    /// # Errors
    /// [`AugmentError::Number`] names the option that is out of range.
    pub fn new(round: u32, wanted_m: &[f64], every_m: f64) -> Result<Self, AugmentError> {
        let number =
            |field, value, expected: String| AugmentError::Number { field, value, expected };
        if !(1..=MOST_ROUNDS).contains(&round) {
            let expected = format!("a round from 1 to {MOST_ROUNDS}");
            return Err(number("--round", round.into(), expected));
        }
        // At least what a name can tell: centimetres.
        let is_offset = |offset_m: &f64| (0.01..=MOST_OFFSET_M).contains(offset_m);
        let wrong = wanted_m.iter().copied().find(|offset_m| !is_offset(offset_m));
        // A NaN is in no range; an empty list is reported as one.
        if let Some(value) = wrong.or(wanted_m.is_empty().then_some(f64::NAN)) {
            let expected = format!("metres from 0.01 to {MOST_OFFSET_M}, separated by commas");
            return Err(number("--offsets", value, expected));
        }
        let [least_m, most_m] = EVERY_M;
        if !(least_m..=most_m).contains(&every_m) {
            let expected = format!("metres from {least_m} to {most_m}");
            return Err(number("--every", every_m, expected));
        }
        let mut offsets_m: Vec<f64> = wanted_m.iter().copied().map(rounded).collect();
        offsets_m.sort_by(f64::total_cmp);
        offsets_m.dedup();
        Ok(Self { round, offsets_m, every_m: rounded(every_m) })
    }

    /// The round, from 1 on.
    pub fn round(&self) -> u32 {
        self.round
    }

    /// The requested offsets, ascending, in metres.
    pub fn wanted_m(&self) -> &[f64] {
        &self.offsets_m
    }

    /// Distance of two stations, in metres.
    pub fn every_m(&self) -> f64 {
        self.every_m
    }

    /// The offsets of the round, in metres, left (positive) and right of the drive: for each
    /// requested one `min(0.5 m x round, wanted)`, without repetitions.
    pub fn offsets_m(&self) -> Vec<f64> {
        // Ascending, as the wanted ones are: those beyond the round's reach become equal, and
        // `dedup` removes them.
        let reached_m = ROUND_M * f64::from(self.round);
        let mut offsets_m: Vec<f64> =
            self.offsets_m.iter().map(|wanted_m| wanted_m.min(reached_m)).collect();
        offsets_m.dedup();
        offsets_m.into_iter().flat_map(|offset_m| [offset_m, -offset_m]).collect()
    }

    /// All places, in order of the drives, the stations and the offsets.
    ///
    /// # Errors
    /// There is no drive.
    pub fn places(&self, drives: &[Trajectory]) -> Result<Vec<Place>, AugmentError> {
        if drives.is_empty() {
            return Err(AugmentError::NoDrive);
        }
        let offsets_m = self.offsets_m();
        let mut places = Vec::new();
        for drive in drives {
            // The last station is the end of the drive even if its length is a little too short in
            // f64.
            let steps = (drive.length_m() / self.every_m + 1e-9).floor() as usize;
            for step in 0..=steps {
                // The station of the name is exactly that of the pose.
                let station_m = rounded(step as f64 * self.every_m);
                let on_drive = drive.at_station(station_m);
                places.extend(offsets_m.iter().map(|offset_m| Place {
                    trajectory: drive.name.clone(),
                    station_m,
                    offset_m: *offset_m,
                    world_from_rig: on_drive
                        * Pose { position_m: *offset_m * DVec3::Y, ..Pose::IDENTITY },
                }));
            }
        }
        Ok(places)
    }
}

impl Place {
    /// The name of a camera's image at the place: `CAMERA/DRIVE_STATION_SIDE.png`, such as
    /// `front/log_00012.00_left1.50.png`. The order of names is that of the stations up to 100 km.
    pub fn image_name(&self, camera: &str) -> String {
        let side = if self.offset_m < 0.0 { "right" } else { "left" };
        let Self { trajectory, station_m, offset_m, .. } = self;
        format!("{camera}/{trajectory}_{station_m:08.2}_{side}{:.2}.png", offset_m.abs())
    }
}

fn rounded(metres: f64) -> f64 {
    (metres * CM).round() / CM
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::f64::consts::FRAC_PI_2;

    use glam::DQuat;
    use wildcity_scene::trajectory::Keyframe;

    use super::*;

    fn drive(name: &str, length_m: f64) -> Trajectory {
        let keyframe = |at: u32| Keyframe {
            time_us: i64::from(at),
            world_from_rig: Pose {
                // Northwards: left is west.
                position_m: f64::from(at) * length_m / 3.0 * DVec3::Y,
                rotation: DQuat::from_rotation_z(FRAC_PI_2),
            },
        };
        Trajectory { name: name.to_owned(), keyframes: (0..=3).map(keyframe).collect() }
    }

    #[test]
    fn a_round_moves_half_a_metre_up_to_what_is_wanted() {
        let offsets_m = |round| Plan::new(round, &[5.0, 1.0, 3.0, 1.0], 2.0).unwrap().offsets_m();
        assert_eq!(offsets_m(1), [0.5, -0.5]);
        assert_eq!(offsets_m(2), [1.0, -1.0]);
        assert_eq!(offsets_m(5), [1.0, -1.0, 2.5, -2.5]);
        assert_eq!(offsets_m(40), [1.0, -1.0, 3.0, -3.0, 5.0, -5.0]);
    }

    #[test]
    fn places_are_beside_each_drive_up_to_its_end() {
        // Round 2 reaches 1 m: 0.3 m as wanted, and 1 m of the 4 m. 2.1 m have four
        // stations, 0.5 m one.
        let plan = Plan::new(2, &[0.3, 4.0], 0.7).unwrap();
        let places = plan.places(&[drive("a", 2.1), drive("b", 0.5)]).unwrap();
        assert_eq!(places.len(), 4 * (4 + 1));
        let last = &places[4 * 3 + 1];
        assert_eq!((last.station_m, last.offset_m), (2.1, -0.3));
        // Northwards, the right side is east: 0.3 m along x.
        let expected_m = DVec3::new(0.3, 2.1, 0.0);
        assert!(last.world_from_rig.position_m.distance(expected_m) < 1e-12, "{last:?}");
        assert_eq!(last.image_name("front"), "front/a_00002.10_right0.30.png");
        let names: BTreeSet<String> = places.iter().map(|place| place.image_name("x")).collect();
        assert_eq!(names.len(), places.len());
    }

    #[test]
    fn what_is_out_of_range_is_named() {
        let said = |round, offsets: &[f64], every| {
            Plan::new(round, offsets, every).unwrap_err().to_string()
        };
        assert!(said(0, &[1.0], 2.0).contains("--round is 0;"), "{}", said(0, &[1.0], 2.0));
        assert!(said(1, &[1.0, -3.0], 2.0).contains("--offsets is -3;"));
        assert!(said(1, &[f64::NAN], 2.0).contains("--offsets is NaN"));
        assert!(said(1, &[], 2.0).contains("--offsets"));
        assert!(said(1, &[1.0], 0.0).contains("--every is 0; give metres from 0.1 to 1000"));
        let plan = Plan::new(1, &[1.0], 2.0).unwrap();
        assert!(plan.places(&[]).unwrap_err().to_string().contains("wildcity twin drive"));
    }
}
