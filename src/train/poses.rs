//! The poses of the cameras as parameters.
//!
//! ```text
//! world_from_camera = world_from_ego exp(e) motion ego_from_camera exp(c)
//! ```
//!
//! with the recorded motion between the time of the ego's pose and that of the image, a twist e for
//! each time of the rig and a twist c for each of its cameras (the project's paper, section 4.2):
//! six cameras of 100 keyframes have 636 parameters, and not 3,600. Images without a rig have a
//! "time" each, and one camera at its origin.
//!
//! A twist is folded into its pose after each step, so that derivatives are always those at 0. What
//! keeps a pose near its recorded one is `weight (|t|² + |φ|²)`, with the translation t in metres
//! and the rotation φ in radians between the two. A sky moves no pose: it is smooth.
//!
//! The steps of Adam have the size of the learning rate, whatever the derivative is, and the rate
//! falls to a hundredth during a run: n steps at a rate r go about 0.215 n r along each axis, if
//! all have one direction. A pose of the rig has a step for each of its images, and a camera has
//! one for each of its own, which are many more. With one rate for both, the first cannot reach a
//! place that is 10 cm off in 1,500 steps. The second go several centimetres, and take the part of
//! the street that they alone see with them. So settings say how far each goes, and the rates
//! follow from the number of steps. A pose with few steps goes less far: the first images say
//! little about its place.
//!
//! The demo street after 1,500 steps from poses that are wrong by 10 cm and 0.5°, and cameras by
//! 1 cm and 0.2°: 83 mm and 0.24° on average with one rate, 36 mm and 0.13° with a reach for each.
//! The paper's rate of 1e-3 would move a pose by 9 mm here.
//!
//! What remains does not come from the start: a run from the true poses ends 27 mm and 0.13° away
//! from them. While the Gaussians are still round, roofs are drawn too thick, and all cameras turn
//! away from them; the street follows, and comes back slowly. Poses that wait for a tenth of the
//! run end 20 mm and 0.09° away if they were true, and 56 mm and 0.15° if they were wrong, since
//! the Gaussians have learned these. Normal equations of each image (Kerl et al. 2013, robust
//! visual odometry) in place of Adam have the same bias: 74 mm and 0.27°.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use wildcity_render::gradient::{RigTwists, Twist};
use wildcity_render::{RollingShutter, View};
use wildcity_scene::geometry::Pose;

use crate::adam::Adam;
use crate::settings::{PoseMode, PoseSettings};

/// The poses of a rig at all times, and of its cameras.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RigPoses {
    #[serde(with = "numbers")]
    pub world_from_ego: Vec<Pose>,
    #[serde(with = "numbers")]
    pub ego_from_camera: Vec<Pose>,
}

/// Which poses of a [`RigPoses`] an image has, by their indices.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    pub ego: usize,
    pub camera: usize,
    /// The recorded motion of the rig from the time of the ego's pose to that of the image: the
    /// identity if these are the same.
    pub motion: Pose,
}

impl Place {
    /// An image that was taken at the time of the ego's pose.
    pub fn new(ego: usize, camera: usize) -> Self {
        Self { ego, camera, motion: Pose::IDENTITY }
    }
}

/// Poses while they are trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct TrainedPoses {
    recorded: RigPoses,
    now: RigPoses,
    egos: Vec<Adam>,
    cameras: Vec<Adam>,
    /// Which part of all steps moves each pose of the rig, and each camera.
    shares: [Vec<f64>; 2],
}

/// Which poses one step moves, and how.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PoseStep {
    pub(crate) place: Place,
    /// The derivatives by the view's twist.
    pub(crate) by: Twist,
    /// Of the ego and of the camera, each in metres and in radians.
    pub(crate) rates: [[f64; 2]; 2],
    /// Of the squared distance to the recorded pose.
    pub(crate) weight: f64,
}

/// How far each pose has moved from the recorded one: metres, and radians.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PoseMoves {
    /// Of each time of the rig, or of each image.
    pub egos: Vec<[f64; 2]>,
    /// Of each camera on the rig.
    pub cameras: Vec<[f64; 2]>,
}

impl RigPoses {
    /// The pose of the camera of an image.
    ///
    /// # Panics
    /// The rig does not have the place.
    pub fn world_from_camera(&self, place: Place) -> Pose {
        self.world_from_ego[place.ego] * place.motion * self.ego_from_camera[place.camera]
    }

