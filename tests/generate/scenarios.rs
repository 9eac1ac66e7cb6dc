//! The demo's scenarios on the demo street: what they promise happens, and a driver that keeps its
//! distance meets nothing.

use wildcity_generate::{ActorModel, StreetSettings, street_map};
use wildcity_scene::geometry::Pose;
use wildcity_scene::{ActorBox, ActorClass};
use wildcity_sim::contact::{Contact, Detector};
use wildcity_sim::map::Map;
use wildcity_sim::scenario::{AssetInfo, Assets, Document, EgoStart, Scenario, Surroundings};
use wildcity_sim::traffic::{
    ActorState, Course, CourseFootPoint, EgoMotion, EgoState, Idm, World, rolled,
};

/// An episode of a scenario with a driver that follows the drive and keeps behind actors on it.
struct Driven {
    contacts: Vec<Contact>,
    /// The ego's station and speed, and all actors, every 0.1 s.
    steps: Vec<(f64, f64, Vec<ActorState>)>,
    names: Vec<String>,
}

/// The generated models by their names, as if each were a small car.
struct Models;

impl Assets for Models {
    fn find(&self, name: &str) -> Result<AssetInfo, String> {
        let info = AssetInfo {
            hash: "0".repeat(64),
            class: ActorClass::Vehicle,
            box_: ActorBox::PEDESTRIAN,
        };
        ActorModel::NAMES.contains(&name).then_some(info).ok_or_else(|| name.to_owned())
    }

    fn default_for(&self, _: ActorClass, _: &ActorBox) -> Result<Option<AssetInfo>, String> {
        Ok(None)
    }
}

fn drive(file: &str, seed: u64, seconds: u32) -> Driven {
    let settings = StreetSettings::default();
    let drives = [crate::DEMO.trajectory.clone()];
    let map = Map::new(street_map(&settings).unwrap()).unwrap();
    let text = std::fs::read(crate::root::root().join("scenes").join(file)).unwrap();
    let document = Document::parse(&text).unwrap();
    assert!(document.cases().len() >= 5);
    let around = Surroundings { drives: &drives, tracks: None, map: Some(&map), assets: &Models };
    let scenario =
        Scenario::resolve(document.with(&document.first_values()).unwrap(), seed, &around).unwrap();
    let Some(EgoStart::Station { station_m, .. }) = scenario.start else { panic!("a station") };
    let traffic = scenario.traffic.clone();
    let specs: Vec<_> = traffic.actors.iter().map(|actor| actor.spec.clone()).collect();
    let route = scenario.route.clone().unwrap();
    let state = |station_m: f64, speed_mps: f64| {
        let pose: Pose = drives[0].at_station(station_m);
        let velocity_mps = pose.rotation * (speed_mps * glam::DVec3::X);
        EgoState { world_from_rig: pose, velocity_mps, yaw_rate_radps: 0.0 }
    };
    let mut station_m = station_m;
    let mut speed_mps = scenario.dynamics.unwrap().speed_m_s;
    let mut world = World::new(traffic.clone());
    let begin = state(station_m, speed_mps);
    let (mut detector, mut contacts) =
        Detector::at_start(traffic.ego_box, &specs, &begin, world.states());
    let mut steps = Vec::new();
    for _ in 0..10 * seconds {
        // The nearest actor within 1.6 m of the drive ahead, from the ego's front to its rear.
        let mut acceleration = Idm::WILDCITY.acceleration(speed_mps, 0.0, f64::INFINITY);
        for actor in world.states().iter().filter(|actor| actor.present) {
            let beside = route.course.nearest(actor.world_from_actor.position_m);
            let half_m = 0.5 * specs[usize::from(actor.index)].box_.length_m;
            let gap_m = beside.station_m - half_m - station_m - 1.3 - 0.5 * 5.393;
            if beside.left_m.abs() < 2.2 && gap_m > -1.0 {
                let ahead = route.course.at(beside.station_m).rotation * glam::DVec3::X;
                let lead_mps = actor.velocity_mps.dot(ahead);
                let follow = Idm { braking_mps2: 6.0, ..Idm::WILDCITY };
                acceleration = acceleration.min(follow.acceleration(speed_mps, lead_mps, gap_m));
            }
        }
        let [way_m, next_mps] = rolled(speed_mps, acceleration, 0.1);
        let from = state(station_m, speed_mps);
        station_m += way_m;
        speed_mps = next_mps;
        let motion = EgoMotion { from, to: state(station_m, speed_mps), smooth: true };
        world.step(100_000, &motion, &mut |sub_step| {
            contacts.extend(detector.advance(sub_step, &specs, None));
        });
        steps.push((station_m, speed_mps, world.states().to_vec()));
    }
    let names = specs.into_iter().map(|spec| spec.name).collect();
    Driven { contacts, steps, names }
}

