//! Drives a car from observation to observation: accelerates to 8 m/s along the lane's start
//! direction with a trajectory, then brakes to a standstill with actions.
//!
//! `cargo run --release -p wildcity-client --example follow -- ws://127.0.0.1:8080/v1/session TWIN`

#![allow(clippy::print_stdout, reason = "an example tells its reader what it does")]

use wildcity_client::{
    Action, Client, Dynamics, DynamicsChoice, DynamicsModel, Movement, Observation, Open, Pose,
    TimedPose,
};

const CRUISE_M_S: f64 = 8.0;
const BRAKE_M_S2: f64 = -3.0;
/// A step is 0.1 s by default. The trajectory reaches 1 s ahead.
const HORIZON_STEPS: u32 = 10;

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [url, twin] = &arguments[..] else {
        anyhow::bail!("usage: follow ws://HOST:PORT/v1/session TWIN");
    };

    let mut client = Client::connect(url, "follow").await?;
    let car = Dynamics { model: DynamicsModel::Dynamic, speed: 0.0, reverse: false };
    let open = Open { dynamics: Some(DynamicsChoice::Full(car)), ..Open::twin(twin) };
    let opened = client.open(open).await?;

    let mut observation = client.reset(1, None).await?;
    for _ in 0..50 {
        let plan = Movement::Trajectory(straight_ahead(&observation, opened.dt_us));
        observation = client.drive(plan, false).await?;
        report(&observation);
    }
    while speed_m_s(&observation) > 0.01 {
        let brake = Action { acceleration: BRAKE_M_S2, curvature: 0.0 };
        observation = client.drive(Movement::Action(brake), false).await?;
        report(&observation);
    }
    println!("{:?}", client.close().await?);
    Ok(())
}

/// Poses for the next second, in the rig's current frame: straight ahead, at a speed that
/// approaches [`CRUISE_M_S`] by 1 m/s².
fn straight_ahead(observation: &Observation, dt_us: i64) -> Vec<TimedPose> {
    let step_s = 1e-6 * dt_us as f64;
    let mut speed_m_s = speed_m_s(observation);
    let mut ahead_m = 0.0;
    (1..=HORIZON_STEPS)
        .map(|step| {
            speed_m_s = (speed_m_s + step_s).min(CRUISE_M_S);
            ahead_m += speed_m_s * step_s;
            let pose = Pose { xyz: [ahead_m, 0.0, 0.0], q: [1.0, 0.0, 0.0, 0.0] };
            TimedPose { time_us: dt_us * i64::from(step), pose }
        })
        .collect()
}

fn speed_m_s(observation: &Observation) -> f64 {
    let [x, y, z] = observation.metadata().ego.velocity;
    (x * x + y * y + z * z).sqrt()
}

fn report(observation: &Observation) {
    let metadata = observation.metadata();
    let speed = speed_m_s(observation);
    println!("step {}: {speed:.1} m/s at {:.1?} m", metadata.step, metadata.ego.pose.xyz);
}
