//! Scores of whole episodes: verdicts, missing inputs, and the traps of standing and teleported
//! egos.

use glam::DVec2;

use wildcity_scene::ActorClass;
use wildcity_score::own::{Criterion, Fault, Judgement, verdict};
use wildcity_score::{
    DriveRecord, EgoSample, EgoShape, Lane, LaneMap, NO_MAP, NO_REFERENCE, Polyline,
    ReferenceDrive, StaticContact, Track, TrackSample, lower_is_better, score, score_range,
};
use wildcity_sim::contact::{CollisionType, Contact, Footprint};

use crate::thread_time::thread_time;

const SHAPE: EgoShape = EgoShape { length_m: 5.0, width_m: 2.0, center_x_m: 1.3 };

/// A drive of 10 s along x at `speed_mps`, along a recorded one at 10 m/s, with a parked car 100 m
/// aside.
fn drive(speed_mps: f64) -> DriveRecord {
    let sample = |step: i32| EgoSample {
        origin_m: DVec2::new(0.1 * f64::from(step) * speed_mps, 0.0),
        velocity_mps: DVec2::new(speed_mps, 0.0),
        ..EgoSample::default()
    };
    let ego: Vec<EgoSample> = (0..=100).map(sample).collect();
    let parked = TrackSample {
        footprint: Footprint::new(DVec2::new(50.0, 100.0), 0.0, 4.0, 2.0),
        velocity_mps: DVec2::ZERO,
    };
    let track = Track {
        name: "parked".to_owned(),
        class: ActorClass::Vehicle,
        samples: vec![Some(parked); ego.len()],
    };
    let points_m = (0..=10).map(|k| DVec2::new(10.0 * f64::from(k), 0.0)).collect();
    DriveRecord {
        dt_us: 100_000,
        shape: Some(SHAPE),
        ego,
        is_driven: true,
        tracks: Some(vec![track]),
        plans: Vec::new(),
        contacts: Vec::new(),
        static_contacts: Some(Vec::new()),
        reference: Some(ReferenceDrive {
            line: Polyline::new(points_m).unwrap(),
            times_us: (0..=10).map(|k| k * 1_000_000).collect(),
        }),
        no_reference: NO_REFERENCE,
        limit_us: Some(10_000_000),
        map: None,
        no_map: NO_MAP,
        least_progress: 0.8,
        off_model_us: None,
    }
}

fn contact(time_us: i64, ego_mps: f64, ego_at_fault: bool) -> Contact {
    Contact {
        actor: 0,
        time_us,
        at_start: false,
        kind: CollisionType::ActiveFront,
        ego_at_fault,
        normal: DVec2::X,
        impact_mps: ego_mps,
        ego_velocity_mps: DVec2::new(ego_mps, 0.0),
        actor_velocity_mps: DVec2::ZERO,
    }
}

/// The same drive on a road.
fn on_road(record: DriveRecord) -> DriveRecord {
    DriveRecord { map: Some(map(vec![lane([-10.0, 200.0], [-5.0, 5.0], true)])), ..record }
}

/// A drive next to or behind another box.
fn drive_with(speed_mps: f64, other: Footprint, other_mps: f64) -> DriveRecord {
    let mut record = drive(speed_mps);
    let track = &mut record.tracks.as_mut().unwrap()[0];
    for (step, sample) in track.samples.iter_mut().enumerate() {
        let way_m = DVec2::new(0.1 * step as f64 * other_mps, 0.0);
        let velocity_mps = DVec2::new(other_mps, 0.0);
        *sample = Some(TrackSample { footprint: other.shifted(way_m), velocity_mps });
    }
    record
}

