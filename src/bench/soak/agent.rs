//! The agents of a soak: each drives rounds, and compares their images.

use std::collections::BTreeMap;
use std::time::Instant;

use serde_json::json;

use wildcity_client::protocol::message::{Rig, RigChoice};
use wildcity_client::{Client, Open, Pose};
use wildcity_scene::Trajectory;

/// Speed of the agents, in m/s.
const SPEED_M_PER_S: f64 = 10.0;

/// Counts of one session.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Driven {
    pub(super) steps: u64,
    pub(super) rounds: u64,
}

pub(super) struct Agent {
    pub(super) url: String,
    pub(super) twin: String,
    pub(super) version: u64,
    pub(super) route: Trajectory,
    pub(super) number: u32,
    /// Steps of a round.
    pub(super) steps: u32,
    pub(super) until: Instant,
}

impl Agent {
    /// Drives rounds until the time is over. A round has a connection and a session of its own.
    ///
    /// # Errors
    /// A request fails, or an image differs from that of the first round.
    pub(super) async fn drive(self) -> anyhow::Result<Driven> {
        let mut first = BTreeMap::new();
        let mut driven = Driven::default();
        while Instant::now() < self.until {
            let mut client = Client::connect(&self.url, "wildcity-bench soak").await?;
            let rig = Some(RigChoice::Full(rig()?));
            let version = Some(self.version);
            client.open(Open { rig, version, ..Open::twin(&self.twin) }).await?;
            for step in 0..=self.steps {
                // A round may take longer than the rest of the time.
                if Instant::now() >= self.until {
                    break;
                }
                let seen = match step {
                    0 => client.reset(0, None).await?,
                    _ => client.step(self.pose(step)).await?,
                };
                seen.verify()?;
                let hash = seen.metadata().frame_hash.clone();
                // The same step of every round shows the same pose of the same version: images must
                // be equal to the bit, whatever is pushed meanwhile.
                let known = first.entry(step).or_insert_with(|| hash.clone());
                anyhow::ensure!(
                    *known == hash,
                    "session {}, round {}, step {step}: the images have hash {hash}, and had {known} before",
                    self.number,
                    driven.rounds + 1,
                );
                driven.steps += u64::from(step > 0);
            }
            client.close().await?;
            driven.rounds += 1;
        }
        Ok(driven)
    }

    /// Each session drives another part of the route.
    fn pose(&self, step: u32) -> Pose {
        // A remainder of a division by 0 would be NaN.
        let length_m = self.route.length_m().max(f64::MIN_POSITIVE);
        // A share that is no simple fraction: few sessions meet at one place.
        let from_m = f64::from(self.number) * 0.37 * length_m;
        let station_m = (from_m + f64::from(step) * 0.1 * SPEED_M_PER_S) % length_m;
        let pose = self.route.at_station(station_m);
        Pose { xyz: pose.position_m.to_array(), q: pose.q_wxyz() }
    }
}

/// Two small cameras, ahead and back.
fn rig() -> anyhow::Result<Rig> {
    let camera = |name: &str, x: f64, q: [f64; 4]| {
        json!({ "name": name, "width": 160, "height": 100, "fx": 100.0, "fy": 100.0, "cx": 80.0, "cy": 50.0,
                "camera_to_rig": { "xyz": [x, 0.0, 1.6], "q": q } })
    };
    let cameras = json!([
        camera("front", 1.9, [0.5, -0.5, 0.5, -0.5]),
        camera("rear", -0.6, [0.5, -0.5, -0.5, 0.5])
    ]);
    Ok(Rig {
        name: "soak".to_owned(),
        cameras: serde_json::from_value(cameras)?,
        lidars: Vec::new(),
    })
}
