//! The sweeps of a session: where its LiDAR was, their effects, records and branches.

use std::path::Path;
use std::sync::Arc;

use glam::{DQuat, DVec3, Vec3};
use wildcity_render::Backend;
use wildcity_render::lidar::LidarView;
use wildcity_scene::geometry::{Lidar, Pose};
use wildcity_scene::rig::RigLidar;
use wildcity_session::options::{
    Encoding, LidarBeams, LidarColumns, LidarSensor, Open, Outputs, RigChoice, Sensors, Start,
};
use wildcity_session::{
    Observation, Outcome, RecordedEpisode, ReplayReport, ReplayUntil, Replayed, Session,
    SessionError, TensorKind,
};
use wildcity_twin::residency::Viewpoint;

use crate::driving::{Bench, bench, rig};
use crate::images::cpu;
use crate::streaming::{PROFILE, demo, unlimited};

const MOUNT: Pose = Pose { position_m: DVec3::new(1.0, 0.0, 1.9), rotation: DQuat::IDENTITY };

fn beams() -> LidarBeams {
    let row = |row: i32| (5.0 - 1.5 * f64::from(row)).to_radians();
    LidarBeams {
        row_elevations_rad: (0..16).map(row).collect(),
        row_azimuth_offsets_rad: None,
        column_azimuths_rad: None,
        columns: Some(LidarColumns { count: 180, first_rad: 3.0, last_rad: -3.0 }),
        duration_us: 100_000,
        min_range_m: None,
        max_range_m: Some(100.0),
    }
}

fn options(sensors: Option<Sensors>) -> Open {
    let mut rig = rig();
    rig.lidars.push(RigLidar {
        name: "top".to_owned(),
        lidar: Arc::new(Lidar::from_options(&beams()).unwrap()),
        rig_from_lidar: MOUNT,
    });
    Open {
        start: Some(Start::from(demo().at(20.0))),
        rig: Some(RigChoice::Full(rig.into())),
        outputs: Outputs::colour(Encoding::Raw),
        sensors,
        ..Open::twin("demo")
    }
}

async fn open(bench: &Bench, name: &str, options: Open) -> Result<Session, SessionError> {
    Session::open(bench.engine.clone(), name.to_owned(), options).await
}

fn noisy() -> Option<Sensors> {
    let sensor = LidarSensor { noise_m: Some(0.05), drop: Some(0.25) };
    Some(Sensors { lidars: [("top".to_owned(), sensor)].into(), ..Sensors::default() })
}

fn floats(observation: &Observation, kind: TensorKind) -> Vec<f32> {
    bytes(observation, kind).chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}

fn ids(observation: &Observation, kind: TensorKind) -> Vec<u16> {
    bytes(observation, kind).chunks(2).map(|b| u16::from_le_bytes(b.try_into().unwrap())).collect()
}

fn bytes(observation: &Observation, kind: TensorKind) -> Vec<u8> {
    let tensor = observation.tensors.iter().find(|tensor| tensor.kind == kind).unwrap();
    observation.buffer.bytes()[tensor.bytes.clone()].to_vec()
}

fn replay(path: &Path) -> ReplayReport {
    let recording = RecordedEpisode::read(path).unwrap();
    recording.replay(&unlimited(), &cpu(), ReplayUntil::End, &mut |_| Ok(())).unwrap()
}

/// At 30 m/s the points of a sweep are those of a LiDAR on its way between the two poses.
#[tokio::test(flavor = "multi_thread")]
async fn a_sweep_is_cast_on_the_way_to_the_present_pose() {
    let bench = bench(unlimited());
    let mut session = open(&bench, "way", options(None)).await.unwrap();
    session.reset(0, None).await.unwrap();
    let [from, to] = [20.0, 23.0].map(|station_m| demo().at(station_m));
    let observation = session.step(to, false).await.unwrap();
    assert_eq!(observation.sweeps.len(), 1);
    let sweep = observation.sweeps[0];
    assert_eq!((sweep.lidar, sweep.time_us), (0, 100_000));

    let view = LidarView {
        lidar: Arc::new(Lidar::from_options(&beams()).unwrap()),
        world_from_lidar: to * MOUNT,
        world_from_lidar_first: from * MOUNT,
    };
    let resident = unlimited().open("demo", None).unwrap();
    let eye = Viewpoint { position_m: view.world_from_lidar.position_m, focal_px: 1_000.0 };
    let scene = resident.scene(&[eye], &PROFILE).unwrap();
    let wanted = cpu().sweep(&scene, &PROFILE, &view).unwrap();

    let points = floats(&observation, TensorKind::Points(0));
    let [rows, columns] =
        [TensorKind::Rows(0), TensorKind::Columns(0)].map(|kind| ids(&observation, kind));
    assert_eq!(points.len(), 3 * sweep.returns);
    let returns = wanted.range_m.iter().filter(|range_m| **range_m > 0.0).count();
    assert!(returns > 1_000, "{returns} returns test too little");
    assert_eq!(sweep.returns, returns);
    for (index, point) in points.chunks(3).enumerate() {
        let at = usize::from(rows[index]) * 180 + usize::from(columns[index]);
        let in_rig_m = DVec3::new(point[0].into(), point[1].into(), point[2].into());
        let range_m = (in_rig_m - MOUNT.position_m).length();
        assert!((range_m - f64::from(wanted.range_m[at])).abs() < 1e-4, "{index}");
    }
    // The same points in the world, if each is placed where the rig was then, and not where it is.
    let deskewed = |index: usize| {
        let fraction = view.lidar.fraction(columns[index].into());
        let then = from.interpolate(&to, fraction);
        let point = &points[3 * index..][..3];
        then.transform_point(DVec3::new(point[0].into(), point[1].into(), point[2].into()))
    };
    let moved = |index: usize| {
        let point = &points[3 * index..][..3];
        let now = DVec3::new(point[0].into(), point[1].into(), point[2].into());
        deskewed(index).distance(to.transform_point(now))
    };
    let most_m = (0..sweep.returns).map(moved).fold(0.0, f64::max);
    assert!((2.8..3.2).contains(&most_m), "the first columns are {most_m} m skewed");
}

