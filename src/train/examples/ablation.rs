//! What each part of the method gains on the demo street: a table of runs that lack one of them.
//!
//! ```text
//! cargo run --release -p wildcity-train --example ablation -- STEPS [SCALE] [ROW ..]
//! ```
//!
//! The recording is wrong by 10 cm and 0.5° at each keyframe, and by 1 cm and 0.2° at each camera.
//! One image of eight is held out. Behind the street lies a sky of two colours and a sun.

#![allow(clippy::print_stdout, reason = "its result")]

mod demo_street;

use std::collections::BTreeMap;
use std::error::Error;
use std::sync::Arc;
use std::time::Instant;

use glam::{DMat3, DQuat, DVec2, DVec3};
use wildcity_generate::StreetSettings;
use wildcity_render::View;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::geometry::Pose;
use wildcity_scene::random::Random;
use wildcity_scene::sky::{CubeMap, FACES, SkyModel};
use wildcity_scene::{RenderProfile, Scene, Sky};
use wildcity_train::ground::is_ground;
use wildcity_train::poses::RigPoses;
use wildcity_train::run::{Line, run};
use wildcity_train::settings::{Growth, PoseMode, Settings, SkyMode};
use wildcity_train::start::{Point, gaussians_from_points};
use wildcity_train::trainer::{Fixed, Start, Trainer};

use demo_street::{Recording, points, render};

/// A row of the table: how its run differs from the whole method.
type Change = fn(&mut Settings, &mut Recording, &RigPoses);

const ROWS: [(&str, Change); 9] = [
    ("all", |_, _, _| {}),
    ("true poses", |settings, recording, truth| {
        recording.rig = truth.clone();
        settings.poses.mode = PoseMode::Off;
    }),
    ("recorded poses", |settings, _, _| settings.poses.mode = PoseMode::Off),
    ("a pose per image", |settings, _, _| settings.poses.mode = PoseMode::Image),
    ("no small images", |settings, _, _| settings.coarse.halvings = 0),
    ("no sky", |settings, _, _| settings.sky.mode = SkyMode::Off),
    ("no ground", |settings, _, _| leave_out_ground(settings)),
    ("no depth", |_, recording, _| recording.has_depth = false),
    ("no depth, no ground", |settings, recording, _| {
        recording.has_depth = false;
        leave_out_ground(settings);
    }),
];

fn leave_out_ground(settings: &mut Settings) {
    settings.ground.whole_until = 0;
    settings.ground.until = 0;
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let steps: usize = arguments.first().map_or("3000", String::as_str).parse()?;
    // Of the cameras of 1440 x 928.
    let scale = arguments.get(1).and_then(|scale| scale.parse::<f64>().ok());
    let chosen = arguments.get(if scale.is_some() { 2 } else { 1 }..).unwrap_or_default();
    let scale = scale.unwrap_or(0.25);
    if let Some(row) = chosen.iter().find(|row| !ROWS.iter().any(|(name, _)| name == row)) {
        return Err(
            format!("{row:?} is no row; the rows are {:?}", ROWS.map(|(name, _)| name)).into()
        );
    }
    let cpu = Cpu::new(0, Simd::Best)?;
    let street = wildcity_generate::street(&StreetSettings::default())?;
    let sky = Sky::new(SkyModel::Cube(Arc::new(evening()?)), DMat3::IDENTITY);
    let truth = Scene { sky: Some(Arc::new(sky)), ..Scene::from_gaussians(&street.gaussians) };
    let mut recording = Recording::new(&cpu, &truth, &street.trajectory, scale)?;
    for (index, image) in recording.images.iter_mut().enumerate() {
        image.is_held_out = index % 8 == 3;
    }
    let points = points(&street.gaussians, &recording);
    let true_rig = recording.rig.clone();
    let shaken = shaken(&true_rig);

    println!(
        "{steps} steps at {} x {}, {} images, {} points\n\
         {:20} {:>8} {:>9} {:>9} {:>9} {:>10} {:>9} {:>7}",
        recording.images[0].view.camera.width_px,
        recording.images[0].view.camera.height_px,
        recording.images.len(),
        points.len(),
        "",
        "PSNR dB",
        "depth m",
        "road mm",
        "rough mm",
        "poses mm",
        "deg",
        "s"
    );
    for (name, change) in ROWS {
        if !chosen.is_empty() && !chosen.iter().any(|row| row == name) {
            continue;
        }
        let growth = Growth { cap: 150_000, from: 500, until: 24_000, ..Growth::default() };
        let mut settings = Settings { steps, growth, ..Settings::default() };
        settings.sky.mode = SkyMode::Network;
        recording.rig = shaken.clone();
        recording.has_depth = true;
        change(&mut settings, &mut recording, &true_rig);
        let began = Instant::now();
        let (trainer, db) = train(&cpu, &recording, &points, settings)?;
        let seconds = began.elapsed().as_secs_f64();
        let Judged { depth_m, road_m, rough_m, position_m, angle_deg } =
            Judged::new(&cpu, &trainer, &recording, &true_rig)?;
        println!(
            "{name:20} {db:>8.2} {depth_m:>9.3} {:>9.1} {:>9.1} {:>10.1} {angle_deg:>9.3} {seconds:>7.0}",
            1e3 * road_m,
            1e3 * rough_m,
            1e3 * position_m,
        );
    }
    Ok(())
}

