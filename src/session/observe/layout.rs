//! Layout of the observations of a session: the cameras, their encoding and maps, and which frames
//! of them are rendered when.

use std::collections::BTreeMap;

use wildcity_options::{CameraSensor, LidarSensor, Sensors};
use wildcity_render::{MAX_VIEWS, View};
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::FieldMask;
use wildcity_scene::rig::{Rig, RigCamera, RigLidar};

use super::encode::{ImageEncoding, PixelMaps};
use super::frame_history::{FrameHistory, PastFrame};
use super::schedule::Schedule;
use crate::episode::Episode;
use crate::error::SessionError;
use crate::limits;
use crate::repair::drawn::MAX_REPORTED_REFERENCES;
use crate::sensors::EpisodeSensors;
use crate::sensors::delivery::{Delivery, FrameSource};
use crate::sensors::pixels::PixelEffects;
use crate::sensors::{check, settings};
use crate::viewpoint::{longest_exposure_us, rig_viewpoints};
use wildcity_twin::residency::Viewpoint;

/// Bytes of the header's length, little-endian, which comes before the header.
pub const HEADER_PREFIX_BYTES: usize = 8;

/// Room for the parts of the header that do not repeat: names of at most 64 bytes, hashes of 64,
/// the ego's 15 numbers of at most 24 digits, 16 stages of 60 bytes: below 2 kB.
const HEADER_BASE_BYTES: usize = 4096;

/// Room in the header per image: five tensors of at most 190 bytes, and 16 numbers of at most 24
/// digits, two names and a hash with their escaped keys, below 1,900 bytes; a lens of 12 numbers
/// and a windshield of 42 with their keys, below 1,600 bytes.
const HEADER_IMAGE_BYTES: usize = 3584;

/// Room in the header per image for the tensor of classes, if the session asks for it.
const SEMANTICS_IMAGE_BYTES: usize = 192;

/// Room in the header per LiDAR: five tensors of at most 170 bytes, and a description with two
/// names and a hash, with their escaped keys, below 700 bytes.
const HEADER_LIDAR_BYTES: usize = 2048;

/// Room in the header per image for the result of its repair: three texts, one of them a hash.
const REPAIR_IMAGE_BYTES: usize = 256;

/// Room in the header per image for the names of references: each has the names of a drive and of a
/// camera, of 64 bytes, and a number.
const REFERENCES_IMAGE_BYTES: usize = MAX_REPORTED_REFERENCES * 160;

/// Room in the header per image for the effects of its camera: five reasons, three numbers and a
/// hash.
const SENSOR_IMAGE_BYTES: usize = 512;

/// Largest number of images of one answer, whether of several poses or of several times.
const IMAGES: usize = limits::OBSERVE_POSES * Rig::MAX_CAMERAS;
const _: () = assert!(limits::BUNDLE_FRAMES <= limits::OBSERVE_POSES);

// A client accepts the longest header, and the renderer renders any rig in one frame. 4,096 + 4 x
// 2,048 + 256 x (3,584 + 192 + 256) = 1,044,480 bytes, of 1,048,576. Names of references and
// effects of sensors are checked when a session asks for them.
const _: () = assert!(
    HEADER_BASE_BYTES
        + Rig::MAX_LIDARS * HEADER_LIDAR_BYTES
        + IMAGES * (HEADER_IMAGE_BYTES + SEMANTICS_IMAGE_BYTES + REPAIR_IMAGE_BYTES)
        <= limits::OBSERVATION_HEADER_BYTES as usize
);
const _: () = assert!(Rig::MAX_CAMERAS <= MAX_VIEWS);

/// Layout of the observations of a session.
#[derive(Debug)]
pub(crate) struct ObservationLayout {
    cameras: Vec<RigCamera>,
    lidars: Vec<RigLidar>,
    /// The share of each camera's image that its lens sees; `None` if that is all of it.
    visible_shares: Vec<Option<f64>>,
    encoding: ImageEncoding,
    maps: PixelMaps,
    schedule: Schedule,
    /// Room in the header for the state of a scenario.
    scenario_bytes: usize,
    /// Room in the header per image.
    image_bytes: usize,
    /// Effects of the sensors, if there are any.
    sensors: Option<SensorLayout>,
}

