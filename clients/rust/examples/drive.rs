//! Drives straight ahead through a twin by teleport, and saves images of the first camera.
//!
//! `cargo run --release -p wildcity-client --example drive -- ws://127.0.0.1:8080/v1/session TWIN`

use wildcity_client::{Client, ImageView, Open, Pose};

/// 5 m/s at the default 10 steps per second.
const STEP_M: f64 = 0.5;

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [url, twin] = &arguments[..] else {
        anyhow::bail!("usage: drive ws://HOST:PORT/v1/session TWIN");
    };

    let mut client = Client::connect(url, "drive").await?;
    let start = client.open(Open::twin(twin)).await?.start;
    let yaw_rad = yaw_rad(start.q);
    client.reset(1, None).await?;
    for step in 1..=20 {
        let ahead_m = STEP_M * f64::from(step);
        let [x, y, z] = start.xyz;
        let xyz = [x + ahead_m * yaw_rad.cos(), y + ahead_m * yaw_rad.sin(), z];
        let observation = client.step(Pose { xyz, q: start.q }).await?;
        let Some(image) = observation.image(0) else { continue };
        let metadata = image.metadata();
        eprintln!("step {step}: {} {}x{} px", metadata.camera, metadata.width, metadata.height);
        if step % 10 == 0 {
            save(&image, &format!("drive_{step:03}_{}.png", metadata.camera))?;
        }
    }
    eprintln!("{:?}", client.close().await?);
    Ok(())
}

/// Heading of a rotation (w, x, y, z) in the world: counterclockwise from x (east), in radians.
fn yaw_rad([w, x, y, z]: [f64; 4]) -> f64 {
    (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z))
}

fn save(image: &ImageView<'_>, path: &str) -> anyhow::Result<()> {
    let width = u32::try_from(image.metadata().width)?;
    let height = u32::try_from(image.metadata().height)?;
    image::save_buffer(path, &image.rgb()?, width, height, image::ColorType::Rgb8)?;
    Ok(())
}