fn train(
    cpu: &Cpu,
    recording: &Recording,
    points: &[Point],
    settings: Settings,
) -> Result<(Trainer, f64), Box<dyn Error>> {
    let at_m: Vec<DVec3> = points.iter().map(|point| point.at_m).collect();
    let rig = &recording.rig;
    let pose = |image: &demo_street::Recorded| {
        rig.world_from_ego[image.place.ego] * rig.ego_from_camera[image.place.camera]
    };
    let start = Start {
        gaussians: gaussians_from_points(points),
        is_ground: is_ground(&at_m, &rig.world_from_ego),
        world_from_camera: recording.images.iter().map(pose).collect(),
        rig: Some(rig.clone()),
        fixed: Fixed::default(),
    };
    let steps = settings.steps;
    let mut trainer = Trainer::new(start, RenderProfile::default(), settings)?;
    let mut db = f64::NAN;
    let mut on_step = |line: &Line, _: &Trainer| {
        db = line.held_out_db.unwrap_or(db);
        true
    };
    // Only the last step is evaluated.
    run(&mut trainer, recording, cpu, steps, &mut on_step)?;
    Ok((trainer, db))
}

/// What a trained street is judged by, beside its images.
struct Judged {
    /// Mean difference of depths to the truth.
    depth_m: f64,
    /// Mean difference of heights to the truth, of the road.
    road_m: f64,
    /// Standard deviation of these differences in a square of 1 m, the mean of all squares.
    rough_m: f64,
    /// Means over all views, without what is common to all.
    position_m: f64,
    angle_deg: f64,
}

impl Judged {
    fn new(
        cpu: &Cpu,
        trainer: &Trainer,
        recording: &Recording,
        truth: &RigPoses,
    ) -> Result<Self, Box<dyn Error>> {
        let scene = trainer.scene()?;
        let mut depth = Mean::default();
        let mut road = Mean::default();
        let mut squares: BTreeMap<[i64; 2], Vec<f64>> = BTreeMap::new();
        let mut views = Vec::new();
        for (index, image) in recording.images.iter().enumerate() {
            let place = image.place;
            let pose =
                |rig: &RigPoses| rig.world_from_ego[place.ego] * rig.ego_from_camera[place.camera];
            let recorded = View { world_from_camera: pose(&recording.rig), ..image.view };
            let view = trainer.view(recorded, index, Some(place));
            views.push((view.world_from_camera, pose(truth)));
            if !image.is_held_out {
                continue;
            }
            let (_, depth_m) = render(cpu, &scene, view)?;
            let up = truth.world_from_ego[place.ego].inverse();
            for (pixel, (&ours_m, &theirs_m)) in depth_m.iter().zip(&image.depth_m).enumerate() {
                if ours_m == 0.0 || theirs_m == 0.0 {
                    continue;
                }
                depth.add(f64::from(ours_m - theirs_m).abs());
                let [ours, theirs] = [ours_m, theirs_m].map(|m| at(&image.view, pixel, m));
                let square = theirs.truncate().floor().to_array().map(|m| m as i64);
                let [ours, theirs] = [ours, theirs].map(|point| up.transform_point(point));
                // Within 15 m and 20 cm of the plane of the wheels.
                if theirs.z.abs() < 0.2 && theirs.truncate().length() < 15.0 {
                    road.add((ours.z - theirs.z).abs());
                    squares.entry(square).or_default().push(ours.z - theirs.z);
                }
            }
        }
        let [position_m, angle_deg] = errors(&views);
        let mut rough = Mean::default();
        for heights_m in squares.values() {
            let count = heights_m.len() as f64;
            let mean_m = heights_m.iter().sum::<f64>() / count;
            let variance = heights_m.iter().map(|m| (m - mean_m).powi(2)).sum::<f64>() / count;
            rough.add(variance.sqrt());
        }
        let [depth_m, road_m, rough_m] = [depth, road, rough].map(|mean| mean.value());
        Ok(Self { depth_m, road_m, rough_m, position_m, angle_deg })
    }
}

