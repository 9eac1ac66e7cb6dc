//! OpenSCENARIO: when a scenario ends, where the ego goes, and actors that move with others.

use glam::DVec3;
use wildcity_convert::openscenario::Part;
use wildcity_scene::geometry::Pose;
use wildcity_sim::scenario::{ActionSection, PhaseSection, SideSection};
use wildcity_sim::traffic::{EgoMotion, EgoState, World};

use crate::openscenario::{LANES, on_roads, resolved};

/// The states of the only actor after each tenth of a second, while the ego drives along its lane:
/// its middle, in metres, and its speed, in m/s. Also when the scenario's own condition ended it.
fn driven(text: &str, ego_mps: f64, seconds: f64) -> (Vec<(DVec3, f64)>, Option<f64>) {
    let scenario = resolved(on_roads(text, &[]).unwrap().file);
    let mut world = World::new(scenario.traffic);
    let state_at = |time_s: f64| EgoState {
        world_from_rig: Pose {
            position_m: DVec3::new(ego_mps * time_s, -1.5, 0.0),
            ..Pose::IDENTITY
        },
        velocity_mps: ego_mps * DVec3::X,
        yaw_rate_radps: 0.0,
    };
    let states = (0..(seconds * 10.0).round() as i32).map(|index| {
        let [from, to] = [index, index + 1].map(|index| state_at(f64::from(index) * 0.1));
        world.step(100_000, &EgoMotion { from, to, smooth: true }, &mut |_| {});
        let state = world.states()[0];
        (state.world_from_actor.position_m, state.velocity_mps.length())
    });
    (states.collect(), world.end_us().map(|end_us| end_us as f64 * 1e-6))
}

const STATE: &str = "<StopTrigger><ConditionGroup><Condition name=\"c\" delay=\"1\" conditionEdge=\"none\">\
    <ByValueCondition><StoryboardElementStateCondition storyboardElementType=\"KIND\" \
    storyboardElementRef=\"NAME\" state=\"STATE\"/></ByValueCondition></Condition></ConditionGroup></StopTrigger>";

fn stopped_by(kind: &str, name: &str, state: &str) -> String {
    let stop = STATE.replace("KIND", kind).replace("NAME", name).replace("STATE", state);
    LANES.replace("<StopTrigger/>", &stop)
}

#[test]
fn a_stop_trigger_waits_for_elements_of_the_storyboard() {
    let text = stopped_by("event", "change", "endTransition");
    let end = on_roads(&text, &[]).unwrap().file.end;
    let when = end.when.unwrap();
    assert_eq!((when.after.as_deref(), when.phase), (Some("van/change"), Some(PhaseSection::Done)));
    assert_eq!((when.delay_s, end.time_s), (Some(1.0), None));
    // The change begins at 2 s and takes 4 s.
    let (_, ended_s) = driven(&text, 0.0, 9.0);
    assert!(ended_s.is_some_and(|end_s| (end_s - 7.0).abs() < 0.025), "{ended_s:?}");
    // It brakes 1 s after that within 2 s: then the act is complete.
    let (_, ended_s) = driven(&stopped_by("act", "act", "completeState"), 0.0, 12.0);
    assert!(ended_s.is_some_and(|end_s| (end_s - 10.0).abs() < 0.05), "{ended_s:?}");
    let (_, ended_s) = driven(&stopped_by("event", "change", "startTransition"), 0.0, 4.0);
    assert!(ended_s.is_some_and(|end_s| (end_s - 3.0).abs() < 0.025), "{ended_s:?}");
}

#[test]
fn elements_of_one_name_cannot_be_waited_for() {
    // A second story with an act of the same name that begins later.
    let later = "<Story name=\"later\"><Act name=\"act\"><ManeuverGroup name=\"g\" maximumExecutionCount=\"1\">\
        <Actors selectTriggeringEntities=\"false\"><EntityRef entityRef=\"Van\"/></Actors></ManeuverGroup>\
        <StartTrigger><ConditionGroup><Condition name=\"t\" delay=\"0\" conditionEdge=\"none\"><ByValueCondition>\
        <SimulationTimeCondition value=\"7\" rule=\"greaterThan\"/></ByValueCondition></Condition></ConditionGroup>\
        </StartTrigger></Act></Story><StopTrigger>";
    for state in ["startTransition", "completeState"] {
        let text = stopped_by("act", "s::act", state).replacen("<StopTrigger>", later, 1);
        let error = on_roads(&text, &[]).unwrap_err();
        assert!(error.contains("act \"act\" is there several times"), "{error}");
    }
    let error = on_roads(&stopped_by("story", "other", "startTransition"), &[]).unwrap_err();
    assert!(error.contains("there is no story \"other\""), "{error}");
}

