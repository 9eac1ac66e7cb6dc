//! A damaged twin among nine good ones: the nine are listed and served from the start.

use std::path::Path;

use serde_json::{Value, json};
use wildcity_scene::Gaussians;
use wildcity_scene::manifest::Provenance;
use wildcity_twin::store::{Catalog, NewVersion};

use crate::support::{Agent, TestServer};

/// A twin of one Gaussian.
fn commit(dir: &Path, name: &str) {
    let gaussians = Gaussians {
        sh_degree: 0,
        means_m: vec![[0.0; 3]],
        quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0]],
        ln_scales: vec![[-1.0; 3]],
        logit_opacities: vec![2.0],
        sh: vec![0.5; 3],
        ..Gaussians::default()
    };
    let new = NewVersion {
        rig: Some(crate::support::rig()),
        ..NewVersion::from_gaussians(name, &gaussians, Provenance::new("test".to_owned()))
    };
    Catalog::open(dir).and_then(|catalog| catalog.commit(new, &mut |_, _| {})).expect("a twin");
}

/// Opens a session on a twin, and steps once.
async fn drives(agent: &mut Agent, twin: &str) {
    let pose = crate::support::pose(1.0);
    agent.open(json!({ "twin": twin, "start": { "pose": pose } })).await;
    assert_eq!(agent.step(1.0).await.meta["step"], 1);
    agent.ask(json!({ "type": "close" })).await;
}

fn names(list: &Value) -> Vec<&str> {
    let entries = list.as_array().map(Vec::as_slice).unwrap_or_default();
    entries.iter().map(|entry| entry["name"].as_str().expect("a name")).collect()
}

#[tokio::test]
async fn nine_twins_are_served_beside_a_damaged_one() {
    let good: Vec<String> = (1..9).map(|k| format!("good{k}")).collect();
    let server = TestServer::configured(|config| {
        for name in &good {
            commit(&config.directories.twins, name);
        }
        // The newest record is empty, as after a power cut on a file system without ordered writes.
        commit(&config.directories.twins, "broken");
        std::fs::write(config.directories.twins.join("broken/log/0000000002"), "").unwrap();
    })
    .await;
    let mut served: Vec<&str> = good.iter().map(String::as_str).collect();
    served.push("test");

    for round in 0..2 {
        let mut agent = Agent::connect(server.address()).await;
        let welcome = agent.hello().await;
        assert_eq!(names(&welcome["twins"]), served, "{welcome}");
        for twin in &served {
            drives(&mut agent, twin).await;
        }
        let refused = agent.try_open(json!({ "twin": "broken" })).await;
        crate::support::refused(&refused, "twin_damaged");

        let get = |path: &'static str| crate::http::get(&server, path);
        assert_eq!(get("/readyz").await.0, 200);
        let (status, answer) = get("/v1/twins").await;
        let list: Value = serde_json::from_str(answer.split("\r\n\r\n").nth(1).unwrap()).unwrap();
        assert_eq!((status, names(&list["twins"])), (200, served.clone()));
        assert_eq!(names(&list["damaged"]), ["broken"], "{list}");
        let reason = list["damaged"][0]["reason"].as_str().unwrap();
        assert!(reason.contains("broken/log/000000000"), "{reason}");
        if round == 0 {
            // The second time it happens while the server runs, and is a pipe.
            let record = server.twins.path().join("broken/log/0000000003");
            assert!(std::process::Command::new("mkfifo").arg(record).status().unwrap().success());
        }
    }
}