#[derive(Default)]
struct Mean {
    sum: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1.0;
    }

    fn value(&self) -> f64 {
        self.sum / self.count
    }
}

/// The point of a pixel at a depth along z, in the world.
fn at(view: &View, pixel: usize, depth_m: f32) -> DVec3 {
    let width = view.camera.width_px as usize;
    let center_px = DVec2::new((pixel % width) as f64, (pixel / width) as f64) + 0.5;
    let ray = view.camera.unproject(center_px).unwrap_or(DVec3::Z);
    view.world_from_camera.transform_point(ray * f64::from(depth_m) / ray.z)
}

/// Mean errors of poses in metres and degrees after the rigid motion that is common to all, of
/// which no image knows.
fn errors(views: &[(Pose, Pose)]) -> [f64; 2] {
    let count = views.len() as f64;
    let turn = |(ours, theirs): &(Pose, Pose)| ours.rotation * theirs.rotation.inverse();
    // Small turns: their mean is that of their vectors.
    let mean = views.iter().map(|pair| turn(pair).to_scaled_axis()).sum::<DVec3>() / count;
    let common = DQuat::from_scaled_axis(mean);
    let off = |(ours, theirs): &(Pose, Pose)| ours.position_m - common * theirs.position_m;
    let shift = views.iter().map(off).sum::<DVec3>() / count;
    let position_m = views.iter().map(|pair| (off(pair) - shift).length()).sum::<f64>() / count;
    let angle = |pair| (common.inverse() * turn(pair)).to_scaled_axis().length();
    let angle_rad = views.iter().map(angle).sum::<f64>() / count;
    [position_m, angle_rad.to_degrees()]
}

/// A rig as a recording has it that is wrong by up to 10 cm and 0.5° at each time, and by 1 cm and
/// 0.2° at each camera.
fn shaken(truth: &RigPoses) -> RigPoses {
    let mut random = Random::new(5, "shaken", 0);
    let mut direction = || loop {
        let vector = DVec3::from_array([0; 3].map(|_| random.range(-1.0, 1.0)));
        if (0.1..1.0).contains(&vector.length()) {
            return vector.normalize();
        }
    };
    let mut shake = |pose: &Pose, size_m: f64, size_deg: f64| {
        let rotation = DQuat::from_scaled_axis(size_deg.to_radians() * direction());
        *pose * Pose { position_m: size_m * direction(), rotation }
    };
    RigPoses {
        world_from_ego: truth.world_from_ego.iter().map(|pose| shake(pose, 0.1, 0.5)).collect(),
        ego_from_camera: truth.ego_from_camera.iter().map(|pose| shake(pose, 0.01, 0.2)).collect(),
    }
}

/// A sky: blue above, orange at the horizon, and a sun.
fn evening() -> Result<CubeMap, Box<dyn Error>> {
    const SIDE_PX: usize = 128;
    let sun = DVec3::new(0.8, 0.3, 0.35).normalize();
    let mut rgb8 = Vec::new();
    for face in 0..FACES {
        for pixel in 0..SIDE_PX * SIDE_PX {
            let place = [pixel % SIDE_PX, pixel / SIDE_PX];
            let direction =
                CubeMap::direction(face, place.map(|px| (px as f64 + 0.5) / SIDE_PX as f64));
            let height = direction.normalize().z.clamp(0.0, 1.0).sqrt();
            let glow = (-30.0 * (1.0 - direction.normalize().dot(sun))).exp();
            let color = DVec3::new(0.95, 0.7, 0.5).lerp(DVec3::new(0.25, 0.45, 0.85), height);
            let lit = color + 0.4 * glow * DVec3::new(1.0, 0.9, 0.6);
            rgb8.extend(lit.to_array().map(|value| (255.0 * value.min(1.0)).round() as u8));
        }
    }
    Ok(CubeMap::from_faces(SIDE_PX, &rgb8)?)
}
