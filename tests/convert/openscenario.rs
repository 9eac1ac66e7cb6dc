//! OpenSCENARIO files.

use wildcity_convert::openscenario::{Settings, read};
use wildcity_sim::scenario::{
    ActionSection, Document, EgoStart, ProfileSection, QuantitySection, Scenario, ScenarioFile,
    ShapeSection, Surroundings,
};

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
          <Event name="Walk" priority="skip">
            <Action name="go"><PrivateAction><LongitudinalAction><SpeedAction>
              <SpeedActionDynamics dynamicsShape="linear" value="1.5" dynamicsDimension="rate"/>
              <SpeedActionTarget><AbsoluteTargetSpeed value="1.34"/></SpeedActionTarget>
            </SpeedAction></LongitudinalAction></PrivateAction></Action>
            <StartTrigger><ConditionGroup><Condition name="t" delay="0" conditionEdge="rising">
              <ByValueCondition><SimulationTimeCondition value="2" rule="greaterThan"/></ByValueCondition>
            </Condition></ConditionGroup></StartTrigger>
          </Event>
          <Event name="Leave" priority="skip">
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

fn resolved(file: ScenarioFile) -> Scenario {
    let nothing = |_: &str| Err("there is none".to_owned());
    let around = Surroundings { drives: &[], tracks: None, map: None, asset: &nothing };
    Scenario::resolve(file, 1, &around).unwrap()
}

#[test]
fn a_scenario_is_read_and_runs() {
    let file = read(CUT_IN.as_bytes(), &settings()).unwrap().file;
    assert_eq!(file.ego.dynamics.unwrap().speed, 10.0);
    assert_eq!(file.end.time_s, Some(20.0));
    let van = file.actors.iter().find(|actor| actor.name == "cut-in").unwrap();
    let near = van.script[0].when.measure.as_ref().unwrap();
    assert_eq!((near.quantity, near.below), (QuantitySection::Distance, Some(15.0)));
    // From the box's middle back to the reference point.
    assert_eq!((near.ahead_m, near.to_ahead_m), (Some(-1.4), Some(-1.3)));
    assert_eq!(van.script[1].when.after.as_deref(), Some("cut-in/swerve"));
    // From 8 to 2 m/s in 2 s.
    assert_eq!(van.script[1].then, [ActionSection::SpeedProfile(linear(2.0, 2.0))]);
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
        (
            "<CatalogLocations/>",
            "<CatalogLocations><VehicleCatalog/></CatalogLocations>",
            "line 8, <VehicleCatalog>",
        ),
        ("revMinor=\"2\"", "revMinor=\"4\"", "line 3, <FileHeader>"),
        (
            "<WorldPosition x=\"60\"",
            "<LanePosition roadId=\"1\" laneId=\"-1\" s=\"60\"",
            "line 46, <LanePosition>",
        ),
        ("$Gap", "$Gab", "\"Gab\""),
        ("${$EgoKmh / 3.6}", "${pow($EgoKmh, 2)}", "line 33, <AbsoluteTargetSpeed>"),
        (
            "dynamicsShape=\"linear\"",
            "dynamicsShape=\"sinusoidal\"",
            "line 72, <SpeedActionDynamics>",
        ),
        (
            "<TraveledDistanceCondition value=\"12\"/>",
            "<CollisionCondition/>",
            "<CollisionCondition>",
        ),
        ("priority=\"skip\"", "priority=\"parallel\"", "<Event>"),
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