#[test]
fn a_stop_trigger_measures_entities() {
    let reach = "<StopTrigger><ConditionGroup><Condition name=\"c\" delay=\"0\" conditionEdge=\"rising\">\
        <ByEntityCondition><TriggeringEntities triggeringEntitiesRule=\"any\"><EntityRef entityRef=\"Ego\"/>\
        </TriggeringEntities><EntityCondition><TraveledDistanceCondition value=\"50\"/></EntityCondition>\
        </ByEntityCondition></Condition></ConditionGroup>\
        <ConditionGroup><Condition name=\"t\" delay=\"0\" conditionEdge=\"none\"><ByValueCondition>\
        <SimulationTimeCondition value=\"30\" rule=\"greaterThan\"/></ByValueCondition></Condition></ConditionGroup>\
        </StopTrigger>";
    let text = LANES.replace("<StopTrigger/>", reach);
    assert_eq!(on_roads(&text, &[]).unwrap().file.end.time_s, Some(30.0));
    let (_, ended_s) = driven(&text, 10.0, 6.0);
    assert!(ended_s.is_some_and(|end_s| (end_s - 5.0).abs() < 0.015), "{ended_s:?}");
    assert_eq!(driven(&text, 1.0, 6.0).1, None);
}

#[test]
fn a_stop_trigger_that_is_not_read_is_refused_or_left_out_on_request() {
    let unknown = stopped_by("event", "nothing", "endTransition");
    let error = on_roads(&unknown, &[]).unwrap_err();
    assert!(error.contains("\"nothing\"") && error.contains("--leave-out stop"), "{error}");
    assert!(error.starts_with("line "), "{error}");
    let read = on_roads(&unknown, &[Part::Stop]).unwrap();
    assert_eq!(read.file.end.when, None);
    assert!(read.notes.iter().any(|note| note.contains("left out (stop)")), "{:?}", read.notes);
}

#[test]
fn the_route_of_the_ego_is_that_of_the_agent() {
    let way = "<PrivateAction><RoutingAction><AssignRouteAction><Route name=\"r\" closed=\"false\">\
        <Waypoint routeStrategy=\"shortest\"><Position><LanePosition roadId=\"1\" laneId=\"-1\" s=\"20\"/></Position></Waypoint>\
        <Waypoint routeStrategy=\"shortest\"><Position><LanePosition roadId=\"1\" laneId=\"-2\" s=\"200\"/></Position></Waypoint>\
        </Route></AssignRouteAction></RoutingAction></PrivateAction>";
    let place = "</Position></TeleportAction></PrivateAction></Private>";
    let of_ego = |actions: &str| {
        let all = format!("</Position></TeleportAction></PrivateAction>{actions}</Private>");
        on_roads(&LANES.replacen(place, &all, 1), &[])
    };
    let read = of_ego(way).unwrap();
    // From where it starts, along its lane, up to beside the last way-point.
    let points = read.file.route.as_ref().and_then(|route| route.points.clone()).unwrap();
    let near =
        |point: [f64; 3], x: f64| (point[0] - x).abs() < 1e-3 && (point[1] + 1.5).abs() < 1e-3;
    assert!(near(points[0], 0.0) && near(points[points.len() - 1], 200.0), "{points:?}");
    assert_eq!(read.file.end.route_done, Some(false));
    assert_eq!(resolved(read.file).route.unwrap().course.length_m().round(), 200.0);
    let error = of_ego(&format!("{way}{way}")).unwrap_err();
    assert!(error.contains("second route") && error.contains("--leave-out ego"), "{error}");
    let nowhere = of_ego(&way.replace("laneId=\"-2\"", "laneId=\"-3\"")).unwrap_err();
    assert!(nowhere.contains("no lane -3") && nowhere.contains("--leave-out ego"), "{nowhere}");
}