/// The effects of a session's sensors.
#[derive(Debug)]
pub(crate) struct SensorLayout {
    pub(crate) settings: Sensors,
    /// Effects of each camera, by its index.
    cameras: Vec<CameraSensor>,
}

/// Views that are rendered in one frame: some cameras of the rig, at one pose and time.
#[derive(Clone, Debug)]
pub(crate) struct RigCapture {
    /// Where the rig is.
    pub(crate) world_from_rig: Pose,
    /// When the pictures are taken, in microseconds since the episode's start.
    pub(crate) time_us: i64,
    /// When the frames are due. Only a camera with sensor effects shows a picture of an earlier
    /// time.
    pub(crate) due_us: i64,
    /// Whether the effects of sensors apply. They do not for `observe`, which shows the scene.
    pub(crate) has_sensor_effects: bool,
    /// Indices of the cameras; there may be none.
    pub(crate) cameras: Vec<usize>,
    /// Whether the observation shows the images now. Otherwise they are rendered for the frame
    /// history.
    pub(crate) shown: bool,
}

/// Seed and start time of the episode, from which the sensor effects are derived.
#[derive(Clone, Copy, Debug)]
pub(crate) struct EffectSeed {
    pub(crate) seed: u64,
    /// Start of the episode or of its warm-up, in microseconds.
    pub(crate) begin_us: i64,
}

impl EffectSeed {
    pub(crate) fn from_episode(episode: &Episode) -> Self {
        Self { seed: episode.seed(), begin_us: episode.begin_us() }
    }
}

/// Bytes that the renderer writes straight into the observation's buffer.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct InPlaceBytes {
    /// Bytes of the float maps.
    pub(super) floats: usize,
    /// Bytes of the instances.
    pub(super) instances: usize,
    /// Bytes of the classes.
    pub(super) semantics: usize,
    /// Bytes of raw pixels.
    pub(super) raw: usize,
}

/// A frame of the history that an observation shows.
pub(super) struct EarlierFrame<'a> {
    /// Age in frames of its camera: 1 is the second newest frame.
    pub(super) back: usize,
    pub(super) frame: &'a PastFrame,
}

impl ObservationLayout {
    /// # Errors
    /// The JPEG quality is out of range, or the images of one observation have too many pixels.
    pub(crate) fn new(
        cameras: Vec<RigCamera>,
        encoding: ImageEncoding,
        maps: PixelMaps,
        schedule: Schedule,
    ) -> Result<Self, SessionError> {
        if let ImageEncoding::Jpeg(quality) = encoding
            && !(1..=100).contains(&quality)
        {
            let must = format!("{quality}; 1 to 100 are accepted");
            return Err(SessionError::OutOfRange { field: "outputs.quality", must });
        }
        // Once for a session: its cameras do not change.
        let visible_share = |RigCamera { camera, .. }: &RigCamera| {
            FieldMask::from_camera(camera).map(|field| field.visible_share(camera))
        };
        let visible_shares = cameras.iter().map(visible_share).collect();
        let of_semantics = if maps.semantics { SEMANTICS_IMAGE_BYTES } else { 0 };
        let layout = Self {
            cameras,
            lidars: Vec::new(),
            visible_shares,
            encoding,
            maps,
            schedule,
            scenario_bytes: 0,
            image_bytes: HEADER_IMAGE_BYTES + of_semantics,
            sensors: None,
        };
        // The largest answer to a step has all frames of all cameras.
        layout.check_size("outputs", layout.schedule.frames())?;
        Ok(layout)
    }

    /// Adds the LiDARs of the rig. Comes before [`Self::add_sensors`].
    #[must_use]
    pub(crate) fn with_lidars(self, lidars: Vec<RigLidar>) -> Self {
        Self { lidars, ..self }
    }

    /// Room in the header for what images and a scenario do not take.
    fn base_bytes(&self) -> usize {
        HEADER_BASE_BYTES + self.lidars.len() * HEADER_LIDAR_BYTES
    }

