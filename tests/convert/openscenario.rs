//! OpenSCENARIO files.

use glam::DVec3;
use wildcity_convert::openscenario::{Imported, Part, Settings, read};
use wildcity_scene::geometry::Pose;
use wildcity_sim::scenario::{
    ActionSection, ActorSection, Document, EgoStart, NoAssets, ProfileSection, QuantitySection,
    Scenario, ScenarioFile, ShapeSection, Surroundings,
};
use wildcity_sim::traffic::{EgoMotion, EgoState, World};

/// A linear change within a time.
fn linear(to: f64, over_s: f64) -> ProfileSection {
    ProfileSection {
        to,
        shape: ShapeSection::Linear,
        over_s: Some(over_s),
        over_m: None,
        rate: None,
        acceleration: None,
    }
}

/// An ego, a car that cuts in, and a pedestrian that crosses: every element that is read.
pub(crate) const CUT_IN: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<OpenSCENARIO>
  <FileHeader revMajor="1" revMinor="2" date="2026-01-01T00:00:00" description="cut-in" author="wildcity"/>
  <ParameterDeclarations>
    <ParameterDeclaration name="EgoKmh" parameterType="double" value="36"/>
    <ParameterDeclaration name="Gap" parameterType="double" value="20"/>
  </ParameterDeclarations>
  <CatalogLocations/>
  <RoadNetwork/>
  <Entities>
    <ScenarioObject name="Ego">
      <Vehicle name="car" vehicleCategory="car">
        <BoundingBox><Center x="1.4" y="0.0" z="0.75"/><Dimensions length="5.0" width="2.0" height="1.5"/></BoundingBox>
      </Vehicle>
    </ScenarioObject>
    <ScenarioObject name="Cut In">
      <Vehicle name="van" vehicleCategory="van">
        <BoundingBox><Center x="1.5" y="0.0" z="1.0"/><Dimensions length="5.2" width="2.1" height="2.0"/></BoundingBox>
      </Vehicle>
    </ScenarioObject>
    <ScenarioObject name="Walker">
      <Pedestrian name="p" mass="80" pedestrianCategory="pedestrian">
        <BoundingBox><Center x="0.0" y="0.0" z="0.9"/><Dimensions length="0.6" width="0.6" height="1.8"/></BoundingBox>
      </Pedestrian>
    </ScenarioObject>
  </Entities>
  <Storyboard>
    <Init><Actions>
      <Private entityRef="Ego">
        <PrivateAction><TeleportAction><Position><WorldPosition x="0" y="0" z="0" h="0"/></Position></TeleportAction></PrivateAction>
        <PrivateAction><LongitudinalAction><SpeedAction>
          <SpeedActionDynamics dynamicsShape="step" value="0" dynamicsDimension="time"/>
          <SpeedActionTarget><AbsoluteTargetSpeed value="${$EgoKmh / 3.6}"/></SpeedActionTarget>
        </SpeedAction></LongitudinalAction></PrivateAction>
      </Private>
      <Private entityRef="Cut In">
        <PrivateAction><TeleportAction><Position>
          <RelativeObjectPosition entityRef="Ego" dx="$Gap" dy="3.5"/>
        </Position></TeleportAction></PrivateAction>
        <PrivateAction><LongitudinalAction><SpeedAction>
          <SpeedActionDynamics dynamicsShape="step" value="0" dynamicsDimension="time"/>
          <SpeedActionTarget><AbsoluteTargetSpeed value="8"/></SpeedActionTarget>
        </SpeedAction></LongitudinalAction></PrivateAction>
      </Private>
      <Private entityRef="Walker">
        <PrivateAction><TeleportAction><Position><WorldPosition x="60" y="-6" z="0" h="1.5708"/></Position></TeleportAction></PrivateAction>
      </Private>
    </Actions></Init>
    <Story name="story"><Act name="act">
      <ManeuverGroup name="g" maximumExecutionCount="1">
        <Actors selectTriggeringEntities="false"><EntityRef entityRef="Cut In"/></Actors>
        <Maneuver name="m">
          <Event name="Swerve" priority="override">
            <Action name="a"><PrivateAction><RoutingAction><FollowTrajectoryAction>
              <Trajectory name="t" closed="false"><ParameterDeclarations/><Shape><Polyline>
                <Vertex time="0"><Position><WorldPosition x="20" y="3.5" z="0"/></Position></Vertex>
                <Vertex time="0"><Position><WorldPosition x="45" y="0" z="0"/></Position></Vertex>
                <Vertex time="0"><Position><WorldPosition x="300" y="0" z="0"/></Position></Vertex>
              </Polyline></Shape></Trajectory>
              <TimeReference><None/></TimeReference>
              <TrajectoryFollowingMode followingMode="position"/>
            </FollowTrajectoryAction></RoutingAction></PrivateAction></Action>
            <StartTrigger><ConditionGroup><Condition name="c" delay="0" conditionEdge="rising">
              <ByEntityCondition>
                <TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="Ego"/></TriggeringEntities>
                <EntityCondition><RelativeDistanceCondition entityRef="Cut In" relativeDistanceType="cartesianDistance"
                  value="15" freespace="false" rule="lessThan"/></EntityCondition>
              </ByEntityCondition></Condition></ConditionGroup></StartTrigger>
          </Event>
          <Event name="Brake" priority="override">
            <Action name="b"><PrivateAction><LongitudinalAction><SpeedAction>
              <SpeedActionDynamics dynamicsShape="linear" value="2" dynamicsDimension="time"/>
              <SpeedActionTarget><AbsoluteTargetSpeed value="2"/></SpeedActionTarget>
            </SpeedAction></LongitudinalAction></PrivateAction></Action>
            <StartTrigger><ConditionGroup><Condition name="c" delay="1.5" conditionEdge="none">
              <ByValueCondition><StoryboardElementStateCondition storyboardElementType="event"
                storyboardElementRef="Swerve" state="startTransition"/></ByValueCondition>
            </Condition></ConditionGroup></StartTrigger>
          </Event>
        </Maneuver>
      </ManeuverGroup>
      <ManeuverGroup name="w" maximumExecutionCount="1">
        <Actors selectTriggeringEntities="false"><EntityRef entityRef="Walker"/></Actors>
        <Maneuver name="m2">
          <Event name="Walk" priority="parallel">
            <Action name="go"><PrivateAction><LongitudinalAction><SpeedAction>
              <SpeedActionDynamics dynamicsShape="linear" value="1.5" dynamicsDimension="rate"/>
              <SpeedActionTarget><AbsoluteTargetSpeed value="1.34"/></SpeedActionTarget>
            </SpeedAction></LongitudinalAction></PrivateAction></Action>
            <StartTrigger><ConditionGroup><Condition name="t" delay="0" conditionEdge="rising">
              <ByValueCondition><SimulationTimeCondition value="2" rule="greaterThan"/></ByValueCondition>
            </Condition></ConditionGroup></StartTrigger>
          </Event>
          <Event name="Leave" priority="parallel">
            <Action name="gone"><GlobalAction><EntityAction entityRef="Walker"><DeleteEntityAction/></EntityAction></GlobalAction></Action>
            <StartTrigger><ConditionGroup><Condition name="t" delay="0" conditionEdge="rising">
              <ByEntityCondition>
                <TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="Walker"/></TriggeringEntities>
                <EntityCondition><TraveledDistanceCondition value="12"/></EntityCondition>
              </ByEntityCondition></Condition></ConditionGroup></StartTrigger>
          </Event>
        </Maneuver>
      </ManeuverGroup>
      <StartTrigger><ConditionGroup><Condition name="s" delay="0" conditionEdge="none">
        <ByValueCondition><SimulationTimeCondition value="0" rule="greaterOrEqual"/></ByValueCondition>
      </Condition></ConditionGroup></StartTrigger>
    </Act></Story>
    <StopTrigger><ConditionGroup><Condition name="end" delay="0" conditionEdge="none">
      <ByValueCondition><SimulationTimeCondition value="20" rule="greaterThan"/></ByValueCondition>
    </Condition></ConditionGroup></StopTrigger>
  </Storyboard>