/// With `outputs.semantics`, points have the class of what they hit; a replay computes them again.
#[tokio::test(flavor = "multi_thread")]
async fn points_have_classes_if_they_are_asked_for() {
    let bench = bench(unlimited());
    let mut plain = open(&bench, "plain", options(None)).await.unwrap();
    let without = plain.reset(0, None).await.unwrap();
    let is_class = |kind| matches!(kind, TensorKind::PointClasses(_));
    assert!(!without.tensors.iter().any(|tensor| is_class(tensor.kind)));

    let mut asked = options(None);
    asked.outputs.semantics = Some(true);
    let mut session = open(&bench, "classes", asked).await.unwrap();
    let seen = session.reset(0, None).await.unwrap();
    let classes = bytes(&seen, TensorKind::PointClasses(0));
    let points = floats(&seen, TensorKind::Points(0));
    assert_eq!(points, floats(&without, TensorKind::Points(0)));
    assert_eq!(classes.len(), seen.sweeps[0].returns);
    assert_ne!(seen.sweeps[0].hash, without.sweeps[0].hash);
    let road: Vec<bool> = classes.iter().map(|class| *class == 2).collect();
    // In front of the car within the lane there is nothing but road.
    let ahead = |point: &[f32]| (4.0..9.0).contains(&point[0]) && point[1].abs() < 1.0;
    let lane = points.chunks(3).zip(&road).filter(|(point, _)| ahead(point) && point[2] < 0.1);
    let lane: Vec<bool> = lane.map(|(_, is_road)| *is_road).collect();
    assert!(lane.len() > 20 && lane.iter().all(|is_road| *is_road), "{lane:?}");
    assert!(road.iter().filter(|is_road| !**is_road).count() > 100);
    session.close(Outcome::Completed).await;
    let report = replay(&bench.episodes.path().join("classes-1.jsonl"));
    assert!(report.difference.is_none(), "{:?}", report.difference);
}

#[tokio::test(flavor = "multi_thread")]
async fn poses_that_are_only_observed_and_rigs_without_lidar_have_no_sweeps() {
    let bench = bench(unlimited());
    let mut session = open(&bench, "observe", options(None)).await.unwrap();
    assert_eq!(session.reset(0, None).await.unwrap().sweeps.len(), 1);
    let observed = session.observe(vec![demo().at(30.0)]).await.unwrap();
    assert!(observed.sweeps.is_empty());
    let without = Open { rig: Some(RigChoice::Full(rig().into())), ..options(None) };
    let mut session = open(&bench, "without", without).await.unwrap();
    let observation = session.reset(0, None).await.unwrap();
    assert!(observation.sweeps.is_empty());
    assert!(!observation.tensors.iter().any(|tensor| tensor.kind == TensorKind::Points(0)));
}

/// Four LiDARs and cameras with long names and every map leave room in the header.
#[tokio::test(flavor = "multi_thread")]
async fn the_header_has_room_for_four_lidars() {
    let bench = bench(unlimited());
    let mut options = options(None);
    options.outputs =
        Outputs { depth: true, opacity: true, normals: Some(true), ..options.outputs };
    if let Some(RigChoice::Full(rig)) = &mut options.rig {
        rig.cameras.truncate(1);
        let first = rig.lidars[0].clone();
        rig.lidars = (0..4)
            .map(|number| wildcity_session::options::RigLidar {
                name: format!("{number}{}", "x".repeat(63)),
                ..first.clone()
            })
            .collect();
    }
    let mut session = open(&bench, "four", options).await.unwrap();
    let observation = session.reset(0, None).await.unwrap();
    assert_eq!(observation.sweeps.len(), 4);
    // What the server writes: at most 2,048 bytes for each LiDAR.
    let mut buffer = observation.buffer;
    assert!(buffer.header_mut(4_096 + 3_584 + 4 * 2_048).is_some());
}