/// The second event of the file with another action.
fn with_action(action: &str) -> String {
    let from = LANES
        .find("<LongitudinalAction><SpeedAction>\n   <SpeedActionDynamics dynamicsShape=\"linear\"")
        .unwrap();
    let end = "</LongitudinalAction>";
    let to = from + LANES[from..].find(end).unwrap() + end.len();
    format!("{}{action}{}", &LANES[..from], &LANES[to..]).replace("delay=\"1\"", "delay=\"0\"")
}

#[test]
fn a_distance_is_made_up_within_bounds_and_then_kept() {
    let action = "<LongitudinalAction><LongitudinalDistanceAction entityRef=\"Ego\" distance=\"40\" freespace=\"true\" \
        continuous=\"true\" coordinateSystem=\"road\" displacement=\"leadingReferencedEntity\">\
        <DynamicConstraints maxAcceleration=\"3\" maxDeceleration=\"2\" maxSpeed=\"30\"/></LongitudinalDistanceAction></LongitudinalAction>";
    let text = with_action(action);
    let file = on_roads(&text, &[]).unwrap().file;
    let ActionSection::KeepDistance(keep) = &file.actors[0].script[1].then[0] else { panic!() };
    assert_eq!((keep.gap_m, keep.side, keep.once), (Some(40.0), Some(SideSection::Ahead), None));
    // Of the ego's front, 3.9 m ahead of its place, to the van's rear, 2.5 m behind its middle.
    let (states, _) = driven(&text, 8.0, 24.0);
    for (index, (middle, speed_mps)) in states.iter().enumerate().skip(200) {
        let ego_m = 8.0 * 0.1 * (index + 1) as f64;
        let gap_m = middle.x - 2.5 - (ego_m + 3.9);
        assert!((gap_m - 40.0).abs() < 0.05 && (speed_mps - 8.0).abs() < 0.05, "{index}: {gap_m}");
    }
    for pair in states.windows(2) {
        let change_mps = pair[1].1 - pair[0].1;
        assert!((-0.2 - 1e-9..=0.3 + 1e-9).contains(&change_mps), "{change_mps}");
    }
    let jerk = text.replace("maxSpeed=\"30\"", "maxAccelerationRate=\"1\"");
    let error = on_roads(&jerk, &[]).unwrap_err();
    assert!(error.contains("<DynamicConstraints>: maxAccelerationRate"), "{error}");
    assert!(error.contains("--leave-out distances"), "{error}");
    let both = text.replace("distance=\"40\"", "distance=\"40\" timeGap=\"2\"");
    assert!(on_roads(&both, &[]).unwrap_err().contains("exactly one of distance and timeGap"));
}

#[test]
fn an_entity_begins_at_its_distance() {
    let speed = "<LongitudinalAction><SpeedAction><SpeedActionDynamics dynamicsShape=\"step\" \
        dynamicsDimension=\"time\" value=\"0\"/><SpeedActionTarget><AbsoluteTargetSpeed value=\"12\"/>\
        </SpeedActionTarget></SpeedAction></LongitudinalAction>";
    let place = "</Position></TeleportAction></PrivateAction></Private>";
    let text = LANES.replacen(
        place,
        &format!("</Position></TeleportAction></PrivateAction><PrivateAction>{speed}</PrivateAction></Private>"),
        1,
    );
    let from = text.rfind("<PrivateAction><LongitudinalAction><SpeedAction>\n").unwrap();
    let from =
        text[..from + 1].find("<PrivateAction><LongitudinalAction><SpeedAction>\n").unwrap_or(from);
    let to = from + text[from..].find("</PrivateAction>").unwrap();
    let gap = "<PrivateAction><LongitudinalAction><LongitudinalDistanceAction entityRef=\"Ego\" timeGap=\"2\" \
        freespace=\"true\" continuous=\"false\" displacement=\"leadingReferencedEntity\"/></LongitudinalAction>";
    let text = format!("{}{gap}{}", &text[..from], &text[to..]);
    let file = on_roads(&text, &[]).unwrap().file;
    let path = file.actors[0].path.as_ref().unwrap();
    assert_eq!(path.speed, 12.0);
    let (states, _) = driven(&text, 12.0, 1.0);
    // 2 s at 12 m/s between the boxes.
    let gap_m = states[9].0.x - 2.5 - (12.0 + 3.9);
    assert!((gap_m - 24.0).abs() < 0.01, "{gap_m}");
}