</OpenSCENARIO>
"#;

pub(crate) fn settings() -> Settings {
    Settings {
        name: "cut-in".into(),
        twin: "street".into(),
        ego: "Ego".into(),
        ..Settings::default()
    }
}

pub(crate) fn resolved(file: ScenarioFile) -> Scenario {
    let around = Surroundings { drives: &[], tracks: None, map: None, assets: &NoAssets };
    Scenario::resolve(file, 1, &around).unwrap()
}

#[test]
fn a_scenario_is_read_and_runs() {
    let Imported { file, notes } = read(CUT_IN.as_bytes(), &settings()).unwrap();
    assert!(notes.len() == 1 && notes[0].contains("stays on the line"), "{notes:?}");
    assert_eq!(file.ego.dynamics.unwrap().speed, 10.0);
    assert_eq!(file.end.time_s, Some(20.0));
    let van = file.actors.iter().find(|actor| actor.name == "cut-in").unwrap();
    let near = van.script[0].when.measure.as_ref().unwrap();
    assert_eq!((near.quantity, near.below), (QuantitySection::Distance, Some(15.0)));
    // From the box's middle back to the reference point.
    assert_eq!((near.ahead_m, near.to_ahead_m), (Some(-1.4), Some(-1.5)));
    assert_eq!(van.script[1].when.after.as_deref(), Some("cut-in/swerve"));
    // From 8 to 2 m/s in 2 s. By its priority, it ends the event before it.
    let halt = ActionSection::Halt { trigger: "swerve".into() };
    assert_eq!(van.script[1].then, [halt, ActionSection::SpeedProfile(linear(2.0, 2.0))]);
    // It is written as our JSON, and read again.
    let text = serde_json::to_vec_pretty(&file).unwrap();
    let again = Document::parse(&text).unwrap().with(&Default::default()).unwrap();
    assert_eq!(again, file);
    let scenario = resolved(file);
    assert!(matches!(scenario.start, Some(EgoStart::Pose(_))));
    assert_eq!(scenario.traffic.actors.len(), 2);
}