/// A lane from one x to another, with a half width to each side of y = 0.
fn lane(x_m: [f64; 2], y_m: [f64; 2], is_on_route: bool) -> Lane {
    let corner = |x: usize, y: usize| DVec2::new(x_m[x], y_m[y]);
    let outline_m = vec![corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
    Lane { outline_m, center: None, is_on_route, is_intersection: false }
}

fn map(lanes: Vec<Lane>) -> LaneMap {
    let centerline = Polyline::new(vec![DVec2::ZERO, DVec2::new(150.0, 0.0)]).unwrap();
    LaneMap { lanes, centerline, red: Vec::new() }
}

fn part(record: &DriveRecord, name: &str, part: &str) -> Option<f64> {
    let scores = score(record);
    let found = scores.iter().find(|score| score.name == name);
    found.unwrap_or_else(|| panic!("no score {name}")).parts[part]
}

fn near(found: Option<f64>, expected: f64) -> bool {
    found.is_some_and(|found| (found - expected).abs() < 1e-9)
}

fn value(record: &DriveRecord, name: &str) -> Option<f64> {
    let scores = score(record);
    let found = scores.iter().find(|score| score.name == name);
    found.unwrap_or_else(|| panic!("no score {name}")).value
}

#[test]
fn a_drive_as_recorded_passes_and_standing_does_not() {
    let log = on_road(drive(10.0));
    let judged = verdict(&log);
    assert_eq!((judged.judgement, judged.progress), (Judgement::Passed, Some(1.0)));
    assert_eq!(value(&log, "alpasim.scene@3032e0c"), Some(1.0));
    assert_eq!(value(&log, "neuroncap.score@ecdcf28"), Some(5.0));
    assert_eq!(value(&log, "bench2drive.smoothness@7ec25d1"), Some(1.0));

    let stand = verdict(&drive(0.0));
    assert_eq!(stand.judgement, Judgement::Failed);
    assert_eq!(stand.faults[0].fault, Fault::Progress);
    // 7.9 m/s are 79 m of 100; 8 m/s are 80.
    assert_eq!(verdict(&on_road(drive(7.9))).judgement, Judgement::Failed);
    assert_eq!(verdict(&on_road(drive(8.0))).judgement, Judgement::Passed);
}

#[test]
fn a_criterion_that_is_not_judged_is_no_pass_and_hides_no_fault() {
    let whole = || on_road(drive(10.0));
    let unseen: [(Criterion, DriveRecord); 4] = [
        (Criterion::Contact, DriveRecord { tracks: None, ..whole() }),
        (Criterion::Static, DriveRecord { static_contacts: None, ..whole() }),
        (Criterion::OffRoad, DriveRecord { map: None, ..whole() }),
        (Criterion::Progress, DriveRecord { reference: None, ..whole() }),
    ];
    for (criterion, mut record) in unseen {
        let judged = verdict(&record);
        let missing: Vec<Criterion> = judged.not_judged.iter().map(|one| one.criterion).collect();
        assert_eq!((judged.judgement, missing), (Judgement::NotJudged, vec![criterion]));
        let text = judged.not_judged[0].to_string();
        assert!(text.starts_with(&format!("{}: ", criterion.name())), "{text}");
        if criterion != Criterion::Contact {
            record.contacts.push(contact(2_000_000, 10.0, true));
            assert_eq!(verdict(&record).judgement, Judgement::Failed, "{criterion:?}");
        }
    }
}

#[test]
fn contacts_are_not_judged_after_a_jump() {
    let mut record = on_road(drive(10.0));
    // From 50 m on it is 7 m ahead, which takes 80 m/s within a step.
    for sample in &mut record.ego[50..] {
        sample.origin_m.x += 7.0;
    }
    assert_eq!(verdict(&record).judgement, Judgement::Passed, "driven, so that it was swept");
    record.is_driven = false;
    let judged = verdict(&record);
    let missing: Vec<Criterion> = judged.not_judged.iter().map(|one| one.criterion).collect();
    assert_eq!(judged.judgement, Judgement::NotJudged);
    assert_eq!(missing, [Criterion::Contact, Criterion::Static]);
    // 4 m more than its 1 m are 50 m/s, which was swept.
    for sample in &mut record.ego[50..] {
        sample.origin_m.x -= 3.0;
    }
    assert_eq!(verdict(&record).judgement, Judgement::Passed);
}

#[test]
fn what_lies_within_long_steps_is_not_judged() {
    let mut record = on_road(drive(10.0));
    record.dt_us = 500_000;
    let criteria = |record: &DriveRecord| {
        let not_judged = verdict(record).not_judged;
        not_judged.iter().map(|one| one.criterion).collect::<Vec<_>>()
    };
    assert_eq!(criteria(&record), []);
    record.dt_us = 500_001;
    assert_eq!(criteria(&record), [Criterion::Contact, Criterion::Static, Criterion::OffRoad]);
    assert_ne!(verdict(&record).judgement, Judgement::Passed);
}

#[test]
fn contacts_fail_by_fault_and_pedestrians_always() {
    let with = |class: ActorClass, contact: Contact| {
        let mut record = on_road(drive(10.0));
        record.tracks.as_mut().unwrap()[0].class = class;
        record.contacts.push(contact);
        verdict(&record)
    };
    let at_fault = with(ActorClass::Vehicle, contact(2_000_000, 10.0, true));
    assert_eq!(at_fault.judgement, Judgement::Failed);
    assert_eq!(
        (at_fault.faults[0].fault, at_fault.impact_mps),
        (Fault::ContactAtFault, Some(10.0))
    );
    let run_into = with(ActorClass::Vehicle, contact(2_000_000, 10.0, false));
    assert_eq!(run_into.judgement, Judgement::Passed);
    let person = with(ActorClass::Pedestrian, contact(2_000_000, 10.0, false));
    assert_eq!(person.faults[0].fault, Fault::Pedestrian);
    let standing = with(ActorClass::Pedestrian, contact(2_000_000, 0.0, false));
    assert_eq!(standing.judgement, Judgement::Passed, "a standing ego is run into");
    let overlap = Contact { at_start: true, ..contact(0, 10.0, true) };
    assert_eq!(with(ActorClass::Vehicle, overlap).judgement, Judgement::Passed);
}

#[test]
fn contacts_with_the_twin_and_the_edge_of_the_road_fail() {
    let mut record = drive(10.0);
    record.static_contacts = Some(vec![StaticContact { time_us: 3_000_000, impact_mps: 10.0 }]);
    let judged = verdict(&record);
    assert_eq!((judged.faults[0].fault, judged.faults[0].time_us), (Fault::Static, 3_000_000));

    // The ego reaches 1 m to each side and, from its origin, from -1.2 m to 3.8 m.
    let mut record = drive(10.0);
    let road = [-10.0, 150.0];
    record.map = Some(map(vec![lane(road, [-3.0, 0.5], true), lane(road, [0.5, 3.0], true)]));
    assert_eq!(verdict(&record).judgement, Judgement::Passed, "several lanes are a road");
    record.map = Some(map(vec![lane([-10.0, 83.9], [-3.0, 3.0], true)]));
    let judged = verdict(&record);
    // The front passes 83.9 m after the sample at 80 m, which it reaches at 83.8 m.
    assert_eq!((judged.faults[0].fault, judged.faults[0].time_us), (Fault::OffRoad, 8_100_000));
}

#[test]
fn a_recording_that_stands_says_nothing_of_progress() {
    let mut record = drive(0.0);
    let reference = record.reference.as_mut().unwrap();
    reference.line =
        Polyline::new((0..=10).map(|k| DVec2::new(0.19 * f64::from(k), 0.0)).collect()).unwrap();
    assert_eq!(verdict(&record).progress, Some(1.0));
}

#[test]
fn the_measures_beside_the_verdict_are_those_of_the_drive() {
    // The rear of the other is at 118 m; the ego's front comes to 103.8 m at 10 m/s.
    let other = Footprint::new(DVec2::new(120.0, 0.0), 0.0, 4.0, 2.0);
    let mut record = drive_with(10.0, other, 0.0);
    record.ego[40].acceleration_mps2 = DVec2::new(-1.5, 9.9);
    record.ego[41].velocity_mps = DVec2::new(10.0, 1.0);
    record.ego[41].yaw_rate_radps = -0.2;
    record.contacts = vec![contact(1_000_000, 6.0, false), contact(7_000_000, 4.0, false)];
    let judged = verdict(&record);
    assert!(near(judged.least_ttc_s, 1.42), "{:?}", judged.least_ttc_s);
    assert_eq!(judged.impact_mps, Some(6.0));
    assert_eq!(judged.accelerations_mps2, Some([1.5, 2.0]));
    // The recorded drive goes 10 m/s in its last 0.5 s.
    assert!(near(value(&record, "neuroncap.score@ecdcf28"), 4.0 * 0.4));
}

#[test]
fn stations_follow_a_route_that_comes_back_beside_itself() {
    let corners = [[0.0, 0.0], [100.0, 0.0], [100.0, 1.0], [0.0, 1.0]];
    let mut record = drive(5.0);
    for sample in &mut record.ego {
        sample.origin_m.y = 0.9;
    }
    let reference = record.reference.as_mut().unwrap();
    reference.line = Polyline::new(corners.map(DVec2::from_array).to_vec()).unwrap();
    reference.times_us = vec![0, 10_000_000, 10_100_000, 20_100_000];
    assert!((reference.station_at_m(2_500_000) - 25.0).abs() < 1e-9);
    let stations_m = record.stations_m().unwrap();
    assert!((stations_m[100].0 - 50.0).abs() < 1e-9, "{:?}", stations_m[100]);
}

#[test]
fn infractions_of_bench2drive_are_counted_once_and_of_a_moving_ego() {
    const NAME: &str = "bench2drive.driving@7ec25d1";
    let count = |speed_mps: f64, seconds: &[i64]| {
        let mut record = drive(speed_mps);
        let at = |second: &i64| contact(1_000_000 * second, speed_mps, true);
        record.contacts = seconds.iter().map(at).collect();
        part(&record, NAME, "infractions")
    };
    assert_eq!(count(10.0, &[1, 3]), Some(1.0), "within 5 s");
    assert_eq!(count(0.5, &[1, 8]), Some(1.0), "within 5 m");
    assert_eq!(count(10.0, &[1, 8]), Some(2.0));
    assert_eq!(count(0.05, &[1]), Some(0.0), "a standing ego is not charged");

    let mut record = drive(10.0);
    record.contacts = vec![contact(1_000_000, 10.0, true)];
    let road = [-3.0, 3.0];
    let lanes = vec![lane([-10.0, 50.5], road, true), lane([50.5, 150.0], road, false)];
    record.map = Some(map(lanes));
    assert!(near(part(&record, NAME, "outside_percent"), 50.0));
    assert!(near(value(&record, NAME), 100.0 * 0.6 * 0.5));
    // The traffic is half as fast as the ego.
    let record = drive_with(10.0, Footprint::new(DVec2::new(30.0, 3.5), 0.0, 4.0, 2.0), 5.0);
    assert!(near(value(&record, "bench2drive.efficiency@7ec25d1"), 200.0));
}

#[test]
fn the_parts_of_epdms_are_those_of_the_drive() {
    const NAME: &str = "navsim.epdms@0a380a9";
    let parts = [
        "no_at_fault_collisions",
        "drivable_area_compliance",
        "driving_direction_compliance",
        "time_to_collision_within_bound",
        "lane_keeping",
    ];
    let of = |record: &DriveRecord| parts.map(|name| part(record, NAME, name));
    let road = || Some(map(vec![lane([-10.0, 160.0], [-3.0, 3.0], true)]));
    let aside = Footprint::new(DVec2::new(50.0, 100.0), 0.0, 4.0, 2.0);
    let mut clean = drive_with(10.0, aside, 0.0);
    assert_eq!(of(&clean), [None; 5], "without a map");
    clean.map = road();
    assert_eq!(of(&clean), [Some(1.0); 5]);
    assert_eq!(value(&clean, NAME), None, "without PDM-Closed there is no score");
    assert_eq!(part(&clean, NAME, "extended_comfort"), None);

    // In the second 4 s the ego runs into a car that stands, on the wrong side of the road's
    // middle.
    let mut hit = drive_with(10.0, Footprint::new(DVec2::new(60.0, 1.0), 0.0, 4.0, 2.0), 0.0);
    hit.map = road();
    for sample in &mut hit.ego {
        sample.origin_m.y = 0.6;
    }
    assert_eq!(of(&hit), [Some(0.0), Some(1.0), Some(1.0), Some(0.0), Some(0.0)]);
    // The rest of a drive after the last whole 4 s is not tested.
    hit.ego.truncate(44);
    for track in hit.tracks.as_mut().unwrap() {
        track.samples.truncate(44);
    }
    assert_eq!(of(&hit), [Some(1.0), Some(1.0), Some(1.0), Some(1.0), Some(0.0)]);
}

#[test]
fn the_ego_of_alpasim_is_smaller_and_rounded_and_is_cut_off_its_way() {
    const NAME: &str = "alpasim.scene@3032e0c";
    let hit = |record: &DriveRecord| part(record, NAME, "collision_at_fault");
    let beside = |y_m: f64| Footprint::new(DVec2::new(50.0, y_m), 0.0, 4.0, 2.0);
    // Half of 0.98 of the ego's 2 m, and half of the other's 2 m.
    assert_eq!(hit(&drive_with(10.0, beside(1.99), 0.0)), Some(0.0));
    assert_eq!(hit(&drive_with(10.0, beside(1.97), 0.0)), Some(1.0));

    // A corner of the other, 5 cm within the corner of the ego, which has a radius of 0.49 m.
    let center_m = DVec2::new(1.3 + 0.98 * 2.5 - 0.05 + 2.0, 0.98 - 0.05 + 1.0);
    assert_eq!(hit(&drive_with(0.0, Footprint::new(center_m, 0.0, 4.0, 2.0), 0.0)), Some(0.0));
    let inner_m = center_m - DVec2::splat(0.15);
    assert_eq!(hit(&drive_with(0.0, Footprint::new(inner_m, 0.0, 4.0, 2.0), 0.0)), Some(1.0));

    // More than 4 m off the recorded drive nothing counts any more.
    for (off_m, expected) in [(3.9, 1.0), (4.1, 0.0)] {
        let mut record = drive_with(10.0, beside(off_m), 0.0);
        for sample in &mut record.ego {
            sample.origin_m.y = off_m;
        }
        assert_eq!(hit(&record), Some(expected), "{off_m} m");
    }
}

#[test]
fn off_model_counts_only_before_the_fault() {
    let mut record = drive(10.0);
    record.contacts.push(contact(2_000_000, 10.0, true));
    record.off_model_us = Some(1_900_000);
    assert_eq!(verdict(&record).judgement, Judgement::OffModel);
    record.off_model_us = Some(2_000_000);
    assert_eq!(verdict(&record).judgement, Judgement::Failed);
    assert!(value(&record, "wildcity.verdict@3") == Some(0.0));
}

#[test]
fn what_is_missing_is_null_with_the_reason_and_never_0() {
    let mut record = drive(10.0);
    record.tracks = None;
    record.reference = None;
    record.shape = None;
    record.static_contacts = None;
    assert_eq!(verdict(&record).judgement, Judgement::NotJudged);
    for score in score(&record) {
        if score.name == "bench2drive.smoothness@7ec25d1" {
            assert_eq!(score.value, Some(1.0), "it needs the ego alone");
            continue;
        }
        assert_eq!(score.value, None, "{}", score.name);
        assert!(score.reason.is_some_and(|reason| reason.len() > 10), "{}", score.name);
    }
}

#[test]
fn neuroncap_has_no_stars_for_contacts_that_its_check_leaves_out() {
    const NAME: &str = "neuroncap.score@ecdcf28";
    let mut record = drive(10.0);
    record.contacts.push(contact(2_000_000, 4.0, true));
    for (class, stars) in [
        (ActorClass::Vehicle, Some(4.0 * 0.6)),
        (ActorClass::Bicycle, Some(4.0 * 0.6)),
        (ActorClass::Pedestrian, None),
        (ActorClass::Object, None),
    ] {
        record.tracks.as_mut().unwrap()[0].class = class;
        let found = value(&record, NAME);
        assert_eq!(found.map(|stars| (10.0 * stars).round()), stars.map(|stars| 10.0 * stars));
        let scores = score(&record);
        let reason = scores.iter().find(|score| score.name == NAME).unwrap().reason.as_deref();
        assert_eq!(reason.is_some_and(|reason| reason.contains("leaves out")), stars.is_none());
    }
}

#[test]
fn every_score_has_a_range_and_stays_in_it() {
    let mut hit = drive(14.0);
    hit.contacts.push(contact(2_000_000, 10.0, true));
    for record in [drive(10.0), drive(0.0), hit] {
        for score in score(&record) {
            let [least, most] = score_range(score.name);
            assert_eq!(least, 0.0, "{} has no range", score.name);
            let is_within = score.value.is_none_or(|value| (least..=most).contains(&value));
            assert!(is_within, "{}: {:?} in {least}..{most}", score.name, score.value);
        }
    }
    // Shares, stars, percents and metres.
    assert_eq!(score_range("wildcity.verdict@3"), [0.0, 1.0]);
    assert_eq!(score_range("neuroncap.score@ecdcf28"), [0.0, 5.0]);
    assert_eq!(score_range("bench2drive.driving@7ec25d1"), [0.0, 100.0]);
    assert_eq!(score_range("alpasim.open_loop_collision@3032e0c"), [0.0, 1.0]);
    assert_eq!(score_range("alpasim.min_ade_5s@3032e0c"), [0.0, f64::INFINITY]);
}

#[test]
fn deviations_and_mistakes_are_better_when_they_are_lower() {
    let names: Vec<&str> = score(&drive(10.0)).iter().map(|score| score.name).collect();
    let lower: Vec<&str> = names.into_iter().filter(|name| lower_is_better(name)).collect();
    let bases: Vec<&str> = lower.iter().map(|name| name.split_once('@').unwrap().0).collect();
    let wanted = [
        "alpasim.offroad",
        "alpasim.wrong_lane",
        "alpasim.plan_deviation",
        "alpasim.open_loop_collision",
        "alpasim.min_ade_0.5s",
        "alpasim.min_ade_1s",
        "alpasim.min_ade_2.5s",
        "alpasim.min_ade_5s",
    ];
    assert_eq!(bases, wanted);
}

#[test]
fn all_values_are_finite_standing_and_teleported() {
    for (speed_mps, steps, is_driven) in [(0.0, 101, true), (0.0, 1, true), (10.0, 101, false)] {
        let mut record = drive(speed_mps);
        record.ego.truncate(steps);
        record.is_driven = is_driven;
        for score in score(&record) {
            let values = score.value.iter().chain(score.parts.values().flatten());
            assert!(values.clone().all(|value| value.is_finite()), "{score:?}");
            assert_eq!(score.value.is_none(), score.reason.is_some(), "{score:?}");
        }
        let comfort = value(&record, "bench2drive.smoothness@7ec25d1");
        assert_eq!(comfort.is_some(), is_driven && steps > 3, "comfort of a teleport is null");
    }
}

/// An episode of `steps` steps among 30 lanes and 30 actors.
fn busy_drive(steps: usize) -> DriveRecord {
    let mut record = drive(3.0);
    let sample = record.ego[0];
    record.ego.resize(steps, sample);
    let track = record.tracks.as_ref().unwrap()[0].clone();
    let many = (0..30).map(|_| Track { samples: vec![track.samples[0]; steps], ..track.clone() });
    record.tracks = Some(many.collect());
    // 30 lanes of 120 corners: the ego, on the line between two of them, is in both.
    let strip = |lane: i32| {
        let side = |edge: i32| {
            (0..60).map(move |k| DVec2::new(f64::from(6 * k) - 50.0, 3.0 * f64::from(edge)))
        };
        let outline_m = side(lane).chain(side(lane + 1).rev()).collect();
        Lane { outline_m, center: None, is_on_route: true, is_intersection: false }
    };
    record.map = Some(map((-15..15).map(strip).collect()));
    let points_m = (0..600).map(|k| DVec2::new(0.5 * f64::from(k), 0.0)).collect();
    record.reference = Some(ReferenceDrive {
        line: Polyline::new(points_m).unwrap(),
        times_us: (0..600).map(|k| k * 50_000).collect(),
    });
    record
}

#[test]
fn an_episode_is_scored_in_a_time_in_proportion_to_its_steps() {
    let least = |steps| {
        let record = busy_drive(steps);
        let once = || thread_time(|| assert_eq!(score(&record).len(), 17));
        (0..3).map(|_| once()).min().unwrap().as_secs_f64()
    };
    // 32 times the steps take about 32 times as long; if each step looked at all others, up to
    // 1,024 times.
    let ratio = least(9_632) / least(301);
    assert!(ratio < 80.0, "{ratio}");
}