    pub(crate) fn has(&self, place: Place) -> bool {
        place.ego < self.world_from_ego.len() && place.camera < self.ego_from_camera.len()
    }
}

impl TrainedPoses {
    pub(crate) fn new(recorded: RigPoses) -> Self {
        let moments = |poses: &[Pose]| vec![Adam::new(6); poses.len()];
        Self {
            egos: moments(&recorded.world_from_ego),
            cameras: moments(&recorded.ego_from_camera),
            shares: [&recorded.world_from_ego, &recorded.ego_from_camera]
                .map(|poses| vec![1.0 / poses.len().max(1) as f64; poses.len()]),
            now: recorded.clone(),
            recorded,
        }
    }

    pub(crate) fn now(&self) -> &RigPoses {
        &self.now
    }

    pub(crate) fn moves(&self) -> PoseMoves {
        let moved = |recorded: &[Pose], now: &[Pose]| {
            let both = recorded.iter().zip(now);
            let moved = both.map(|(recorded, now)| {
                let Pose { position_m, rotation } = recorded.inverse() * *now;
                [position_m.length(), rotation.to_scaled_axis().length()]
            });
            moved.collect()
        };
        let Self { recorded, now, .. } = self;
        PoseMoves {
            egos: moved(&recorded.world_from_ego, &now.world_from_ego),
            cameras: moved(&recorded.ego_from_camera, &now.ego_from_camera),
        }
    }

    /// Counts the images from which each pose learns; until then all have as many.
    pub(crate) fn count(&mut self, places: &[Option<Place>]) {
        for shares in &mut self.shares {
            shares.fill(0.0);
        }
        let each = 1.0 / places.len().max(1) as f64;
        for place in places.iter().flatten() {
            for (shares, pose) in self.shares.iter_mut().zip([place.ego, place.camera]) {
                if let Some(share) = shares.get_mut(pose) {
                    *share += each;
                }
            }
        }
    }

    /// The learning rates of the first step of a run for the two poses of an image, each in metres
    /// and in radians.
    pub(crate) fn rates(
        &self,
        place: Place,
        settings: &PoseSettings,
        steps: usize,
    ) -> [[f64; 2]; 2] {
        let PoseSettings { reach_m, reach_rad, camera_reach_m, camera_reach_rad, mode, .. } =
            *settings;
        let rates = |share: f64, reaches: [f64; 2]| {
            let of_reach = share_of_reach(share * steps as f64);
            reaches.map(|reach| of_reach * reach)
        };
        let of_ego = rates(self.shares[0][place.ego], [reach_m, reach_rad]);
        // An image with a pose of its own has no camera on a rig.
        if mode == PoseMode::Image {
            return [of_ego, [0.0; 2]];
        }
        [of_ego, rates(self.shares[1][place.camera], [camera_reach_m, camera_reach_rad])]
    }

    /// A view at the pose that it has now, with both ends of its exposure moved alike.
    pub(crate) fn view(&self, view: View, place: Place) -> View {
        let world_from_camera = self.now.world_from_camera(place);
        // As a twist moves it (`View::twisted`).
        let moved = view.world_from_camera.inverse() * world_from_camera;
        let rolling_shutter = view.rolling_shutter.map(|shutter| RollingShutter {
            world_from_camera_first: shutter.world_from_camera_first * moved,
            ..shutter
        });
        View { world_from_camera, rolling_shutter, ..view }
    }

    /// Moves the two poses of a view.
    pub(crate) fn step(&mut self, step: &PoseStep) {
        let PoseStep { place, by, rates, weight } = *step;
        let Place { ego, camera, motion } = place;
        let twists = by.on_rig(&(motion * self.now.ego_from_camera[camera]));
        let RigTwists { ego: by_ego, camera: by_camera } = twists;
        let RigPoses { world_from_ego, ego_from_camera } = &mut self.now;
        let recorded = &self.recorded;
        let both = [
            (&mut world_from_ego[ego], recorded.world_from_ego[ego], by_ego, &mut self.egos[ego]),
            (
                &mut ego_from_camera[camera],
                recorded.ego_from_camera[camera],
                by_camera,
                &mut self.cameras[camera],
            ),
        ];
        for ((pose, recorded, by, adam), [rate, rotation_rate]) in both.into_iter().zip(rates) {
            let Pose { position_m, rotation } = recorded.inverse() * *pose;
            let off = Twist { rho: position_m, phi: rotation.to_scaled_axis() };
            // Of |t|² in the axes of the pose that moves.
            let pull = |off: DVec3| 2.0 * weight * (rotation.inverse() * off);
            let by = Twist { rho: by.rho + pull(off.rho), phi: by.phi + pull(off.phi) };
            // At a rate of 1, since metres and radians have rates of their own.
            let moves = adam.step(&by.to_array(), 1.0);
            let [moved_m, turned] = [0, 3].map(|k| DVec3::from_slice(&moves[k..]));
            let twist = Twist { rho: rate * moved_m, phi: rotation_rate * turned };
            let Pose { position_m, rotation } = *pose * twist.exp();
            // A product of many rotations drifts from unit length.
            *pose = Pose { position_m, rotation: rotation.normalize() };
        }
    }
}

