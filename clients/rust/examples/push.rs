//! Pushes a trained scene to a server as the next version of a twin, and waits until agents can
//! open it.
//!
//! `cargo run --release -p wildcity-client --example push -- http://127.0.0.1:8080 TWIN SCENE`
//!
//! SCENE is a file of a format that `wildcity import` reads, for example a checkpoint that
//! `python -m wildcity.convert` wrote as safetensors. The token is read from `WILDCITY_TOKEN`, if
//! it is set.

#![allow(clippy::print_stdout, reason = "an example tells its reader what it does")]

use std::path::Path;

use wildcity_client::{
    ConnectOptions, HttpClient, NewPush, PreviewRequest, Push, PushFile, PushState,
};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [url, twin, scene] = &arguments[..] else {
        anyhow::bail!("usage: push http://HOST:PORT TWIN SCENE");
    };

    let options = ConnectOptions::with_token(std::env::var("WILDCITY_TOKEN").ok());
    let client = HttpClient::new(url, &options)?;
    let mut on_progress = |sent: u64, total: u64| eprintln!("uploaded {sent} of {total} bytes");
    let upload = client.upload(Path::new(scene), &mut on_progress).await?;

    let request = NewPush {
        id: None,
        // The axes of COLMAP: y points down and z forward.
        files: vec![PushFile {
            upload: upload.id,
            axes: Some("y-down-z-forward".into()),
            scale: Some(1.0),
            name: None,
        }],
        frame: None,
        base: None,
        cells: None,
        record: None,
        levels: true,
        profile: Vec::new(),
        note: Some("pushed by the example".into()),
        preview: PreviewRequest::default(),
        drop_bad: false,
    };
    let push = client.push(twin, &request).await?;
    let mut on_state = |push: &Push| eprintln!("{:?}", push.state);
    let push = client.wait_for_push(push, &mut on_state).await?;

    match (push.state, push.error) {
        (PushState::Ready, _) => println!("version {} is ready", push.version.unwrap_or_default()),
        (state, Some(error)) => anyhow::bail!("{state:?}: {}", error.message),
        (state, None) => anyhow::bail!("{state:?}"),
    }
    Ok(())
}