/// Noise and lost beams depend on seed and time alone.
#[tokio::test(flavor = "multi_thread")]
async fn effects_are_those_of_the_seed() {
    let bench = bench(unlimited());
    let mut plain = open(&bench, "plain", options(None)).await.unwrap();
    let clean = plain.reset(7, None).await.unwrap();
    let mut session = open(&bench, "noisy", options(noisy())).await.unwrap();
    let of_seed = async |session: &mut Session, seed| {
        let observation = session.reset(seed, None).await.unwrap();
        (observation.sweeps[0].hash, observation)
    };
    let (one, observation) = of_seed(&mut session, 7).await;
    let (again, _) = of_seed(&mut session, 7).await;
    let (other, _) = of_seed(&mut session, 8).await;
    assert!(one == again && one != other);
    let [kept, all] = [&observation, &clean].map(|one| one.sweeps[0].returns as f64);
    // A quarter is lost; four standard deviations of 2,000 beams are 0.04.
    assert!((kept / all - 0.75).abs() < 0.04, "{kept} of {all}");
    let place = |observation: &Observation| -> Vec<(u16, u16)> {
        let rows = ids(observation, TensorKind::Rows(0));
        rows.into_iter().zip(ids(observation, TensorKind::Columns(0))).collect()
    };
    let range_m = |observation: &Observation| -> Vec<f64> {
        let from_lidar = |p: &[f32]| {
            let point_m = DVec3::new(p[0].into(), p[1].into(), p[2].into());
            point_m.distance(MOUNT.position_m)
        };
        floats(observation, TensorKind::Points(0)).chunks(3).map(from_lidar).collect()
    };
    let clean_ranges: std::collections::BTreeMap<_, _> =
        place(&clean).into_iter().zip(range_m(&clean)).collect();
    let errors: Vec<f64> = place(&observation)
        .iter()
        .zip(range_m(&observation))
        .map(|(at, noisy_m)| noisy_m - clean_ranges[at])
        .collect();
    let sigma_m =
        (errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64).sqrt();
    assert!((sigma_m - 0.05).abs() < 0.005, "{sigma_m} m");
}

/// A record has the hashes of its sweeps, and a replay casts them again. A changed hash is found.
#[tokio::test(flavor = "multi_thread")]
async fn a_replay_casts_the_sweeps_again() {
    let bench = bench(unlimited());
    let mut session = open(&bench, "record", options(noisy())).await.unwrap();
    session.reset(3, None).await.unwrap();
    for station_m in [22.0, 24.0] {
        session.step(demo().at(station_m), false).await.unwrap();
    }
    session.close(Outcome::Completed).await;
    let path = bench.episodes.path().join("record-1.jsonl");
    let report = replay(&path);
    assert!(report.difference.is_none(), "{:?}", report.difference);
    assert!(report.wrong_value.is_none(), "{:?}", report.wrong_value);

    let text = std::fs::read_to_string(&path).unwrap();
    let (before, hash) = text.split_once("\"sweeps\":[\"").unwrap();
    let changed = if hash.starts_with('0') { "1" } else { "0" };
    std::fs::write(&path, format!("{before}\"sweeps\":[\"{changed}{}", &hash[1..])).unwrap();
    let difference = replay(&path).difference.unwrap();
    assert_eq!(difference.sensor.to_string(), "LiDAR \"top\"");

    // Without the sweeps of a frame the record says less than was sent.
    let (head, rest) = text.split_once(",\"sweeps\":[\"").unwrap();
    let (_, tail) = rest.split_once("\"]").unwrap();
    std::fs::write(&path, format!("{head}{tail}")).unwrap();
    assert!(replay(&path).wrong_value.is_some());
}