/// The first learning rate of a pose with some steps, as a share of how far it goes.
fn share_of_reach(steps: f64) -> f64 {
    // The mean of a rate that falls to a hundredth, in first rates: (1 - 0.01) / ln 100.
    const MEAN: f64 = 0.215;
    // From 37 steps on it goes as far as it may: 1 / (0.215 x 37) = 37 / 300.
    (1.0 / (MEAN * steps.max(1.0))).min(steps / 300.0)
}

/// Poses as seven numbers each, so that a file keeps every bit of them.
mod numbers {
    use glam::{DQuat, DVec3};
    use serde::{Deserialize, Deserializer, Serialize, Serializer};
    use wildcity_scene::geometry::Pose;

    pub(super) fn serialize<S: Serializer>(poses: &[Pose], to: S) -> Result<S::Ok, S::Error> {
        let numbers = |pose: &Pose| (pose.position_m.to_array(), pose.rotation.to_array());
        poses.iter().map(numbers).collect::<Vec<_>>().serialize(to)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<Pose>, D::Error> {
        let numbers: Vec<([f64; 3], [f64; 4])> = Deserialize::deserialize(from)?;
        let pose = |(position_m, rotation)| Pose {
            position_m: DVec3::from_array(position_m),
            rotation: DQuat::from_array(rotation),
        };
        Ok(numbers.into_iter().map(pose).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How far a pose of the rig and a camera go in a run whose derivatives all have one direction.
    fn gone(steps: usize, mode: PoseMode) -> [f64; 2] {
        let settings =
            PoseSettings { mode, reach_m: 1.0, camera_reach_m: 0.01, ..PoseSettings::default() };
        let mut poses = TrainedPoses::new(RigPoses {
            world_from_ego: vec![Pose::IDENTITY; 5],
            // The rig has four, of which one took images.
            ego_from_camera: vec![Pose::IDENTITY; 4],
        });
        let place = |step: usize| Place::new(step % 5, 2);
        let places: Vec<Option<Place>> = (0..5).map(|step| Some(place(step))).collect();
        poses.count(&places);
        let by = Twist { rho: DVec3::X, phi: DVec3::ZERO };
        for step in 0..steps {
            let fall = 0.01_f64.powf(step as f64 / steps as f64);
            let first_rates = poses.rates(place(step), &settings, steps);
            let rates = first_rates.map(|rates| rates.map(|rate| rate * fall));
            poses.step(&PoseStep { place: place(step), by, rates, weight: 0.0 });
        }
        let moves = poses.moves();
        [moves.egos[1][0], moves.cameras[2][0]]
    }

    #[test]
    fn a_pose_goes_as_far_as_it_may_and_less_with_few_steps() {
        for steps in [200, 1_000, 5_000] {
            let [ego_m, camera_m] = gone(steps, PoseMode::Rig);
            assert!((0.95..1.05).contains(&ego_m), "{steps} steps: {ego_m}");
            assert!((0.0095..0.0105).contains(&camera_m), "{steps} steps: {camera_m}");
        }
        // Five steps of each: 0.215 x 5 x 5 / 300 of the way, and somewhat more as they are few.
        let [ego_m, camera_m] = gone(25, PoseMode::Rig);
        assert!((0.015..0.05).contains(&ego_m), "{ego_m}");
        assert!((0.003..0.01).contains(&camera_m), "{camera_m}");
    }

    #[test]
    fn a_camera_of_images_with_poses_of_their_own_stays() {
        let [ego_m, camera_m] = gone(1_000, PoseMode::Image);
        assert!(ego_m > 0.9 && camera_m == 0.0, "{ego_m} {camera_m}");
    }
}