impl Driven {
    fn index(&self, name: &str) -> usize {
        self.names.iter().position(|other| other == name).unwrap()
    }

    /// The ego's station, and the place of an actor relative to the ego's drive, while the actor is
    /// present.
    fn beside(&self, name: &str) -> Vec<(f64, CourseFootPoint)> {
        let course = Course::from_drive(&crate::DEMO.trajectory).unwrap();
        let index = self.index(name);
        let there = self.steps.iter().map(|step| (step.0, step.2[index]));
        let present = there.filter(|(_, actor)| actor.present);
        present
            .map(|(ego_m, actor)| (ego_m, course.nearest(actor.world_from_actor.position_m)))
            .collect()
    }

    /// Asserts that cars from ahead keep to their own lane, 3.5 m to the left of the drive, and
    /// that at least one passes the ego within some steps.
    fn check_oncoming(&self, steps: usize) {
        let oncoming = self.names.iter().filter(|name| name.starts_with("oncoming"));
        let passed = oncoming.map(|name| {
            let places = self.beside(name);
            // Beyond the ends of the drive there is no lane.
            let on_drive = places.iter().filter(|(_, at)| (5.0..260.0).contains(&at.station_m));
            for (_, at) in on_drive {
                assert!((at.left_m - 3.5).abs() < 0.3, "{name}: {} m to the left", at.left_m);
            }
            assert!(places[0].1.station_m > places[0].0 + 50.0, "{name} comes from ahead");
            places.iter().take(steps).any(|(ego_m, at)| at.station_m < *ego_m)
        });
        assert!(passed.collect::<Vec<_>>().contains(&true), "no car passed the ego");
    }
}

#[test]
fn the_van_cuts_in_and_a_careful_driver_stays_behind() {
    for seed in 0..5 {
        let driven = drive("cut-in.json", seed, 20);
        assert_eq!(driven.contacts, [], "seed {seed}");
        let van = driven.beside("van");
        assert!(van[10].1.left_m > 3.0, "in the other lane at first");
        let (ego_m, cut) = van[60];
        assert!(cut.left_m.abs() < 0.3 && cut.station_m > ego_m, "ahead in the ego's lane");
        // Within the steps that the demo drives.
        driven.check_oncoming(100);
        let slowest_mps = driven.steps.iter().map(|step| step.1).fold(f64::MAX, f64::min);
        assert!(slowest_mps < 5.0, "the ego had to brake: {slowest_mps}");
    }
}

#[test]
fn traffic_flows_and_the_walker_crosses() {
    for seed in 0..3 {
        let driven = drive("traffic.json", seed, 35);
        assert_eq!(driven.contacts, [], "seed {seed}");
        driven.check_oncoming(150);
        // It is on the ego's lane before the ego, which waits.
        let crossing: Vec<_> = driven.beside("walker").into_iter().enumerate().collect();
        let on_lane = crossing.iter().filter(|(_, (_, at))| at.left_m.abs() < 1.5);
        let gaps_m: Vec<f64> = on_lane.map(|(_, (ego_m, at))| at.station_m - ego_m).collect();
        let nearest_m = gaps_m.iter().copied().fold(f64::INFINITY, f64::min);
        assert!((4.0..20.0).contains(&nearest_m), "seed {seed}: {nearest_m} m before the ego");
        let waits = crossing.iter().filter(|(_, (_, at))| at.left_m.abs() < 2.0);
        let slowest_mps =
            waits.map(|(step, _)| driven.steps[*step].1).fold(f64::INFINITY, f64::min);
        assert!(slowest_mps < 4.0, "seed {seed}: {slowest_mps} m/s");
        let walker = driven.index("walker");
        let [first, last] = [&driven.steps[0], driven.steps.last().unwrap()];
        let way_m = last.2[walker].world_from_actor.position_m
            - first.2[walker].world_from_actor.position_m;
        assert!((12.0..13.2).contains(&way_m.length()), "across the street: {way_m}");
        let lead = driven.index("lead");
        let driven_m = (last.2[lead].world_from_actor.position_m
            - first.2[lead].world_from_actor.position_m)
            .length();
        assert!(driven_m > 100.0, "{driven_m}");
        let gone = driven.steps.last().unwrap().2.iter().filter(|actor| !actor.present).count();
        assert!(gone >= 1, "oncoming cars that left: {gone}");
    }
}
