//! The demo street as a recording: 34 keyframes of six cameras, 3 m apart, rendered.

use std::error::Error;

use glam::DVec3;
use wildcity_render::cpu::Cpu;
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::random::Random;
use wildcity_scene::{Gaussians, RenderProfile, Rig, Scene, Trajectory, sh};
use wildcity_train::poses::{Place, RigPoses};
use wildcity_train::run::{TrainingImage, TrainingImages};
use wildcity_train::start::Point;

/// Number of times that the rig was recorded at.
pub(crate) const KEYFRAMES: usize = 34;

/// An image of the street.
pub(crate) struct Recorded {
    pub(crate) view: View,
    pub(crate) place: Place,
    pub(crate) rgb8: Vec<u8>,
    /// Of the truth, in metres; 0 where it is not opaque, or more than 80 m away.
    pub(crate) depth_m: Vec<f32>,
    pub(crate) is_held_out: bool,
}

/// The images of the street, and how a run takes them.
pub(crate) struct Recording {
    pub(crate) images: Vec<Recorded>,
    pub(crate) rig: RigPoses,
    /// Whether a run gets depths, as of a LiDAR: one pixel of sixteen has one.
    pub(crate) has_depth: bool,
}

impl TrainingImages for Recording {
    fn count(&self) -> usize {
        self.images.len()
    }

    fn is_held_out(&self, index: usize) -> bool {
        self.images[index].is_held_out
    }

    fn place(&self, index: usize) -> Option<Place> {
        Some(self.images[index].place)
    }

    fn view(&self, index: usize) -> View {
        self.images[index].view
    }

    fn name(&self, index: usize) -> String {
        format!("image {index}")
    }

    fn load(&self, index: usize) -> Result<TrainingImage, String> {
        let Recorded { view, place, rgb8, depth_m, .. } = &self.images[index];
        let measured =
            |(pixel, depth_m): (usize, &f32)| if pixel % 16 == 5 { *depth_m } else { 0.0 };
        let depth_m = self.has_depth.then(|| depth_m.iter().enumerate().map(measured).collect());
        let world_from_camera =
            self.rig.world_from_ego[place.ego] * self.rig.ego_from_camera[place.camera];
        let view = View { world_from_camera, ..*view };
        Ok(TrainingImage {
            view,
            rgb8: rgb8.clone(),
            mask: None,
            sky: None,
            depth_m,
            weight: 1.0,
            exposure: 1.0,
        })
    }
}

impl Recording {
    /// Renders the images at a fraction of the cameras' size.
    pub(crate) fn new(
        cpu: &Cpu,
        scene: &Scene,
        drive: &Trajectory,
        scale: f64,
    ) -> Result<Self, Box<dyn Error>> {
        let rig = Rig::preset("vehicle6").ok_or("no rig")?;
        let mut recording = Self {
            images: Vec::new(),
            rig: RigPoses {
                world_from_ego: Vec::new(),
                ego_from_camera: rig.cameras.iter().map(|camera| camera.rig_from_camera).collect(),
            },
            has_depth: false,
        };
        for ego in 0..KEYFRAMES {
            // Three metres apart, in the middle of the drive.
            let station_m = 0.5 * drive.length_m() + 3.0 * (ego as f64 - 16.5);
            let world_from_rig = drive.at_station(station_m);
            recording.rig.world_from_ego.push(world_from_rig);
            for (camera, mut view) in
                View::from_rig(&rig.cameras, world_from_rig).into_iter().enumerate()
            {
                let side = |px: u32| (f64::from(px) * scale).round() as u64;
                view.camera =
                    view.camera.scaled(side(view.camera.width_px), side(view.camera.height_px))?;
                view.rolling_shutter = None;
                let (rgb8, depth_m) = render(cpu, scene, view)?;
                // Photographs of this size: what they are trained as.
                view.camera.native_size_px = None;
                recording.images.push(Recorded {
                    view,
                    place: Place::new(ego, camera),
                    rgb8,
                    depth_m,
                    is_held_out: ego % 8 == 4,
                });
            }
        }
        Ok(recording)
    }
}

/// The colours of a view in 8 bits, and its depths where the scene is opaque.
pub(crate) fn render(
    cpu: &Cpu,
    scene: &Scene,
    view: View,
) -> Result<(Vec<u8>, Vec<f32>), Box<dyn Error>> {
    let pixels = view.camera.pixels();
    let mut rgb8 = vec![0; 3 * pixels];
    let mut depth_m = vec![0.0; pixels];
    let mut opacity = depth_m.clone();
    let background = [0.55, 0.68, 0.85];
    let profile = RenderProfile { background, sky_error: 0.0, ..RenderProfile::default() };
    let frame = Frame { scene, profile: &profile, views: &[view] };
    let target = Target {
        rgb8: Some(&mut rgb8),
        depth_m: Some(&mut depth_m),
        opacity: Some(&mut opacity),
        ..Target::default()
    };
    cpu.render(&frame, &mut [target], &|_, _| {})?;
    for (depth_m, opacity) in depth_m.iter_mut().zip(opacity) {
        if opacity < 0.95 || *depth_m > 80.0 {
            *depth_m = 0.0;
        }
    }
    Ok((rgb8, depth_m))
}

/// A tenth of a million points of the street, moved by 3 cm, as of a LiDAR.
pub(crate) fn points(truth: &Gaussians, recording: &Recording) -> Vec<Point> {
    let mut random = Random::new(0, "points", 0);
    let near = |mean_m: &DVec3| {
        recording
            .images
            .iter()
            .step_by(72)
            .any(|image| image.view.world_from_camera.position_m.distance(*mean_m) < 90.0)
    };
    let mut order: Vec<usize> =
        (0..truth.len()).filter(|&i| near(&DVec3::from_array(truth.means_m[i]))).collect();
    for k in (1..order.len()).rev() {
        order.swap(k, random.below(k + 1));
    }
    order.truncate(94_000);
    let mut points = Vec::new();
    for i in order {
        let mut noise = || (0..12).map(|_| random.unit()).sum::<f64>() - 6.0;
        let moved_m = 0.03 * DVec3::new(noise(), noise(), noise());
        let rgb = [0, 1, 2].map(|c| (0.5 + sh::C0 * f64::from(truth.sh_at(i)[c])).clamp(0.0, 1.0));
        points.push(Point { at_m: DVec3::from_array(truth.means_m[i]) + moved_m, rgb });
    }
    points
}
