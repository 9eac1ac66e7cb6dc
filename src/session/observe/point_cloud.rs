//! The points of a sweep: returns of the renderer with the effects of the sensor, in the rig's
//! axes.

use blake3::{Hash, Hasher};

use wildcity_options::LidarSensor;
use wildcity_render::lidar::{LidarView, Sweep};
use wildcity_scene::SemanticClass;
use wildcity_scene::random::Random;
use wildcity_scene::rig::RigLidar;

use crate::episode::Episode;
use crate::observe::layout::EffectSeed;
use crate::sensors::draw::standard_normal;

/// The returns of a sweep, row by row.
#[derive(Debug)]
pub(crate) struct PointCloud {
    /// Index of the LiDAR in the rig.
    pub(crate) lidar: usize,
    /// The sweep's time, that of its last column, in microseconds since the episode's start.
    pub(crate) time_us: i64,
    /// Positions in the rig's axes when their column was fired, in metres.
    pub(crate) points_m: Vec<[f32; 3]>,
    /// Mean luminance of what was hit.
    pub(crate) intensity: Vec<f32>,
    pub(crate) rows: Vec<u16>,
    pub(crate) columns: Vec<u16>,
    /// As the map of an image.
    pub(crate) instances: Vec<u16>,
    /// Class of each point, as in the map of an image; empty if they are not asked for.
    pub(crate) classes: Vec<SemanticClass>,
    /// BLAKE3 of its floats and then its integers.
    pub(crate) hash: Hash,
}

impl PointCloud {
    /// The points of a sweep at a time, with the effects of the sensor if it has any, and with the
    /// classes of its beams if they are asked for.
    pub(crate) fn new(
        lidar: usize,
        mounted: &RigLidar,
        (sweep, classes): (&Sweep, Option<&[SemanticClass]>),
        time_us: i64,
        effects: Option<(&LidarSensor, EffectSeed)>,
    ) -> Self {
        let beams = &mounted.lidar;
        let mut cloud = Self {
            lidar,
            time_us,
            points_m: Vec::new(),
            intensity: Vec::new(),
            rows: Vec::new(),
            columns: Vec::new(),
            instances: Vec::new(),
            classes: Vec::new(),
            // Replaced below, once the points are known.
            hash: Hasher::new().finalize(),
        };
        // A stream of its own for each sweep: a lost beam changes no other sweep.
        let mut random = effects.map(|(_, seed)| {
            Random::new(seed.seed, &format!("lidar.{}", mounted.name), time_us as usize)
        });
        for (at, &range_m) in sweep.range_m.iter().enumerate() {
            // The renderer gives a beam that hits nothing a range of 0.
            let has_return = range_m > 0.0;
            let mut range_m = f64::from(range_m);
            if let (Some((sensor, _)), Some(random)) = (effects, &mut random) {
                // Drawn for every beam, so that what one beam hits changes no other.
                let noise = standard_normal(random);
                let is_lost = random.chance(sensor.drop.unwrap_or(0.0));
                if is_lost {
                    continue;
                }
                // A return that noise moves out of the LiDAR's range stays at its end.
                if has_return {
                    let noisy_m = range_m + noise * sensor.noise_m.unwrap_or(0.0);
                    range_m = noisy_m.clamp(beams.min_range_m(), beams.max_range_m());
                }
            }
            if !has_return {
                continue;
            }
            // Beams are stored row by row.
            let row = at / beams.columns();
            let column = at % beams.columns();
            let in_lidar_m = range_m * beams.direction(row, column);
            let in_rig_m = mounted.rig_from_lidar.transform_point(in_lidar_m);
            cloud.points_m.push(in_rig_m.as_vec3().to_array());
            cloud.intensity.push(sweep.intensity[at]);
            // A LiDAR has at most 256 rows and 4,096 columns.
            cloud.rows.push(row as u16);
            cloud.columns.push(column as u16);
            cloud.instances.push(sweep.instance[at]);
            cloud.classes.extend(classes.map(|classes| classes[at]));
        }
        cloud.hash = cloud.computed_hash();
        cloud
    }

    /// The bytes of its floats: positions, then intensities.
    pub(crate) fn float_bytes(&self) -> [&[u8]; 2] {
        [bytemuck::cast_slice(&self.points_m), bytemuck::cast_slice(&self.intensity)]
    }

    /// The bytes of its integers: rows, columns, instances.
    pub(crate) fn id_bytes(&self) -> [&[u8]; 3] {
        [&self.rows, &self.columns, &self.instances].map(|ids| bytemuck::cast_slice(ids))
    }

    /// The bytes of its classes.
    pub(crate) fn class_bytes(&self) -> impl ExactSizeIterator<Item = u8> {
        self.classes.iter().map(|class| class.value())
    }

    fn computed_hash(&self) -> Hash {
        let mut hasher = Hasher::new();
        for bytes in self.float_bytes().into_iter().chain(self.id_bytes()) {
            hasher.update(bytes);
        }
        hasher.update(&self.class_bytes().collect::<Vec<u8>>());
        hasher.finalize()
    }
}

/// The motion of a LiDAR during the sweep that ends now. As for cameras, the ego was at rest before
/// the episode's start.
pub(crate) fn lidar_view(mounted: &RigLidar, episode: &Episode) -> LidarView {
    let at = |time_us: i64| episode.pose_at(time_us.max(0)) * mounted.rig_from_lidar;
    let now_us = episode.time_us();
    LidarView {
        lidar: mounted.lidar.clone(),
        world_from_lidar: at(now_us),
        world_from_lidar_first: at(now_us - mounted.lidar.duration_us()),
    }
}