#[test]
fn what_is_not_read_is_refused_by_name_and_line() {
    let refused = |from: &str, to: &str| {
        assert!(CUT_IN.contains(from), "{from}");
        let text = CUT_IN.replacen(from, to, 1);
        read(text.as_bytes(), &settings()).unwrap_err().to_string()
    };
    for (from, to, expected) in [
        ("revMinor=\"2\"", "revMinor=\"4\"", "line 3, <FileHeader>"),
        (
            "<WorldPosition x=\"60\"",
            "<LanePosition roadId=\"1\" laneId=\"-1\" s=\"60\"",
            "line 46, <LanePosition>",
        ),
        ("$Gap", "$Gab", "\"Gab\""),
        ("${$EgoKmh / 3.6}", "${log($EgoKmh)}", "line 33, <AbsoluteTargetSpeed>"),
        ("dynamicsShape=\"linear\"", "dynamicsShape=\"quintic\"", "line 72, <SpeedActionDynamics>"),
        (
            "<TraveledDistanceCondition value=\"12\"/>",
            "<CollisionCondition/>",
            "<CollisionCondition>",
        ),
        ("triggeringEntitiesRule=\"any\"", "triggeringEntitiesRule=\"none\"", "any or all"),
        ("priority=\"parallel\"", "priority=\"skip\"", "<Event>"),
        ("priority=\"parallel\"", "priority=\"first\"", "<Event>"),
        // Attributes too.
        ("<None/>", "<None scale=\"2\"/>", "scale=\"2\" is not read"),
        ("delay=\"0\"", "delay=\"-1\"", "delay=-1"),
        ("maximumExecutionCount=\"1\"", "maximumExecutionCount=\"3\"", "<ManeuverGroup>"),
        ("entityRef=\"Walker\"", "entityRef=\"Other\"", "\"Other\""),
        ("value=\"20\" rule", "value=\"NaN\" rule", "finite"),
        (
            "<None/>",
            "<Timing domainAbsoluteRelative=\"relative\" scale=\"2\" offset=\"0\"/>",
            "<Timing>",
        ),
    ] {
        let error = refused(from, to);
        assert!(error.contains(expected), "{from}: {error}");
    }
    let other = Settings { ego: "Hero".into(), ..settings() };
    assert!(read(CUT_IN.as_bytes(), &other).unwrap_err().message.contains("--ego"));
}

