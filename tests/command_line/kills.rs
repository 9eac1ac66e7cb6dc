//! kill -9 of a server at any point of a push: the old version or the new one, and the client's
//! next try succeeds.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use wildcity_client::{ConnectOptions, HttpClient, PushState};
use wildcity_twin::store::Catalog;

use crate::http::{new_push, write};
use crate::scene_files::{Random, gaussians};
use crate::support;

/// How often the server is killed.
const KILLS: usize = 100;
/// Kills on the same twin. Each is followed by a check of all its versions.
const KILLS_OF_A_TWIN: usize = 20;
/// Gaussians of a push, in 16 cells.
const GAUSSIANS: usize = 500;

struct Serving {
    child: Child,
    client: HttpClient,
}

impl Serving {
    fn start(dir: &Path) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_wildcity"))
            .args(["serve", "--backend", "cpu", "--log", "error", "--listen", "127.0.0.1:0"])
            .arg("--twins")
            .arg(dir.join("twins"))
            .arg("--episodes")
            .arg(dir.join("episodes"))
            .arg("--uploads")
            .arg(dir.join("uploads"))
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let url = line.trim().strip_prefix("listening on ws://").expect(&line);
        let url = format!("http://{}", url.strip_suffix("/v1/session").unwrap());
        Self { child, client: HttpClient::new(&url, &ConnectOptions::default()).unwrap() }
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        // It may be dead already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Uploads and pushes a file under an id, and returns the version.
async fn push(client: HttpClient, path: std::path::PathBuf, id: String) -> u64 {
    let upload = client.upload(&path, &mut |_, _| {}).await.unwrap();
    let mut asked = new_push(&[&upload.id]);
    asked.id = Some(id);
    let begun = client.push("test", &asked).await.unwrap();
    let ended = client.wait_for_push(begun, &mut |_| {}).await.unwrap();
    assert_eq!(ended.state, PushState::Ready, "{ended:?}");
    ended.version.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_server_has_the_old_version_or_the_new_one() {
    let directory_with_twin = || {
        let dir = tempfile::tempdir().unwrap();
        support::commit_twin(&dir.path().join("twins"));
        dir
    };
    let scene = |dir: &Path, round: usize| {
        let gaussians = gaussians(GAUSSIANS, 0, 100.0, 100 + round as u64);
        write(dir, "scene.ply", &gaussians)
    };
    let latest = |dir: &Path| {
        let catalog = Catalog::open(&dir.join("twins")).unwrap();
        let version = catalog.version("test", None).unwrap();
        (version.number, version.manifest.provenance.source)
    };
    // Measure how long an undisturbed push takes.
    let mut dir = directory_with_twin();
    let mut serving = Serving::start(dir.path());
    let begun = Instant::now();
    push(serving.client.clone(), scene(dir.path(), KILLS), "first".to_owned()).await;
    let mut whole = begun.elapsed();
    let mut random = Random(1);
    let (mut on_the_way, mut old, mut new) = (0, 0, 0);
    for round in 0..KILLS {
        if round > 0 && round.is_multiple_of(KILLS_OF_A_TWIN) {
            drop(serving);
            dir = directory_with_twin();
            serving = Serving::start(dir.path());
        }
        let (before, source) = latest(dir.path());
        let path = scene(dir.path(), round);
        let id = format!("push-{round}");
        let pushing = tokio::spawn(push(serving.client.clone(), path.clone(), id.clone()));
        tokio::time::sleep(whole.mul_f64(random.unit())).await;
        // The load of the machine changes, so the kills follow the current duration of a push.
        if pushing.is_finished() {
            whole = whole * 7 / 8
        } else {
            on_the_way += 1
        }
        drop(serving);
        pushing.abort();
        let (after, now) = latest(dir.path());
        match after - before {
            0 => {
                assert_eq!(now, source, "round {round}");
                old += 1;
            }
            1 => {
                assert_ne!(now, source, "round {round}");
                new += 1;
            }
            more => panic!("{more} versions of one push, round {round}"),
        }
        let catalog = Catalog::open(&dir.path().join("twins")).unwrap();
        let checked = catalog.fsck("test", &mut |_, _| {}).unwrap();
        assert!(checked.is_sound(), "round {round}: {checked:?}");
        serving = Serving::start(dir.path());
        let begun = Instant::now();
        let retried = push(serving.client.clone(), path, id);
        let version = tokio::time::timeout(Duration::from_secs(60), retried).await.unwrap();
        assert_eq!(version, before + 1, "the client's next try, round {round}");
        if after == before {
            whole = (whole * 7 + begun.elapsed()) / 8;
        }
    }
    eprintln!("{KILLS} kills within {whole:?}: {on_the_way} on the way, {old} old, {new} new");
    assert!(on_the_way >= KILLS / 2, "only {on_the_way} kills came in time");
    assert!(old > 0 && new > 0, "{old} kills left the old version, {new} the new one");
}
