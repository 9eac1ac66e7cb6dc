//! Drives straight ahead through a twin and saves what the first camera sees.
//!
//! `cargo run --release --example drive -- ws://127.0.0.1:8080/v1/session TWIN`

use wildcity_client::Client;
use wildcity_protocol::message::{Open, Pose};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let [url, twin] = std::env::args()
        .skip(1)
        .collect::<Vec<_>>()
        .try_into()
        .map_err(|_| anyhow::anyhow!("usage: drive ws://HOST:PORT/v1/session TWIN"))?;
    let mut client = Client::connect(&url, "drive").await?;
    let Pose { xyz: [x, y, z], q } = client.open(Open::twin(twin)).await?.start;
    let yaw_rad =
        (2.0 * (q[0] * q[3] + q[1] * q[2])).atan2(1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]));
    client.reset(1, None).await?;
    for step in 1..=20 {
        let ahead_m = 0.5 * f64::from(step); // 5 m/s at 10 Hz
        let xyz = [x + ahead_m * yaw_rad.cos(), y + ahead_m * yaw_rad.sin(), z];
        let seen = client.step(Pose { xyz, q }).await?;
        let Some(image) = seen.image(0) else { continue };
        let m = image.metadata();
        eprintln!("step {}: {} {}x{} px", seen.metadata().step, m.camera, m.width, m.height);
        if step % 10 == 0 {
            let path = format!("drive_{step:03}_{}.png", m.camera);
            let (width, height) = (u32::try_from(m.width)?, u32::try_from(m.height)?);
            image::save_buffer(path, &image.rgb()?, width, height, image::ColorType::Rgb8)?;
        }
    }
    eprintln!("{:?}", client.close().await?);
    Ok(())
}