    /// The viewpoints of all cameras and LiDARs at a pose of the rig.
    pub(crate) fn viewpoints(&self, world_from_rig: Pose) -> Vec<Viewpoint> {
        rig_viewpoints(&self.cameras, &self.lidars, world_from_rig)
    }

    /// The LiDARs, in the order of the sweeps of an observation.
    pub(crate) fn lidars(&self) -> &[RigLidar] {
        &self.lidars
    }

    /// The effects on a LiDAR's sweeps, if it has any.
    pub(crate) fn lidar_sensor(&self, lidar: usize) -> Option<&LidarSensor> {
        self.sensors.as_ref()?.settings.lidars.get(&self.lidars[lidar].name)
    }

    /// The longest time that an image or a sweep takes, in microseconds.
    pub(crate) fn longest_exposure_us(&self) -> i64 {
        longest_exposure_us(&self.cameras, &self.lidars)
    }

    /// Reserves room in the headers for the results of repair. Comes before
    /// [`Self::reserve_header`].
    pub(crate) fn reserve_repair(&mut self) {
        self.image_bytes += REPAIR_IMAGE_BYTES;
    }

    /// Reserves room in the headers for the names of the images that a repair model compares with.
    /// Comes before [`Self::reserve_header`].
    ///
    /// # Errors
    /// The largest header would be longer than clients accept.
    pub(crate) fn reserve_references(&mut self) -> Result<(), SessionError> {
        self.image_bytes += REFERENCES_IMAGE_BYTES;
        let images = self.schedule.frames() * self.cameras.len();
        let most = limits::OBSERVATION_HEADER_BYTES as usize;
        let needed = self.base_bytes() + images * self.image_bytes;
        if needed <= most {
            return Ok(());
        }
        let must = format!(
            "set for {images} images, whose header would have {needed} bytes; at most {most} are accepted: request fewer \
             images"
        );
        Err(SessionError::OutOfRange { field: "repair", must })
    }

    /// Adds effects of the sensors.
    ///
    /// # Errors
    /// Names the first setting that is out of range, or `sensors` if the largest header would be
    /// longer than clients accept.
    pub(crate) fn add_sensors(
        &mut self,
        settings: Sensors,
        dt_us: i64,
    ) -> Result<(), SessionError> {
        let cameras = check::check(&settings, &self.cameras, &self.lidars, &self.schedule, dt_us)?;
        // Motion sensors alone add nothing to the description of an image.
        if !settings.cameras.is_empty() {
            self.image_bytes += SENSOR_IMAGE_BYTES;
        }
        let images = self.schedule.frames() * self.cameras.len();
        let most = limits::OBSERVATION_HEADER_BYTES as usize;
        let needed = self.base_bytes() + images * self.image_bytes;
        if needed > most {
            let must = format!(
                "set for {images} images, whose header would have {needed} bytes; at most {most} are accepted: request \
                 fewer images"
            );
            return Err(SessionError::OutOfRange { field: "sensors", must });
        }
        self.sensors = Some(SensorLayout { settings, cameras });
        Ok(())
    }

    /// The settings of the sensors, if they have effects.
    pub(crate) fn sensors(&self) -> Option<&Sensors> {
        self.sensors.as_ref().map(|sensors| &sensors.settings)
    }

    /// The effects on a camera's images, if it has any.
    pub(crate) fn sensor(&self, camera: usize) -> Option<&CameraSensor> {
        let sensor = self.sensors.as_ref().map(|sensors| &sensors.cameras[camera]);
        // A camera with default settings is one that the session did not name.
        sensor.filter(|sensor| **sensor != CameraSensor::default())
    }

    /// State of the sensors of an episode at its start; `None` without effects.
    pub(crate) fn episode_sensors(&self) -> Option<EpisodeSensors> {
        let SensorLayout { settings, cameras } = self.sensors.as_ref()?;
        let camera_reach_us = |(camera, sensor): (usize, &CameraSensor)| {
            settings::reach_us(sensor, self.schedule.period_us(camera))
        };
        // The track of poses has to reach back as far as the slowest camera.
        let reach_us = cameras.iter().enumerate().map(camera_reach_us).max().unwrap_or(0);
        Some(EpisodeSensors::at_start(settings, reach_us))
    }