/// A replay shows each sweep with the motion of the ego taken out: each point is where it was in
/// the world, as the rig at the end of the sweep sees it.
#[tokio::test(flavor = "multi_thread")]
async fn replayed_points_are_in_the_rig_at_the_end_of_the_sweep() {
    const MOVED_M: f64 = 3.0;
    let bench = bench(unlimited());
    let mut session = open(&bench, "deskewed", options(None)).await.unwrap();
    session.reset(0, None).await.unwrap();
    let from = demo().at(20.0);
    let turn = DQuat::from_rotation_z(0.1);
    let to = from * Pose { position_m: DVec3::X * MOVED_M, rotation: turn };
    let observation = session.step(to, false).await.unwrap();
    session.close(Outcome::Completed).await;
    let raw = floats(&observation, TensorKind::Points(0));
    let columns = ids(&observation, TensorKind::Columns(0));

    let path = bench.episodes.path().join("deskewed-1.jsonl");
    let mut recording = RecordedEpisode::read(&path).unwrap();
    let mut sweeps = Vec::new();
    let mut visit = |replayed: &Replayed<'_>| {
        if let Replayed::Sweep(sweep) = replayed {
            sweeps.push((sweep.lidar, sweep.time_us, sweep.points()));
        }
        Ok(())
    };
    recording.replay(&unlimited(), &cpu(), ReplayUntil::End, &mut visit).unwrap();
    let [(_, 0, _), (0, 100_000, points)] = &sweeps[..] else { panic!("{} sweeps", sweeps.len()) };
    assert_eq!(points.len(), columns.len());
    let mut most_m: f64 = 0.0;
    for ((point, raw), &column) in points.iter().zip(raw.chunks(3)).zip(&columns) {
        assert_eq!(point.column, column);
        // 180 columns in 100 ms, the last one at the end.
        let after = (179.0 - f64::from(column)) / 180.0;
        assert!((f64::from(point.offset_us) + after * 1e5).abs() <= 1.0, "{}", point.offset_us);
        // The LiDAR moves and turns evenly; the rig is where it carries the LiDAR.
        let lidar = (from * MOUNT).interpolate(&(to * MOUNT), 1.0 - after);
        let in_lidar_m = MOUNT.inverse().transform_point(Vec3::from_slice(raw).as_dvec3());
        let in_world_m = lidar.transform_point(in_lidar_m);
        let wanted_m = to.inverse().transform_point(in_world_m);
        let off_m = wanted_m.distance(Vec3::from_array(point.xyz_m).as_dvec3());
        assert!(off_m < 1e-3, "{off_m} m");
        most_m = most_m.max(after * MOVED_M);
    }
    assert!(most_m > 2.8, "{most_m} m");

    recording.leave_out_sweeps();
    let mut others = 0;
    let mut visit = |replayed: &Replayed<'_>| {
        assert!(matches!(replayed, Replayed::Image(_)));
        others += 1;
        Ok(())
    };
    let report = recording.replay(&unlimited(), &cpu(), ReplayUntil::End, &mut visit).unwrap();
    assert!(report.difference.is_none() && others > 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_lidars_are_refused_by_name() {
    let bench = bench(unlimited());
    let changed = |change: &dyn Fn(&mut wildcity_session::options::RigLidar)| {
        let mut open = options(None);
        if let Some(RigChoice::Full(rig)) = &mut open.rig {
            change(&mut rig.lidars[0]);
        }
        open
    };
    let cases: [(Open, &str); 8] = [
        (
            changed(&|lidar| {
                let back_and_forth = (0..400).map(|column| f64::from(column % 2));
                lidar.beams.columns = None;
                lidar.beams.column_azimuths_rad = Some(back_and_forth.collect());
            }),
            "jumps by more than 0.2 rad 399 times",
        ),
        (
            {
                let mut open = changed(&|lidar| {
                    let row = |row: i32| -0.01 * f64::from(row) / 3.0;
                    lidar.beams.row_elevations_rad = (0..256).map(row).collect();
                    let count = 4096;
                    lidar.beams.columns =
                        Some(LidarColumns { count, first_rad: 3.0, last_rad: -3.0 });
                });
                if let Some(RigChoice::Full(rig)) = &mut open.rig {
                    let second = wildcity_session::options::RigLidar {
                        name: "two".into(),
                        ..rig.lidars[0].clone()
                    };
                    rig.lidars.push(second);
                }
                open
            },
            "2097152 beams in all",
        ),
        (changed(&|lidar| lidar.beams.duration_us = 0), "duration_us is 0"),
        (changed(&|lidar| lidar.beams.row_elevations_rad[3] = 0.5), "rise or fall"),
        (changed(&|lidar| lidar.beams.column_azimuths_rad = Some(vec![0.0])), "give either"),
        (changed(&|lidar| lidar.beams.min_range_m = Some(f64::NAN)), "min_range_m"),
        (changed(&|lidar| lidar.name = "front".to_owned()), "occurs twice"),
        (
            Open {
                sensors: Some(Sensors {
                    lidars: [("roof".to_owned(), LidarSensor::default())].into(),
                    ..Sensors::default()
                }),
                ..options(None)
            },
            "no LiDAR of the rig",
        ),
    ];
    for (number, (options, reason)) in cases.into_iter().enumerate() {
        let error = open(&bench, &format!("wrong{number}"), options).await.unwrap_err();
        assert!(error.to_string().contains(reason), "{error}");
    }
}