#[test]
fn deep_nesting_and_entities_are_refused() {
    let deep = "<a>".repeat(200_000);
    assert!(read(deep.as_bytes(), &settings()).is_err());
    let bomb = "<!DOCTYPE a [<!ENTITY b \"bbbb\">]><OpenSCENARIO>&b;</OpenSCENARIO>";
    assert!(read(bomb.as_bytes(), &settings()).is_err());
}

/// Reads a file of the small inputs beside its catalogs.
fn imported(name: &str) -> Option<ScenarioFile> {
    let path = crate::data::real(&format!("cases/{name}"))?;
    let settings = Settings {
        directory: path.parent().map(std::path::Path::to_owned),
        ego: "Ego".into(),
        ..settings()
    };
    Some(read(&std::fs::read(&path).unwrap(), &settings).unwrap().file)
}

fn actor<'f>(file: &'f ScenarioFile, name: &str) -> &'f ActorSection {
    file.actors.iter().find(|actor| actor.name == name).unwrap()
}

/// The ways of the actors of a scenario after these seconds, while the ego stands.
fn ways_m<const N: usize>(file: &ScenarioFile, name: &str, seconds: [f64; N]) -> [f64; N] {
    let scenario = resolved(file.clone());
    let index = file.actors.iter().position(|actor| actor.name == name).unwrap();
    let mut world = World::new(scenario.traffic.clone());
    let ego = EgoMotion::standing(EgoState {
        world_from_rig: Pose::IDENTITY,
        velocity_mps: DVec3::ZERO,
        yaw_rate_radps: 0.0,
    });
    let start_m = world.states()[index].world_from_actor.position_m;
    let mut time_us = 0;
    seconds.map(|second| {
        let next_us = (second * 1e6) as i64;
        if next_us > time_us {
            world.step(next_us - time_us, &ego, &mut |_| {});
        }
        time_us = next_us;
        world.states()[index].world_from_actor.position_m.distance(start_m)
    })
}

#[test]
fn entries_of_catalogs_have_their_boxes() {
    let Some(file) = imported("osc_catalog/catalog/scenario.xosc") else { return };
    assert_eq!(actor(&file, "lead").size, Some([4.5, 1.8, 1.5]));
    let [unused, plain] = ["o_catalog_unused", "o_plain"]
        .map(|name| imported(&format!("osc_catalog/{name}.xosc")).unwrap());
    assert_eq!(unused, plain);
    // Without its directory, a reference is refused.
    let path = crate::data::real("cases/osc_catalog/catalog/scenario.xosc").unwrap();
    let error = read(&std::fs::read(path).unwrap(), &settings()).unwrap_err();
    assert!(error.place.ends_with("<Directory>"), "{error}");
}

#[test]
fn parameters_use_earlier_ones() {
    for (name, speed) in [("o_chain", 10.0), ("o_chain2", 36.0), ("o_dollar", 10.0)] {
        let Some(file) = imported(&format!("osc_parameters/{name}.xosc")) else { return };
        assert_eq!(actor(&file, "lead").path.as_ref().unwrap().speed, speed, "{name}");
    }
    let path = crate::data::real("cases/osc_parameters/o_chain.xosc").unwrap();
    let bytes = std::fs::read(path).unwrap();
    let given = |name: &str| Settings {
        parameters: [(name.to_owned(), "72".to_owned())].into(),
        ..settings()
    };
    let file = read(&bytes, &given("kmh")).unwrap().file;
    assert_eq!(actor(&file, "lead").path.as_ref().unwrap().speed, 20.0, "another value");
    assert!(read(&bytes, &given("mph")).unwrap_err().message.contains("mph"));
}

