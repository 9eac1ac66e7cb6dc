//! The Intelligent Driver Model: acceleration from the own speed, the lead's speed and the gap.
//!
//! Treiber and Kesting, "Traffic Flow Dynamics" (2013), chapter 11:
//! `a (1 - (v / v0)^δ - (s* / s)²)` with `s* = s0 + max(0, v T + v Δv / (2 √(a b)))`, where Δv is
//! the closing speed and s the gap between bumpers. Simulators differ in parameters, in the bracket
//! `max(0, .)`, in the least gap and in the bounds of the result; each variant here is that of the
//! named program at the named commit.

/// Parameters of the model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Idm {
    /// Speed on a free road, in m/s; v0 of the formula.
    pub free_speed_mps: f64,
    /// Gap to a standing lead, in metres; s0 of the formula.
    pub least_gap_m: f64,
    /// Time between the lead's rear and the own front passing one place, in seconds; T of the
    /// formula.
    pub headway_s: f64,
    /// Largest acceleration, in m/s²; a of the formula.
    pub acceleration_mps2: f64,
    /// Comfortable braking, in m/s², above 0; b of the formula.
    pub braking_mps2: f64,
    /// Exponent of the free-road term; δ of the formula.
    pub exponent: f64,
    /// Whether a lead that pulls away adds nothing to the desired gap: the bracket `max(0, .)`.
    /// Without it, a fast lead that pulls away makes the desired gap negative, and its square
    /// brakes.
    pub bracket: bool,
    /// Smaller gaps count as this, in metres.
    pub gap_floor_m: f64,
    /// Whether the result is within [-b, a].
    pub clipped: bool,
}

impl Idm {
    /// The formula of the book with the parameters of nuPlan.
    pub const WILDCITY: Self = Self {
        free_speed_mps: 10.0,
        least_gap_m: 1.0,
        headway_s: 1.5,
        acceleration_mps2: 1.0,
        braking_mps2: 2.0,
        exponent: 4.0,
        bracket: true,
        gap_floor_m: 1.0,
        clipped: true,
    };

    /// nuPlan's agents (motional/nuplan-devkit@e924167, `idm_policy.py`).
    pub const NUPLAN: Self = Self { bracket: false, ..Self::WILDCITY };

    /// The planner PDM-Closed (autonomousvision/navsim@0a380a9, `batch_idm_policy.py`).
    pub const NAVSIM: Self = Self { exponent: 10.0, bracket: false, ..Self::WILDCITY };

    /// HUGSIM's agents (hyzhou404/HUGSIM@62c690d, `agent_controller.py`).
    pub const HUGSIM: Self = Self {
        free_speed_mps: 30.0,
        least_gap_m: 5.0,
        headway_s: 2.0,
        acceleration_mps2: 2.0,
        braking_mps2: 4.0,
        exponent: 4.0,
        bracket: true,
        gap_floor_m: 0.0,
        clipped: false,
    };

    /// Acceleration in m/s² at speed `speed_mps` behind a lead at `lead_mps`, both along the
    /// course, with `gap_m` between bumpers; an infinite gap is a free road.
    pub fn acceleration(&self, speed_mps: f64, lead_mps: f64, gap_m: f64) -> f64 {
        let desired_m = self.desired_gap_m(speed_mps, lead_mps);
        // A floor, because the term grows without bound as the gap goes to 0 or below.
        let gap_m = gap_m.max(self.gap_floor_m);
        let free = (speed_mps / self.free_speed_mps).powf(self.exponent);
        let near = (desired_m / gap_m) * (desired_m / gap_m);
        let acceleration = self.acceleration_mps2 * (1.0 - free - near);
        if self.clipped {
            return acceleration.clamp(-self.braking_mps2, self.acceleration_mps2);
        }
        acceleration
    }

    /// The desired gap s*, in metres.
    pub fn desired_gap_m(&self, speed_mps: f64, lead_mps: f64) -> f64 {
        let closing_mps = speed_mps - lead_mps;
        let scale_mps2 = (self.acceleration_mps2 * self.braking_mps2).sqrt();
        let moving_m = speed_mps * self.headway_s + speed_mps * closing_mps / (2.0 * scale_mps2);
        self.least_gap_m + if self.bracket { moving_m.max(0.0) } else { moving_m }
    }
}

/// Distance in metres and speed in m/s after `duration_s` of constant acceleration from a speed of
/// at least 0. An actor that brakes to 0 within that time stands from then on.
pub fn rolled(speed_mps: f64, acceleration_mps2: f64, duration_s: f64) -> [f64; 2] {
    let end_mps = speed_mps + acceleration_mps2 * duration_s;
    if end_mps < 0.0 {
        // v² / (2 |a|): the way to standstill. The acceleration is below 0 here.
        return [speed_mps * speed_mps / (-2.0 * acceleration_mps2), 0.0];
    }
    let way_m = speed_mps * duration_s + 0.5 * acceleration_mps2 * duration_s * duration_s;
    [way_m, end_mps]
}