    /// The frame that a camera delivers in an episode when a frame is due, in microseconds.
    pub(crate) fn delivery(&self, camera: usize, of: EffectSeed, due_us: i64) -> Delivery {
        // Noise alone leaves the times as they are.
        let changed = self.sensor(camera).filter(|sensor| settings::changes_times(sensor));
        let Some(sensor) = changed else {
            return Delivery { stamp_us: due_us, taken_us: due_us, missing: None };
        };
        let name = &self.cameras[camera].name;
        let period_us = self.schedule.period_us(camera);
        let EffectSeed { seed, begin_us } = of;
        FrameSource { sensor, name, seed, period_us, begin_us }.at(due_us)
    }

    /// The effects on the pixels of a camera's picture of a time, in microseconds, if there are
    /// any.
    pub(crate) fn pixel_effects(
        &self,
        camera: usize,
        of: EffectSeed,
        taken_us: i64,
    ) -> Option<PixelEffects> {
        let sensor = self.sensor(camera)?;
        let mounted = &self.cameras[camera];
        let size_px = [mounted.camera.width_px, mounted.camera.height_px];
        PixelEffects::new(sensor, of.seed, &mounted.name, taken_us, size_px)
    }

    pub(crate) fn cameras(&self) -> &[RigCamera] {
        &self.cameras
    }

    /// The share of a camera's image that its lens sees; `None` if that is all of it.
    pub(crate) fn visible_share(&self, camera: usize) -> Option<f64> {
        self.visible_shares[camera]
    }

    pub(crate) fn encoding(&self) -> ImageEncoding {
        self.encoding
    }

    pub(crate) fn maps(&self) -> PixelMaps {
        self.maps
    }

    pub(crate) fn schedule(&self) -> &Schedule {
        &self.schedule
    }

    /// Captures to render for an observation of the present time of an episode: the frames that
    /// this observation or a later one contains and that are not in the history. One capture per
    /// time; the last one is that of the present time, and may have no cameras. Cameras whose
    /// picture is of another time have captures of their own.
    pub(crate) fn captures(&self, episode: &Episode, history: &FrameHistory) -> Vec<RigCapture> {
        self.captures_beside(episode, &|camera, time_us| history.find(camera, time_us).is_some())
    }

    /// As [`Self::captures`], with a history of the frames of which `is_kept` (camera, time in
    /// microseconds) is true.
    pub(crate) fn captures_beside(
        &self,
        episode: &Episode,
        is_kept: &dyn Fn(usize, i64) -> bool,
    ) -> Vec<RigCapture> {
        let now_us = episode.time_us();
        // By the time when they are due, and that when their pictures are taken, which is not
        // later.
        // The entry of now exists without cameras too. It has the greatest key, so that it becomes
        // the last capture.
        let mut cameras_by_time = BTreeMap::from([([now_us, now_us], Vec::new())]);
        for camera in 0..self.cameras.len() {
            for due_us in self.schedule.due(camera, now_us) {
                // There is no pose before the track begins.
                if due_us >= episode.begin_us() && !is_kept(camera, due_us) {
                    let taken_us =
                        self.delivery(camera, EffectSeed::from_episode(episode), due_us).taken_us;
                    cameras_by_time.entry([due_us, taken_us]).or_default().push(camera);
                }
            }
        }
        let capture = |([due_us, time_us], cameras): ([i64; 2], Vec<usize>)| RigCapture {
            world_from_rig: episode.pose_at(time_us),
            time_us,
            due_us,
            has_sensor_effects: true,
            cameras,
            shown: due_us == now_us && self.schedule.is_decision(now_us),
        };
        cameras_by_time.into_iter().map(capture).collect()
    }