#[test]
fn ramps_of_init_and_delays_of_the_stop_trigger_count() {
    let Some(file) = imported("osc_silently_other/o_initramp.xosc") else { return };
    assert_eq!(actor(&file, "lead").path.as_ref().unwrap().speed, 0.0);
    let [at_5_m, at_6_m] = ways_m(&file, "lead", [5.0, 6.0]);
    assert!((at_5_m - 25.0).abs() < 0.05 && (at_6_m - 35.0).abs() < 0.05, "{at_5_m} {at_6_m}");
    let file = imported("osc_silently_other/o_stopdelay.xosc").unwrap();
    assert_eq!(file.end.time_s, Some(15.0));
}

/// A straight road of 300 m with two lanes for each direction.
const ROADS: &str = r#"<OpenDRIVE><header revMajor="1" revMinor="6"/>
<road name="a" length="300" id="1" junction="-1"><link/>
<planView><geometry s="0" x="0" y="0" hdg="0" length="300"><line/></geometry></planView>
<lanes><laneSection s="0">
<left><lane id="2" type="driving" level="false"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane>
<lane id="1" type="driving" level="false"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></left>
<center><lane id="0" type="none" level="false"/></center>
<right><lane id="-1" type="driving" level="false"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane>
<lane id="-2" type="driving" level="false"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes></road></OpenDRIVE>"#;

/// Reads a file on the roads.
pub(crate) fn on_roads(text: &str, leave_out: &[Part]) -> Result<Imported, String> {
    let dir = tempfile::tempdir().unwrap();
    let roads = dir.path().join("roads.xodr");
    std::fs::write(&roads, ROADS).unwrap();
    let settings = Settings {
        roads: Some(roads),
        leave_out: leave_out.iter().copied().collect(),
        ..settings()
    };
    read(text.as_bytes(), &settings).map_err(|error| error.to_string())
}

#[test]
fn positions_in_the_world_move_with_the_roads() {
    let dir = tempfile::tempdir().unwrap();
    let roads = dir.path().join("roads.xodr");
    std::fs::write(&roads, ROADS).unwrap();
    for roads in [Some(roads), None] {
        let start = |origin: Option<[f64; 2]>| {
            let settings = Settings { roads: roads.clone(), origin, ..settings() };
            read(CUT_IN.as_bytes(), &settings).unwrap().file.ego.start.unwrap().pose.unwrap().xyz
        };
        let [x, y, z] = start(None);
        assert_eq!(start(Some([30.0, -20.0])), [x - 30.0, y + 20.0, z]);
    }
}

#[test]
fn the_shift_of_a_header_is_told_and_applied() {
    let header = "<header revMajor=\"1\" revMinor=\"6\"/>";
    let offset = "<header revMajor=\"1\" revMinor=\"6\">\
                  <offset x=\"-690000\" y=\"-5330000\" z=\"0\" hdg=\"0\"/></header>";
    let far = ROADS.replacen(header, offset, 1).replacen(
        "x=\"0\" y=\"0\"",
        "x=\"690000\" y=\"5330000\"",
        1,
    );
    assert!(far.contains("690000\" y"), "{far}");
    let dir = tempfile::tempdir().unwrap();
    let roads = dir.path().join("roads.xodr");
    std::fs::write(&roads, &far).unwrap();
    let text =
        CUT_IN.replacen(EGO_AT, "<WorldPosition x=\"690005\" y=\"5330000\" z=\"0\" h=\"0\"/>", 1);
    let settings = Settings { roads: Some(roads), ..settings() };
    let imported = read(text.as_bytes(), &settings).unwrap();
    let [x, y, _] = imported.file.ego.start.unwrap().pose.unwrap().xyz;
    assert!((x - 5.0).abs() < 3.0 && y.abs() < 1e-6, "{x} {y}");
    assert!(imported.notes.iter().any(|note| note.contains("<offset>")), "{:?}", imported.notes);
}

