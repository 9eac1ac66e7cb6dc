//! The traffic of an episode: its reaction to a step of the ego, and the events that the agent
//! gets.

use std::sync::Arc;

use wildcity_scene::ActorClass;
use wildcity_scene::actor::PlacedChunk;
use wildcity_sim::Ego;
use wildcity_sim::contact::{Body, Contact, Detector, LanePosition};
use wildcity_sim::limits::SUB_STEP_US;
use wildcity_sim::map::Map;
use wildcity_sim::route::{NavigationRoute, RouteProgress, RouteView};
use wildcity_sim::scenario::{ContactRule, EndInput, EndReason, Stuck};
use wildcity_sim::traffic::{ActorSpec, ActorState, EgoBox, EgoMotion, EgoState, Firing, World};

use super::assets::{ActorAssets, FrameDetail, exposure_start_us};
use super::load::LoadedScenario;
use super::past::{ActorPast, poses};
use crate::blocking::Stop;
use crate::error::SessionError;
use crate::limits;

/// The traffic of an episode between two steps. A copy continues exactly as the original does.
#[derive(Clone, Debug)]
pub struct EpisodeTraffic {
    loaded: Arc<LoadedScenario>,
    specs: Arc<Vec<ActorSpec>>,
    world: World,
    detector: Detector,
    progress: Option<RouteProgress>,
    stuck: Stuck,
    events: Vec<Event>,
    ended: Option<EndReason>,
    assets: ActorAssets,
    /// The longest exposure of a camera, in microseconds.
    exposure_us: i64,
    /// How old the pictures may be that sensors show, in microseconds.
    reach_us: i64,
    /// States of the actors since the last observation, and before it for the longest exposure and
    /// the oldest pictures of sensors. Frames of past times are rendered from them.
    past: ActorPast,
}

/// Something that happened in the last step, or at the start.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// When, in microseconds since the episode's start.
    pub time_us: i64,
    /// Kind of the event.
    pub kind: EventKind,
}

/// Kind of an event.
#[derive(Clone, Debug, PartialEq)]
pub enum EventKind {
    /// The ego began to touch an actor.
    Contact(Contact),
    /// The ego began to meet the twin's solid Gaussians (`wildcity.static@1`).
    StaticContact {
        /// Their area, in m².
        area_m2: f64,
        /// The ego's speed, in m/s.
        impact_mps: f64,
    },
    /// A trigger of an actor's script fired.
    Trigger {
        /// Index of the actor.
        actor: u16,
        /// Index of the trigger within the actor's script.
        trigger: usize,
    },
    Appeared {
        actor: u16,
    },
    Left {
        actor: u16,
    },
    /// The ego left the area that the twin was trained on: the trust of its pose fell below
    /// [`limits::OFF_MODEL_TRUST`].
    OffModel {
        /// The trust of its pose.
        trust: f64,
    },
    /// A rule ended the episode.
    End(EndReason),
}

impl EpisodeTraffic {
    /// The traffic at the start of an episode. `exposure_us` is the longest exposure of a camera,
    /// in microseconds.
    pub(crate) fn at_start(
        loaded: Arc<LoadedScenario>,
        assets: ActorAssets,
        ego: &Ego,
        exposure_us: i64,
    ) -> Self {
        let traffic = &loaded.scenario.traffic;
        let specs: Arc<Vec<ActorSpec>> =
            Arc::new(traffic.actors.iter().map(|actor| actor.spec.clone()).collect());
        let world = World::new(traffic.clone());
        let state = EgoState::new(ego);
        let (detector, contacts) =
            Detector::at_start(traffic.ego_box, &specs, &state, world.states());
        let route = loaded.scenario.route.as_ref();
        let progress = route.map(|route| route.begin(&ego.world_from_rig()));
        let contact = |contact: Contact| Event {
            time_us: contact.time_us,
            kind: EventKind::Contact(contact),
        };
        let mut past = ActorPast::default();
        // The first state is that of the start, from which the first step is interpolated.
        past.push(world.time_us(), world.states());
        Self {
            specs,
            world,
            detector,
            progress,
            stuck: Stuck::default(),
            events: contacts.into_iter().map(contact).collect(),
            ended: None,
            assets,
            exposure_us,
            reach_us: 0,
            past,
            loaded,
        }
    }