    /// All cameras at poses that the ego need not be at, as `observe` requests them.
    pub(crate) fn captures_at(&self, episode: &Episode, poses: Vec<Pose>) -> Vec<RigCapture> {
        let cameras: Vec<usize> = (0..self.cameras.len()).collect();
        let capture = |world_from_rig| RigCapture {
            world_from_rig,
            time_us: episode.time_us(),
            due_us: episode.time_us(),
            has_sensor_effects: false,
            cameras: cameras.clone(),
            shown: true,
        };
        poses.into_iter().map(capture).collect()
    }

    /// How long each view of a capture is exposed, in microseconds.
    pub(crate) fn exposures_us(&self, capture: &RigCapture) -> Vec<i64> {
        let cameras = capture.cameras.iter().map(|&camera| &self.cameras[camera]);
        cameras.map(View::exposure_us).collect()
    }

    /// The views of a capture.
    pub(crate) fn views(&self, episode: &Episode, capture: &RigCapture) -> Vec<View> {
        episode.views(&self.cameras, &capture.cameras, capture.world_from_rig, capture.time_us)
    }

    /// Checks that the images of `rigs` poses of the rig, which `field` of a request asks for, fit
    /// one answer.
    pub(super) fn check_size(&self, field: &'static str, rigs: usize) -> Result<(), SessionError> {
        let limit = self.pixel_limit();
        let pixels = self.rig_pixels() * rigs as u64;
        if pixels > limit {
            return Err(SessionError::AnswerTooLarge { field, pixels, limit });
        }
        Ok(())
    }

    /// Pixels of the largest answer to a step, which take as many bytes without normals, instances
    /// and classes.
    pub(crate) fn step_pixels(&self) -> u64 {
        let pixels = self.rig_pixels() * self.schedule.frames() as u64;
        // In units of pixels of the full limit: one counts 2 with normals, and 4/3 with instances
        // or classes.
        pixels * limits::ANSWER_PIXELS / self.pixel_limit()
    }

    /// Bytes of a session's answers to steps: the one that is made, and the previous one, which is
    /// kept for a repeated request. Frames of earlier times are not counted.
    pub(crate) fn answers_bytes(&self) -> u64 {
        let PixelMaps { depth, opacity, normals, instances, semantics } = self.maps;
        let maps = [
            (depth, 4),
            (opacity, 4),
            (normals, limits::NORMAL_BYTES),
            (instances, limits::INSTANCE_BYTES),
            (semantics, limits::SEMANTICS_BYTES),
        ];
        let map_bytes = maps.iter().map(|&(held, bytes)| if held { bytes } else { 0 }).sum::<u64>();
        let colour = match self.encoding {
            // The PNG of an image full of noise is as large as its pixels.
            ImageEncoding::Raw | ImageEncoding::Png => 3,
            ImageEncoding::Jpeg(_) => limits::JPEG_PIXEL_BYTES,
        };
        let beams: usize = self.lidars.iter().map(|mounted| mounted.lidar.beams()).sum();
        2 * (self.rig_pixels() * (map_bytes + colour) + limits::POINT_BYTES * beams as u64)
    }

    /// Bytes of the images outside of the answer while a frame is rendered: pixels that are
    /// encoded, and maps from which trust and normals are computed.
    pub(crate) fn rendered_bytes(&self, has_trust: bool) -> u64 {
        let PixelMaps { depth, opacity, normals, .. } = self.maps;
        // Raw pixels are rendered into the answer itself.
        let pixels = if self.encoding == ImageEncoding::Raw { 0 } else { 3 };
        // Trust is computed from opacity, and normals from depth: both are rendered even if the
        // answer has neither.
        let opacity = if has_trust && !opacity { 4 } else { 0 };
        let depth = if normals && !depth { 4 } else { 0 };
        self.rig_pixels() * (pixels + opacity + depth)
    }

    fn rig_pixels(&self) -> u64 {
        self.cameras.iter().map(|camera| camera.camera.pixels() as u64).sum()
    }

    /// The most pixels of one answer: with normals, instances or classes each takes more bytes.
    fn pixel_limit(&self) -> u64 {
        let with_normals =
            if self.maps.normals { limits::ANSWER_PIXELS / 2 } else { limits::ANSWER_PIXELS };
        let has_owners = self.maps.instances || self.maps.semantics;
        // With instances or classes a pixel counts 4/3; it takes at most 14/11 of the bytes.
        if has_owners { with_normals / 4 * 3 } else { with_normals }
    }