const EGO_AT: &str = "<WorldPosition x=\"0\" y=\"0\" z=\"0\" h=\"0\"/>";

#[test]
fn places_on_lanes_have_their_points_and_headings() {
    let place = |position: &str| {
        let file = on_roads(&CUT_IN.replacen(EGO_AT, position, 1), &[])?.file;
        let pose = file.ego.start.unwrap().pose.unwrap();
        Ok::<_, String>((pose.xyz, pose.yaw_rad.unwrap()))
    };
    let near = |position: &str, xyz: [f64; 3], yaw_rad: f64| {
        let (found, heading) = place(position).unwrap();
        let is_near = found.iter().zip(xyz).all(|(found, wanted)| (found - wanted).abs() < 1e-3);
        let turned = (heading - yaw_rad).sin();
        assert!(is_near && turned.abs() < 1e-6, "{position}: {found:?} {heading}");
    };
    let pi = std::f64::consts::PI;
    near(
        "<LanePosition roadId=\"1\" laneId=\"-2\" s=\"20\" offset=\"0.5\"/>",
        [20.0, -4.0, 0.0],
        0.0,
    );
    // Oncoming traffic faces the other way.
    near("<LanePosition roadId=\"1\" laneId=\"1\" s=\"20\"/>", [20.0, 1.5, 0.0], pi);
    near(
        "<LanePosition roadId=\"1\" laneId=\"1\" s=\"20\"><Orientation type=\"absolute\" h=\"0.3\"/></LanePosition>",
        [20.0, 1.5, 0.0],
        0.3,
    );
    // In a file of 1.2, a heading without a type is absolute.
    near(
        "<LanePosition roadId=\"1\" laneId=\"1\" s=\"20\"><Orientation h=\"0.3\"/></LanePosition>",
        [20.0, 1.5, 0.0],
        0.3,
    );
    near("<RoadPosition roadId=\"1\" s=\"20\" t=\"-2\"/>", [20.0, -2.0, 0.0], 0.0);
    for (wrong, expected) in [
        ("<LanePosition roadId=\"7\" laneId=\"-1\" s=\"20\"/>", "no road \"7\""),
        ("<LanePosition roadId=\"1\" laneId=\"-3\" s=\"20\"/>", "no lane -3"),
        ("<LanePosition roadId=\"1\" laneId=\"-1\" s=\"301\"/>", "300"),
    ] {
        let error = place(wrong).unwrap_err();
        assert!(error.contains(expected), "{error}");
    }
}

/// A car on lane -2 of the roads that changes to another lane within 4 s, from time 2 on.
pub(crate) const LANES: &str = r#"<OpenSCENARIO>
<FileHeader revMajor="1" revMinor="3" date="" description="" author=""/>
<CatalogLocations/><RoadNetwork/>
<Entities>
 <ScenarioObject name="Ego"><Vehicle name="car" vehicleCategory="car"><BoundingBox><Center x="1.4" y="0" z="0.75"/>
  <Dimensions width="2" length="5" height="1.5"/></BoundingBox></Vehicle></ScenarioObject>
 <ScenarioObject name="Van"><Vehicle name="van" vehicleCategory="van"><BoundingBox><Center x="1.4" y="0" z="0.75"/>
  <Dimensions width="2" length="5" height="1.5"/></BoundingBox></Vehicle></ScenarioObject>
</Entities>
<Storyboard><Init><Actions>
 <Private entityRef="Ego"><PrivateAction><TeleportAction><Position>
  <LanePosition roadId="1" laneId="-1" s="0"/></Position></TeleportAction></PrivateAction></Private>
 <Private entityRef="Van"><PrivateAction><TeleportAction><Position>
  <RelativeLanePosition entityRef="Ego" dLane="-1" ds="20"/></Position></TeleportAction></PrivateAction>
  <PrivateAction><LongitudinalAction><SpeedAction>
   <SpeedActionDynamics dynamicsShape="step" dynamicsDimension="time" value="0"/>
   <SpeedActionTarget><AbsoluteTargetSpeed value="10"/></SpeedActionTarget></SpeedAction></LongitudinalAction></PrivateAction>
 </Private></Actions></Init>