    /// Bytes that a copy does not share with its original.
    pub(crate) fn copied_bytes(&self) -> usize {
        self.world.copied_bytes()
    }

    /// Sets how old the pictures of sensors may be, in microseconds.
    pub(crate) fn with_reach(self, reach_us: i64) -> Self {
        Self { reach_us, ..self }
    }

    /// Moves on by a step of `dt_us` in which the ego went from one state to another. `with_twin`
    /// has the contacts with the twin that began in the step.
    ///
    /// # Errors
    /// The step was stopped; this traffic is of no use then.
    fn advance(
        &mut self,
        [from, to]: [&Ego; 2],
        dt_us: i64,
        with_twin: &[Event],
        stop: &Stop,
    ) -> Result<(), SessionError> {
        let next = self;
        next.events.clear();
        let motion = EgoMotion::new(EgoState::new(from), to);
        let loaded = next.loaded.clone();
        let ego_box = loaded.scenario.traffic.ego_box;
        let map = loaded.map.as_ref();
        let specs = next.specs.clone();
        let detector = &mut next.detector;
        let mut contacts: Vec<Contact> = Vec::new();
        let mut presence: Vec<Event> = Vec::new();
        let done = next.world.step_while(dt_us, &motion, &mut |sub_step| {
            // By sub-step, because an actor may appear, be touched and leave within one step.
            let lanes = map.map(|map| lane_position(map, &sub_step.ego[1], &ego_box));
            contacts.extend(detector.advance(sub_step, &specs, lanes));
            for (before, after) in sub_step.before.iter().zip(sub_step.after) {
                let kind = match (before.present, after.present) {
                    (false, true) => EventKind::Appeared { actor: after.index },
                    (true, false) => EventKind::Left { actor: after.index },
                    _ => continue,
                };
                presence.push(Event { time_us: sub_step.end_us, kind });
            }
            // A sub-step of the largest scenario takes some milliseconds.
            stop.check()
        });
        if done.is_break() {
            return Err(SessionError::DeadlineExceeded);
        }

        // The events of the step, by time; at one time triggers first, since they cause the others.
        let fired = next.world.firings().iter().map(|Firing { time_us, actor, trigger }| {
            let kind = EventKind::Trigger { actor: *actor, trigger: *trigger };
            Event { time_us: *time_us, kind }
        });
        next.events.extend(fired);
        next.events.append(&mut presence);
        // Before the contacts become events.
        let has_contact = (next.twin_ends_episode() && !with_twin.is_empty())
            || contacts.iter().any(|contact| next.ends_episode(contact));
        next.events.extend_from_slice(with_twin);
        next.events.extend(
            contacts.into_iter().map(|contact| Event {
                time_us: contact.time_us,
                kind: EventKind::Contact(contact),
            }),
        );
        // The last of the past states is always that of now.
        next.past.push(next.world.time_us(), next.world.states());
        // After the events that it may be the consequence of.
        next.end(to, has_contact);
        settle(&mut next.events);
        Ok(())
    }

