//! Limits and defaults of this package, with the arithmetic behind each.

/// Largest acceleration of an action, in m/s²: as in Alpamayo, about the grip of tyres on a dry
/// road.
pub const EGO_ACCELERATION_M_S2: f64 = 9.8;

/// Largest curvature of an action, in 1/m: as in Alpamayo, a turning circle of 10 m.
pub const EGO_CURVATURE_1_M: f64 = 0.2;

/// Largest angle of the front wheels, in radians: that of the largest curvature at very low speed,
/// 0.2 1/m times a wheelbase of 2.85 m. At speed the car understeers and reaches less curvature.
pub const EGO_STEERING_RAD: f64 = EGO_CURVATURE_1_M * 2.85;

/// Largest speed forwards, in m/s: 216 km/h.
pub const EGO_SPEED_M_S: f64 = 60.0;

/// Largest speed backwards, in m/s: 36 km/h. From 12.8 m/s on, an eigenvalue would coincide with
/// the rate of the steering's lag, and from 28.6 m/s on an understeering car is unstable backwards.
pub const EGO_REVERSE_M_S: f64 = 10.0;

/// Largest number of poses of a trajectory that an ego follows: 6.4 s at 10 Hz, as Alpamayo
/// outputs.
pub const PATH_POSES: usize = 64;

/// Latest time of such a trajectory, in microseconds: one minute.
pub const PATH_US: i64 = 60_000_000;

/// Period at which the tracker of a trajectory updates its action, in microseconds: a tenth of the
/// steering's lag.
pub const TRACKER_TICK_US: u64 = 10_000;

/// Distance up to which a recorded drive defines the ground, in metres: the width of a street with
/// its pavements.
pub const GROUND_NEAR_M: f64 = 25.0;

/// Smallest z component of a ground plane's unit normal: a slope of 45 degrees, steeper than any
/// street.
pub const GROUND_UP: f64 = std::f64::consts::FRAC_1_SQRT_2;

/// Smallest length of a unit vector's part along the ground that gives a heading. Rounding leaves
/// about 1e-16 of a vector along the normal.
pub const GROUND_HEADING: f64 = 1e-9;

/// Longest sub-step of traffic, in microseconds.
pub const SUB_STEP_US: i64 = 10_000;

/// Most actors of a scenario.
pub const ACTORS: usize = 256;

/// Most triggers of one actor.
pub const TRIGGERS: usize = 64;

/// Most points of a course that a scenario lists.
pub const COURSE_POINTS: usize = 4096;

/// Most keyframes of all tracks of a file: 256 actors for 20 minutes at 10 Hz are three million.
pub const TRACK_KEYFRAMES: usize = 4 << 20;

/// Fastest actor, in m/s: as fast as the ego.
pub const ACTOR_SPEED_M_S: f64 = EGO_SPEED_M_S;

/// Largest acceleration or braking of an actor, in m/s²: beyond the grip of tyres on a dry road.
pub const ACTOR_ACCELERATION_M_S2: f64 = 20.0;

/// An IDM actor looks for a lead within this many of its desired gaps to a standing lead. A lead at
/// this distance changes its acceleration by at most 1/16 of the largest.
pub const LEAD_GAPS: f64 = 4.0;

/// Least and largest distance within which an IDM actor looks for a lead, in metres.
pub const LEAD_M: [f64; 2] = [20.0, 400.0];

/// Largest scenario file, in bytes: as large as a message on the wire. With the values of its sweep
/// in place it is no larger.
pub const SCENARIO_BYTES: usize = 1 << 20;

/// Most objects of a scenario with the values of its sweep: 256 actors with 64 triggers, each with
/// a condition and an action, are 49,408. An object takes up to a kilobyte once it has its types,
/// so that the smallest objects, of three bytes, would take 350 MB without this limit.
pub const SCENARIO_OBJECTS: usize = 1 << 16;

/// Largest tracks or map file, in bytes.
pub const MAP_BYTES: usize = 256 << 20;

/// Most names of a sweep: each is in every one of its combinations.
pub const SWEEP_NAMES: usize = 64;

/// Most combinations of a sweep.
pub const SWEEP_CASES: u64 = 100_000;

/// Longest episode that a scenario may ask for, in seconds: a day.
pub const END_S: f64 = 86_400.0;

/// Longest id of a lane, in bytes.
pub const LANE_ID_BYTES: usize = 256;

/// Most points of one line or outline of a map: 50 km at 0.5 m.
pub const LINE_POINTS: usize = 100_000;

/// Points of the route in an observation: AlpaSim's number.
pub const ROUTE_POINTS: u32 = 20;

/// How far behind and ahead of its previous place the ego is searched for on its route, in metres.
pub const ROUTE_SEARCH_M: [f64; 2] = [30.0, 100.0];

/// If the ego is farther than this from the searched part, it is searched for on the whole route,
/// in metres.
pub const ROUTE_LOST_M: f64 = 50.0;

/// A route is done if more than this share of it was driven and the ego is within [`ROUTE_END_M`]
/// of its end (HUGSIM).
pub const ROUTE_DONE: f64 = 0.99;
/// Largest distance of the ego from the end of a route that is done, in metres: see [`ROUTE_DONE`].
pub const ROUTE_END_M: f64 = 10.0;

/// Slower than this is stuck, in m/s (Bench2Drive).
pub const STUCK_M_S: f64 = 0.1;

/// Most commands of one route.
pub const COMMANDS: usize = 1000;

/// Longest text of a command, in bytes.
pub const COMMAND_BYTES: usize = 1000;

/// Most frames of 0.5 s by which a start is shifted.
pub const START_FRAMES: u32 = 100;

/// Most positions of a collision course.
pub const POSITIONS: usize = 4096;

/// Most actions of one trigger.
pub const ACTIONS: usize = 16;

/// Most conditions within the condition of one trigger, and their deepest nesting.
pub const CONDITIONS: usize = 64;
/// Deepest nesting of conditions: see [`CONDITIONS`].
pub const CONDITION_DEPTH: usize = 6;

/// Largest delay of a condition, in seconds: in sub-steps of 10 ms its values change at most 6000
/// times.
pub const LATER_S: f64 = 60.0;
