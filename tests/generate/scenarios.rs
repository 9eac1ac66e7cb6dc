//! The demo's scenarios on the demo street: what they promise happens, and a driver that keeps its distance meets
//! nothing.

use wildcity_generate::{ActorModel, StreetSettings, street_map};
use wildcity_scene::geometry::Pose;
use wildcity_scene::{ActorBox, ActorClass, Trajectory};
use wildcity_sim::contact::{Contact, Detector};
use wildcity_sim::map::Map;
use wildcity_sim::scenario::{AssetInfo, Document, EgoStart, Scenario, Surroundings};
use wildcity_sim::traffic::{ActorState, EgoMotion, EgoState, Idm, World, rolled};

/// An episode of a scenario with a driver that follows the drive and keeps behind actors on it.
struct Driven {
    contacts: Vec<Contact>,
    /// The ego's station and speed, and all actors, every 0.1 s.
    steps: Vec<(f64, f64, Vec<ActorState>)>,
    names: Vec<String>,
}

fn drive(file: &str, seed: u64, seconds: u32) -> Driven {
    let settings = StreetSettings::default();
    let drives = [crate::DEMO.trajectory.clone()];
    let map = Map::new(street_map(&settings).unwrap()).unwrap();
    let text = std::fs::read(crate::root::root().join("scenes").join(file)).unwrap();
    let document = Document::parse(&text).unwrap();
    assert!(document.cases().len() >= 5);
    let asset = |name: &str| {
        ActorModel::NAMES.contains(&name).then_some(AssetInfo {
            hash: "0".repeat(64),
            class: ActorClass::Vehicle,
            box_: ActorBox::PEDESTRIAN,
        })
    };
    let around = Surroundings { drives: &drives, tracks: None, map: Some(&map), asset: &asset };
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
}

#[test]
fn the_van_cuts_in_and_a_careful_driver_stays_behind() {
    for seed in 0..5 {
        let driven = drive("cut-in.json", seed, 20);
        assert_eq!(driven.contacts, [], "seed {seed}");
        let van = driven.index("van");
        let [before, after] = [&driven.steps[10], &driven.steps[60]];
        let left_m = |step: &(f64, f64, Vec<ActorState>), log: &Trajectory| {
            let course = wildcity_sim::traffic::Course::from_drive(log).unwrap();
            course.nearest(step.2[van].world_from_actor.position_m)
        };
        let log = &crate::DEMO.trajectory;
        assert!(left_m(before, log).left_m > 3.0, "in the other lane at first");
        let cut = left_m(after, log);
        assert!(cut.left_m.abs() < 0.3 && cut.station_m > after.0, "ahead in the ego's lane");
        let slowest_mps = driven.steps.iter().map(|step| step.1).fold(f64::MAX, f64::min);
        assert!(slowest_mps < 5.0, "the ego had to brake: {slowest_mps}");
    }
}

#[test]
fn traffic_flows_and_the_walker_crosses() {
    for seed in 0..3 {
        let driven = drive("traffic.json", seed, 35);
        assert_eq!(driven.contacts, [], "seed {seed}");
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