    /// Reserves room in the headers for the state of a scenario with `actors` actors.
    ///
    /// # Errors
    /// The largest header would be longer than clients accept.
    pub(crate) fn reserve_header(&mut self, actors: usize) -> Result<(), SessionError> {
        self.scenario_bytes = limits::SCENARIO_HEADER_BYTES + actors * limits::ACTOR_HEADER_BYTES;
        // All images and all actors of the scenario in one header.
        let images = self.schedule.frames() * self.cameras.len();
        let most = limits::OBSERVATION_HEADER_BYTES as usize;
        let needed = self.base_bytes() + images * self.image_bytes + self.scenario_bytes;
        if needed <= most {
            return Ok(());
        }
        let must = format!(
            "true for {actors} actors beside {images} images, whose header would have {needed} bytes; at most {most} \
             are accepted: request fewer images"
        );
        Err(SessionError::OutOfRange { field: "outputs.actors", must })
    }

    /// Bytes to reserve for the header of an observation of some captures, including its length
    /// prefix.
    pub(super) fn header_bytes(&self, captures: &[RigCapture]) -> usize {
        let rendered: usize = captures.iter().map(|capture| capture.cameras.len()).sum();
        // With several frames per camera, an observation contains more images than it renders.
        let images = rendered.max(self.schedule.frames() * self.cameras.len());
        self.base_bytes() + images * self.image_bytes + self.scenario_bytes
    }

    /// Bytes that the renderer writes into the buffer for a capture.
    pub(super) fn in_place_bytes(&self, capture: &RigCapture) -> InPlaceBytes {
        if !capture.shown {
            return InPlaceBytes::default();
        }
        let pixels = capture.cameras.iter().map(|&camera| self.cameras[camera].camera.pixels());
        let pixels: usize = pixels.sum();
        InPlaceBytes {
            floats: 4 * pixels * self.maps.values(),
            instances: if self.maps.instances { 2 * pixels } else { 0 },
            semantics: if self.maps.semantics { pixels } else { 0 },
            // Other encodings append their files later.
            raw: if self.encoding == ImageEncoding::Raw { 3 * pixels } else { 0 },
        }
    }

    /// Whether a later observation shows a camera's image of a capture.
    pub(crate) fn is_shown_later(&self, capture: &RigCapture, camera: usize) -> bool {
        // A picture that is not shown now was rendered for a later observation.
        !capture.shown || self.schedule.is_shown_after(camera, capture.due_us, capture.due_us)
    }

    /// The frames of the history that a decision shows in addition to those of its own time: by
    /// camera, the newest first.
    pub(super) fn earlier_frames<'a>(
        &self,
        history: &'a FrameHistory,
        now_us: i64,
    ) -> Vec<EarlierFrame<'a>> {
        let of_camera = |camera| {
            let times_us = self.schedule.shown_times(camera, now_us);
            // The frame of now is among the images of the observation itself.
            let earlier_us = times_us.filter(|&time_us| time_us < now_us);
            let frames = earlier_us.filter_map(move |time_us| history.find(camera, time_us));
            frames.enumerate().map(|(index, frame)| EarlierFrame { back: index + 1, frame })
        };
        (0..self.cameras.len()).flat_map(of_camera).collect()
    }

    /// Height and width of a camera's images, in pixels.
    pub(super) fn size_px(&self, camera: usize) -> [usize; 2] {
        let camera = &self.cameras[camera].camera;
        [camera.height_px as usize, camera.width_px as usize]
    }

    /// Shape of a colour tensor: of pixels, or of a file of `file_bytes` bytes.
    pub(super) fn colour_shape(&self, camera: usize, file_bytes: usize) -> Vec<usize> {
        let [height, width] = self.size_px(camera);
        match self.encoding {
            ImageEncoding::Raw => vec![height, width, 3],
            ImageEncoding::Jpeg(_) | ImageEncoding::Png => vec![file_bytes],
        }
    }
}