    /// The traffic after the steps of a plan, each of `dt_us`, in which the ego went through
    /// `egos`. `with_twin` has the contacts with the twin that began in each step. Its events are
    /// those of all steps.
    ///
    /// # Errors
    /// The steps were stopped.
    pub(crate) fn followed(
        &self,
        from: &Ego,
        egos: &[Ego],
        dt_us: i64,
        with_twin: &[Vec<Event>],
        stop: &Stop,
    ) -> Result<Self, SessionError> {
        // One copy for all steps, so that a step which fails later changes nothing.
        let mut next = self.clone();
        // Frames of this plan are at most as old as its beginning, their exposure and the reach of
        // sensors.
        next.past.drop_before(self.world.time_us() - self.exposure_us - self.reach_us);
        let mut from = from;
        let mut events = Vec::new();
        for (ego, with_twin) in egos.iter().zip(with_twin) {
            next.advance([from, ego], dt_us, with_twin, stop)?;
            // A step forgets the events of the one before it, so that they are collected here.
            events.append(&mut next.events);
            // The events of a thousand steps may be many, and only some of them are kept.
            if events.len() > 16 * limits::EVENTS {
                settle(&mut events);
            }
            from = ego;
        }
        settle(&mut events);
        Ok(Self { events, ..next })
    }

    /// The sub-steps of all actors in `duration_us`: a measure of the work that they are.
    pub(crate) fn work(&self, duration_us: i64) -> u64 {
        let actors = self.specs.len() as u64 + 1;
        let sub_steps = duration_us.max(0) as u64 / SUB_STEP_US.unsigned_abs() + 1;
        actors.saturating_mul(sub_steps)
    }

    /// Advances along the route, and ends the episode if a rule of the scenario applies. The first
    /// reason is kept, since a plan continues to its end.
    fn end(&mut self, ego: &Ego, has_contact: bool) {
        let world_from_rig = ego.world_from_rig();
        let route = self.loaded.scenario.route.clone();
        // Even after the end, since the rest of the plan is driven and observed.
        if let (Some(route), Some(progress)) = (&route, &mut self.progress) {
            *progress = route.after(progress, &world_from_rig);
        }
        let input = EndInput {
            time_us: self.world.time_us(),
            velocity_mps: ego.velocity_m_s(),
            off_route_m: self.progress.map(|progress| progress.off_m),
            is_route_done: route
                .zip(self.progress)
                .is_some_and(|(route, progress)| route.is_done(&progress, &world_from_rig)),
            has_contact,
            has_held: self.world.end_us().is_some(),
        };
        if self.ended.is_some() {
            return;
        }
        self.ended = self.loaded.scenario.end.ended(&input, &mut self.stuck);
        if let Some(reason) = self.ended {
            let event = Event { time_us: input.time_us, kind: EventKind::End(reason) };
            self.events.push(event);
        }
    }

    /// Whether the scenario's rule is about contact with the twin.
    fn twin_ends_episode(&self) -> bool {
        use ContactRule::{Any, AtFault, Static};
        matches!(self.loaded.scenario.end.contact, Some(Any | AtFault | Static))
    }

    /// Whether the scenario's rule is about such a contact. Boxes that overlapped from the start
    /// are not judged.
    fn ends_episode(&self, contact: &Contact) -> bool {
        let class = self.specs[usize::from(contact.actor)].class;
        let is_meant = match self.loaded.scenario.end.contact {
            Some(ContactRule::Any) => true,
            Some(ContactRule::AtFault) => contact.ego_at_fault,
            Some(ContactRule::Pedestrian) => class == ActorClass::Pedestrian,
            Some(ContactRule::Static) | None => false,
        };
        // An overlap at the start is no fault of the driving.
        is_meant && !contact.at_start
    }

    /// The scenario, with this episode's seed.
    pub fn loaded(&self) -> &Arc<LoadedScenario> {
        &self.loaded
    }

    /// Constant properties of the actors, by their index.
    pub fn specs(&self) -> &[ActorSpec] {
        &self.specs
    }

    /// The actors now, by their index.
    pub fn states(&self) -> &[ActorState] {
        self.world.states()
    }

    /// The actors at the end of each of the last `steps` steps, with its time in microseconds;
    /// those of the last request, or fewer.
    pub(crate) fn last_steps(&self, steps: usize) -> impl Iterator<Item = (i64, &[ActorState])> {
        self.past.last(steps)
    }