#[test]
fn entities_arrive_together() {
    let action = "<SynchronizeAction masterEntityRef=\"Ego\"><TargetPositionMaster>\
        <LanePosition roadId=\"1\" laneId=\"-1\" s=\"100\"/></TargetPositionMaster><TargetPosition>\
        <LanePosition roadId=\"1\" laneId=\"-2\" s=\"200\"/></TargetPosition>\
        <FinalSpeed><AbsoluteSpeed value=\"25\"/></FinalSpeed></SynchronizeAction>";
    let text = with_action(action);
    // The ego is there after 10 s, when the van's place, 1.4 m behind its middle, is at 200 m.
    let (states, _) = driven(&text, 10.0, 10.0);
    let (middle, speed_mps) = states[99];
    assert!((middle.x - 201.4).abs() < 0.1, "{middle}");
    assert!((speed_mps - 25.0).abs() < 0.2, "{speed_mps}");
    // A slower ego is there later.
    let (states, _) = driven(&text, 8.0, 12.5);
    assert!((states[124].0.x - 201.4).abs() < 0.1, "{}", states[124].0);
}

#[test]
fn a_place_relative_to_what_moves_is_refused_in_an_event() {
    for entity in ["Ego", "Van"] {
        let action = format!(
            "<TeleportAction><Position><RelativeObjectPosition entityRef=\"{entity}\" dx=\"5\" dy=\"0\"/>\
             </Position></TeleportAction>"
        );
        let error = on_roads(&with_action(&action), &[]).unwrap_err();
        assert!(error.contains("<RelativeObjectPosition>: is relative to where"), "{error}");
        assert!(error.contains("<LanePosition>"), "{error}");
    }
}

#[test]
fn a_maneuver_is_over_although_an_event_was_replaced() {
    // The change of lane takes 4 s; the brake replaces it after 1 s.
    let replaced = |kind: &str, name: &str| {
        let text = stopped_by(kind, name, "endTransition");
        let text = text.replace("priority=\"parallel\"", "priority=\"override\"");
        text.replacen("state=\"endTransition\"", "state=\"startTransition\"", 1)
    };
    // It fires at 3 s and brakes within 2 s; the trigger waits for 1 s more.
    let (_, ended_s) = driven(&replaced("maneuver", "m"), 0.0, 9.0);
    assert!(ended_s.is_some_and(|end_s| (end_s - 6.0).abs() < 0.05), "{ended_s:?}");
    // The event itself was not done.
    assert_eq!(driven(&replaced("event", "change"), 0.0, 9.0).1, None);
}

#[test]
fn timed_points_are_those_of_the_reference_point() {
    let vertex = |time_s: f64, x: f64| {
        format!(
            "<Vertex time=\"{time_s}\"><Position><WorldPosition x=\"{x}\" y=\"-4.5\"/></Position></Vertex>"
        )
    };
    let follow = format!(
        "<PrivateAction><RoutingAction><FollowTrajectoryAction><Trajectory name=\"t\" closed=\"false\"><Shape>\
         <Polyline>{}{}</Polyline></Shape></Trajectory><TimeReference><Timing domainAbsoluteRelative=\"absolute\" \
         scale=\"1\" offset=\"0\"/></TimeReference><TrajectoryFollowingMode followingMode=\"position\"/>\
         </FollowTrajectoryAction></RoutingAction></PrivateAction></Private></Actions>",
        vertex(0.0, 20.0),
        vertex(10.0, 120.0)
    );
    // Without events that move it.
    let story = LANES.find("<Story ").unwrap();
    let text = format!("{}<StopTrigger/></Storyboard></OpenSCENARIO>", &LANES[..story]);
    let text = text.replacen("</Private></Actions>", &follow, 1);
    let (states, _) = driven(&text, 0.0, 1.0);
    // 10 m/s for 1 s, and the middle of the box is 1.4 m ahead.
    assert!((states[9].0 - DVec3::new(31.4, -4.5, 0.0)).length() < 0.01, "{}", states[9].0);
}