<Story name="s"><Act name="act"><ManeuverGroup name="g" maximumExecutionCount="1">
 <Actors selectTriggeringEntities="false"><EntityRef entityRef="Van"/></Actors><Maneuver name="m">
  <Event name="change" priority="override"><Action name="c"><PrivateAction><LateralAction><LaneChangeAction>
   <LaneChangeActionDynamics dynamicsShape="sinusoidal" value="4" dynamicsDimension="time"/>
   <LaneChangeTarget><RelativeTargetLane entityRef="Van" value="1"/></LaneChangeTarget>
   </LaneChangeAction></LateralAction></PrivateAction></Action>
   <StartTrigger><ConditionGroup><Condition name="t" delay="0" conditionEdge="rising"><ByValueCondition>
    <SimulationTimeCondition value="2" rule="greaterThan"/></ByValueCondition></Condition></ConditionGroup></StartTrigger>
  </Event>
  <Event name="brake" priority="parallel"><Action name="b"><PrivateAction><LongitudinalAction><SpeedAction>
   <SpeedActionDynamics dynamicsShape="linear" dynamicsDimension="rate" value="5"/>
   <SpeedActionTarget><AbsoluteTargetSpeed value="0"/></SpeedActionTarget></SpeedAction></LongitudinalAction></PrivateAction></Action>
   <StartTrigger><ConditionGroup><Condition name="t" delay="1" conditionEdge="none"><ByValueCondition>
    <StoryboardElementStateCondition storyboardElementType="event" storyboardElementRef="change" state="endTransition"/>
    </ByValueCondition></Condition></ConditionGroup></StartTrigger>
  </Event></Maneuver></ManeuverGroup></Act></Story>
<StopTrigger/></Storyboard></OpenSCENARIO>"#;

/// The position of the only actor after these seconds, while the ego stands at the origin.
fn positions(text: &str, seconds: &[f64]) -> Result<Vec<DVec3>, String> {
    let file = on_roads(text, &[]).map(|imported| imported.file)?;
    let mut world = World::new(resolved(file).traffic.clone());
    let ego = EgoMotion::standing(EgoState {
        world_from_rig: Pose::IDENTITY,
        velocity_mps: DVec3::ZERO,
        yaw_rate_radps: 0.0,
    });
    let mut positions = Vec::new();
    for second in seconds {
        let way_us = (second * 1e6) as i64 - world.time_us();
        world.step(way_us.max(1), &ego, &mut |_| {});
        positions.push(world.states()[0].world_from_actor.position_m);
    }
    Ok(positions)
}

#[test]
fn a_change_of_lane_takes_its_time_and_others_wait_for_its_end() {
    let at = positions(LANES, &[2.0, 4.0, 6.1, 7.0, 12.0]).unwrap();
    // The middle of the box is 1.4 m ahead of the place.
    assert!((at[0] - DVec3::new(41.4, -4.5, 0.0)).length() < 0.05, "{}", at[0]);
    // Half of the way after half of the time, and then the other lane.
    assert!((at[1].y + 3.0).abs() < 0.05, "{}", at[1]);
    assert!((at[2].y + 1.5).abs() < 1e-6, "{}", at[2]);
    // 1 s after the end it brakes within 2 s, 10 m.
    assert!((at[3].x - 91.4).abs() < 0.3 && (at[4].x - at[3].x - 10.0).abs() < 0.4, "{at:?}");
}