    /// The actors at a time of the warm-up, in microseconds, which is below 0.
    pub(crate) fn states_before(&self, time_us: i64) -> Vec<ActorState> {
        self.world.states_before(time_us)
    }

    /// The actors that a frame shows whose time is since the last observation or in the warm-up.
    pub(crate) fn placed(&self, taken_us: i64, frame: FrameDetail<'_>) -> Vec<PlacedChunk> {
        if self.assets.is_empty() {
            return Vec::new();
        }
        let poses_at = |time_us: i64| {
            // The past begins at 0; the traffic computes where the actors were before.
            if time_us < 0 {
                poses(&self.world.states_before(time_us))
            } else {
                self.past.poses_at(time_us)
            }
        };
        let before = |exposure_us| poses_at(exposure_start_us(taken_us, exposure_us));
        self.assets.placed(&poses_at(taken_us), &before, frame)
    }

    /// Adds an event to those of the last step.
    pub(crate) fn add_event(&mut self, event: Event) {
        self.events.push(event);
        settle(&mut self.events);
    }

    /// Events of the last step, by time; at most [`limits::EVENTS`].
    pub fn events(&self) -> &[Event] {
        &self.events
    }

    /// The name of a trigger; empty if it has none.
    pub fn trigger_name(&self, actor: u16, trigger: usize) -> &str {
        let names = self.loaded.scenario.trigger_names.get(usize::from(actor));
        names.and_then(|names| names.get(trigger)).map_or("", String::as_str)
    }

    /// The route in the frame of the ego, if there is one.
    pub fn route(&self, ego: &Ego) -> Option<RouteView> {
        let (route, progress) = self.route_progress()?;
        let speed_mps = ego.velocity_m_s().length();
        Some(route.view(&progress, &ego.world_from_rig(), speed_mps))
    }

    /// The route, and where the ego is on it.
    pub fn route_progress(&self) -> Option<(&NavigationRoute, RouteProgress)> {
        Some((self.loaded.scenario.route.as_deref()?, self.progress?))
    }

    /// Why a rule ended the episode, if one did.
    pub fn ended(&self) -> Option<EndReason> {
        self.ended
    }
}

/// Puts events in the order of their times, those of one time in the given order. Of more than
/// [`limits::EVENTS`], keeps those that end or judge an episode before those that only tell.
pub(crate) fn settle(events: &mut Vec<Event>) {
    let weight = |event: &Event| match event.kind {
        EventKind::End(_) | EventKind::OffModel { .. } => 0,
        EventKind::Contact(_) | EventKind::StaticContact { .. } => 1,
        EventKind::Trigger { .. } | EventKind::Appeared { .. } | EventKind::Left { .. } => 2,
    };
    // Chosen by weight first, and by time among those of one weight.
    if events.len() > limits::EVENTS {
        events.sort_by_key(|event| (weight(event), event.time_us));
        events.truncate(limits::EVENTS);
    }
    // A stable sort, and `false` before `true`: triggers, appearances and departures come before
    // the contacts and the end of the same time.
    events.sort_by_key(|event| (event.time_us, weight(event) < 2));
}

/// Where the corners of the ego lie in the lanes of a map.
fn lane_position(map: &Map, ego: &EgoState, ego_box: &EgoBox) -> LanePosition {
    let body = Body::new(&ego.world_from_rig, &ego_box.box_, ego_box.center_x_m);
    let corners_m = body.footprint.corners_m();
    let lanes = corners_m.map(|corner_m| map.lanes_at(corner_m).collect::<Vec<_>>());
    // A lane that has all four corners.
    let has_common = lanes[0].iter().any(|lane| lanes[1..].iter().all(|of| of.contains(lane)));
    // An ego in no lane at all is off the road, and not between lanes.
    let in_any = lanes.iter().any(|of| !of.is_empty());
    LanePosition {
        in_multiple_lanes: in_any && !has_common,
        off_drivable: corners_m.iter().any(|corner_m| !map.is_drivable(*corner_m)),
    }
}
