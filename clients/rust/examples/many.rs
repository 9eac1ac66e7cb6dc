//! Measures steps per second of several sessions: on one connection with `step_many`, and on one
//! connection per session.
//!
//! Each session has one camera of 96 x 60 px with raw images. The two ways take turns, and must
//! give the same images.
//!
//! `cargo run --release -p wildcity-client --example many -- URL TWIN [SESSIONS] [STEPS]`, with a
//! URL such as ws://127.0.0.1:8080/v1/session

#![allow(clippy::print_stdout, reason = "an example")]

use std::time::Instant;

use wildcity_client::protocol::message::{Encoding, Outputs, Rig, RigCamera, RigChoice};
use wildcity_client::{Client, Movement, Observation, Open, Pose};

const ROUNDS: usize = 5;

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [url, twin, counts @ ..] = &arguments[..] else {
        anyhow::bail!("usage: many ws://HOST:PORT/v1/session TWIN [SESSIONS] [STEPS]");
    };
    let sessions: usize = counts.first().map_or(Ok(16), |text| text.parse())?;
    let steps: u32 = counts.get(1).map_or(Ok(100), |text| text.parse())?;
    let mut rates: [Vec<f64>; 2] = Default::default();
    for round in 0..ROUNDS {
        let (one_s, one_hash) = one_connection(url, twin, sessions, steps).await?;
        let (many_s, many_hash) = many_connections(url, twin, sessions, steps).await?;
        anyhow::ensure!(one_hash == many_hash, "the images differ");
        let all = sessions as f64 * f64::from(steps);
        let one = all / one_s;
        let many = all / many_s;
        println!(
            "round {round}: step_many {one:.0} steps/s, {sessions} connections {many:.0}: {:.2}",
            one / many
        );
        rates[0].push(one);
        rates[1].push(many);
    }
    let median = |rates: &mut Vec<f64>| {
        rates.sort_by(f64::total_cmp);
        rates[rates.len() / 2]
    };
    let [one, many] = rates.each_mut().map(median);
    println!(
        "median: step_many {one:.0} steps/s, {sessions} connections {many:.0}: {:.2}",
        one / many
    );
    Ok(())
}

/// Seconds that the steps take, and a hash of the last images.
async fn one_connection(
    url: &str,
    twin: &str,
    sessions: usize,
    steps: u32,
) -> anyhow::Result<(f64, String)> {
    let mut client = Client::connect(url, "many").await?;
    let names: Vec<String> = (0..sessions).map(|k| format!("many-{k}")).collect();
    let mut starts = Vec::new();
    for name in &names {
        starts.push(client.open(open(twin, Some(name.clone()))).await?.start);
    }
    let begun = Instant::now();
    let mut last = String::new();
    for step in 0..steps {
        let each = names.iter().zip(&starts).enumerate();
        let moves =
            each.map(|(k, (name, start))| Movement::Pose(ahead(*start, step, k)).for_session(name));
        last.clear();
        for stepped in client.step_many(moves.collect()).await? {
            let refused = |refused| anyhow::anyhow!("{}: {refused:?}", stepped.session);
            last += &stepped.result.map_err(refused)?.metadata().frame_hash;
        }
    }
    let seconds = begun.elapsed().as_secs_f64();
    for name in &names {
        client.select(name);
        client.close().await?;
    }
    Ok((seconds, last))
}

async fn many_connections(
    url: &str,
    twin: &str,
    sessions: usize,
    steps: u32,
) -> anyhow::Result<(f64, String)> {
    let mut clients = Vec::new();
    for _ in 0..sessions {
        let mut client = Client::connect(url, "many").await?;
        let start = client.open(open(twin, None)).await?.start;
        clients.push((client, start));
    }
    let begun = Instant::now();
    let drive = |(k, (mut client, start)): (usize, (Client, Pose))| {
        tokio::spawn(async move {
            let mut last: Option<Observation> = None;
            for step in 0..steps {
                last = Some(client.step(ahead(start, step, k)).await?);
            }
            Ok::<_, anyhow::Error>((client, last))
        })
    };
    let running: Vec<_> = clients.into_iter().enumerate().map(drive).collect();
    let mut done = Vec::new();
    for task in running {
        done.push(task.await??);
    }
    let seconds = begun.elapsed().as_secs_f64();
    let mut hashes = String::new();
    for (mut client, last) in done {
        hashes += last.as_ref().map_or("", |last| &last.metadata().frame_hash);
        client.close().await?;
    }
    Ok((seconds, hashes))
}

/// A pose 0.1 m further with each step, and offset from the start by the number of the session.
fn ahead(start: Pose, step: u32, session: usize) -> Pose {
    let [x, y, z] = start.xyz;
    let forward_m = 0.1 * f64::from(step + 1);
    Pose { xyz: [x + forward_m, y + 0.05 * session as f64, z], q: start.q }
}

fn open(twin: &str, session: Option<String>) -> Open {
    let camera = RigCamera {
        name: "front".to_owned(),
        width: 96,
        height: 60,
        fx: Some(60.0),
        fy: Some(60.0),
        cx: 48.0,
        cy: 30.0,
        lens: None,
        windshield: None,
        shutter: None,
        exposure: None,
        overlay: None,
        native_size: None,
        camera_to_rig: Pose { xyz: [1.9, 0.0, 1.65], q: [0.5, -0.5, 0.5, -0.5] },
    };
    let rig = Rig { name: "one".to_owned(), cameras: vec![camera], lidars: Vec::new() };
    Open {
        session,
        rig: Some(RigChoice::Full(rig)),
        outputs: Outputs { encoding: Encoding::Raw, ..Outputs::default() },
        ..Open::twin(twin)
    }
}