#[test]
fn an_edge_needs_a_value_before_it() {
    let near = "<ByEntityCondition><TriggeringEntities triggeringEntitiesRule=\"any\"><EntityRef \
                entityRef=\"Ego\"/></TriggeringEntities><EntityCondition><RelativeDistanceCondition \
                entityRef=\"Van\" relativeDistanceType=\"longitudinal\" value=\"30\" freespace=\"false\" \
                rule=\"RULE\"/></EntityCondition></ByEntityCondition>";
    let from = LANES.find("<ByValueCondition>").unwrap();
    let to =
        from + LANES[from..].find("</ByValueCondition>").unwrap() + "</ByValueCondition>".len();
    let with = |rule: &str| {
        let condition = near.replace("RULE", rule);
        positions(&format!("{}{condition}{}", &LANES[..from], &LANES[to..]), &[10.0]).unwrap()[0]
    };
    // The van starts 20 m ahead and is 30 m ahead after 1 s.
    assert!((with("greaterThan").y + 1.5).abs() < 1e-6);
    // It is nearer than 30 m from the start on: that is no edge.
    assert!((with("lessThan").y + 4.5).abs() < 1e-6);
}

#[test]
fn a_priority_ends_what_its_maneuver_does() {
    let brake = LANES.replace("priority=\"parallel\"", "priority=\"override\"");
    let brake =
        brake.replace("delay=\"1\"", "delay=\"2\"").replace("endTransition", "startTransition");
    let at = positions(&brake, &[4.1, 9.0]).unwrap();
    assert!((at[1].y + 3.0).abs() < 0.05, "half of the way: {at:?}");
    let skipped = LANES.replace("priority=\"parallel\"", "priority=\"skip\"");
    assert!(on_roads(&skipped, &[]).unwrap_err().contains("<Event>"));
}

#[test]
fn speeds_follow_those_of_others() {
    let speed = "<RelativeTargetSpeed entityRef=\"Ego\" value=\"3\" speedTargetValueType=\"delta\" continuous=\"true\"/>";
    let text = LANES.replace("<AbsoluteTargetSpeed value=\"10\"/>", speed);
    let at = positions(&text, &[1.0]).unwrap();
    assert!((at[0].x - 24.4).abs() < 0.05, "{at:?}");
    let never = text.replace("entityRef=\"Ego\" value=\"3\"", "entityRef=\"Van\" value=\"3\"");
    assert!(on_roads(&never, &[]).is_err());
}

#[test]
fn parts_are_left_out_on_request_only_and_told() {
    let controller = "<PrivateAction><ControllerAction><AssignControllerAction><Controller \
                      name=\"c\"/></AssignControllerAction></ControllerAction></PrivateAction></Private></Actions>";
    let text = LANES.replace("</Private></Actions>", controller);
    let error = on_roads(&text, &[]).unwrap_err();
    assert!(
        error.contains("<ControllerAction>") && error.contains("--leave-out controllers"),
        "{error}"
    );
    let notes = on_roads(&text, &[Part::Controllers]).unwrap().notes;
    assert!(notes.len() == 1 && notes[0].contains("<ControllerAction>"), "{notes:?}");
    // The agent is the ego's controller, and without a controller there is nothing to activate.
    let activate = controller.replace(
        "<AssignControllerAction><Controller name=\"c\"/></AssignControllerAction>",
        "<ActivateControllerAction lateral=\"true\" longitudinal=\"true\"/>",
    );
    let notes = on_roads(&LANES.replace("</Private></Actions>", &activate), &[]).unwrap().notes;
    assert!(notes.len() == 1 && notes[0].contains("\"Van\" has no controller"), "{notes:?}");
    let of_ego = controller.replace("</Private></Actions>", "");
    let text = LANES.replacen(
        "</Position></TeleportAction></PrivateAction></Private>",
        &format!("</Position></TeleportAction></PrivateAction>{of_ego}</Private>"),
        1,
    );
    let notes = on_roads(&text, &[]).unwrap().notes;
    assert!(notes.len() == 1 && notes[0].contains("agent is the ego's controller"), "{notes:?}");
    // What nothing knows is never left out.
    let text = LANES.replace("<StopTrigger/>", "<StopTrigger/><Extra/>");
    let all: Vec<Part> = Part::ALL.iter().map(|(part, _)| *part).collect();
    assert!(on_roads(&text, &all).unwrap_err().contains("<Extra>"));
}
