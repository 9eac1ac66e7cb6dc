//! Commands on twins in an object store.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::places::commit;
use crate::s3::{Fault, S3, keys};
use crate::scene_files::{gaussians, inria_columns, ply};
use crate::served::Served;
use crate::wildcity;

#[test]
fn commands_take_a_url() {
    let s3 = S3::start();
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("street.ply");
    std::fs::write(&source, ply(&gaussians(500, 0, 50.0, 1), &inria_columns(0, false))).unwrap();
    let run = |arguments: &[&str]| {
        let mut command = wildcity();
        command.args(arguments).args(["--twins", &S3::url()]).env("XDG_CACHE_HOME", dir.path());
        let output = s3.environment(&mut command).output().unwrap();
        let said = |bytes: &[u8]| String::from_utf8(bytes.to_owned()).unwrap();
        (output.status.code(), said(&output.stdout), said(&output.stderr))
    };
    let (code, out, error) = run(&["import", source.to_str().unwrap(), "--twin", "street"]);
    assert_eq!(code, Some(0), "{error}");
    assert!(out.contains("s3://bucket/twins/street"), "{out}");
    let (code, out, error) = run(&["twin", "show", "street"]);
    assert_eq!(code, Some(0), "{error}");
    assert!(out.contains("gaussians   500"), "{out}");
    let (code, out, _) = run(&["twin", "log", "street"]);
    assert!(code == Some(0) && out.contains("import"), "{out}");
    let mut command = wildcity();
    let output =
        command.args(["twin", "show", "street", "--twins", "ftp://bucket/x"]).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("cannot use ftp://bucket/x for twins: one of s3://"), "{said}");
}

/// A store cannot send this machine to another service.
#[test]
fn a_redirect_to_another_place_is_refused() {
    let s3 = S3::start();
    commit(&s3.catalog(), &gaussians(100, 0, 50.0, 1));
    let other = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    other.set_nonblocking(true).unwrap();
    s3.fail("GET", "twins", 1000, Fault::Redirected(other.local_addr().unwrap().port()));
    let mut command = wildcity();
    command.args(["twin", "show", "street", "--twins", &S3::url()]);
    let output = s3.environment(&mut command).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(
        !output.status.success() && said.contains("which is another place: name that one"),
        "{said}"
    );
    let asked = other.accept();
    assert!(asked.is_err(), "the other place was asked: {asked:?}");
}

#[test]
fn a_killed_import_leaves_the_old_version_or_the_new_one() {
    let s3 = S3::start();
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("new.ply");
    std::fs::write(&source, ply(&gaussians(20_000, 0, 220.0, 1), &inria_columns(0, false)))
        .unwrap();
    let catalog = s3.catalog();
    let old = commit(&catalog, &gaussians(1_000, 0, 220.0, 2));
    let puts = keys(&s3.twins()).len();
    let mut killed_on_the_way = 0;
    for more in [0, 1, 3, 8, 15, 25, 40] {
        let mut import = import(&s3, &source).spawn().unwrap();
        let deadline = Instant::now() + Duration::from_secs(60);
        while keys(&s3.twins()).len() <= puts + more && import.try_wait().unwrap().is_none() {
            assert!(Instant::now() < deadline, "the import hangs");
            std::thread::sleep(Duration::from_millis(1));
        }
        killed_on_the_way += usize::from(import.try_wait().unwrap().is_none());
        import.kill().unwrap();
        import.wait().unwrap();
        let now = catalog.version("street", None).unwrap();
        assert!(now == old || now.manifest.gaussians() == 20_000, "after {more}");
        assert_eq!(catalog.verify("street", &mut |_, _| {}).unwrap().damaged.len(), 0);
    }
    assert!(killed_on_the_way >= 2, "only {killed_on_the_way} were killed on the way");
    assert!(import(&s3, &source).status().unwrap().success());
    assert_eq!(catalog.version("street", None).unwrap().manifest.gaussians(), 20_000);
}

/// Pushes of assets to a server whose twins are in an object store.
#[test]
fn an_actor_is_pushed_to_an_object_store() {
    let s3 = S3::start();
    let dir = tempfile::tempdir().unwrap();
    let served = Served::at(S3::url().as_ref(), tempfile::tempdir().unwrap(), |command| {
        s3.environment(command).env("XDG_CACHE_HOME", dir.path())
    });
    let url = format!("http://{}", served.address);
    let file = |name: &str, seed: u64| {
        let path = dir.path().join(format!("{name}.ply"));
        std::fs::write(&path, ply(&gaussians(500, 0, 2.0, seed), &inria_columns(0, false)))
            .unwrap();
        path.display().to_string()
    };
    let run = |arguments: &[&str]| {
        let mut command = wildcity();
        command.arg("actor").args(arguments).env("XDG_CACHE_HOME", dir.path());
        let output = s3.environment(&mut command).output().unwrap();
        let said = |bytes: &[u8]| String::from_utf8(bytes.to_owned()).unwrap();
        (output.status.success(), said(&output.stdout), said(&output.stderr))
    };
    let objects = || keys(&s3.twins().join(".actors")).len();
    let listed = || run(&["list", "--twins", &S3::url()]).1;
    let car = file("car", 1);

    // An object that cannot be written: nothing is there. The server tries more often than a test
    // would.
    s3.fail("PUT", "/.actors/objects/", 100, Fault::Status(403));
    let (done, _, error) = run(&["push", &car, "--server", &url]);
    assert!(!done && error.contains("cannot push the actor"), "{error}");
    assert!(objects() == 0 && listed().starts_with("no actors in s3://"), "{}", listed());
    s3.forgive();

    let (done, pushed, error) = run(&["push", &car, "--server", &url]);
    assert!(done, "{error}");
    let own = dir.path().join("own").display().to_string();
    let (_, imported, error) = run(&["import", &car, "--twins", &own]);
    assert_eq!(pushed, imported, "{error}");
    let hash = pushed.trim_end().rsplit(' ').next().unwrap();
    assert!(objects() == 1 && listed().contains(hash), "{}", listed());
    // The same again, another content of this name, and one whose answer is lost.
    assert_eq!(run(&["push", &car, "--server", &url]).1, pushed);
    let van = file("van", 2);
    let (done, _, error) = run(&["push", &van, "--name", "car", "--server", &url]);
    assert!(!done && error.contains("another content"), "{error}");
    s3.fail("PUT", "/.actors/objects/", 1, Fault::AnswerLost);
    let (done, _, error) = run(&["push", &van, "--server", &url]);
    assert!(done && s3.to_fail() == 0, "{error}");
    assert_eq!((objects(), listed().lines().count()), (2, 2));

    let (done, removed, error) = run(&["remove", "car", "--twins", &S3::url()]);
    assert!(done && removed == format!("removed actor car\nblake3 {hash}\n"), "{removed}{error}");
    assert_eq!((objects(), listed().lines().count()), (1, 1));
}

fn import(s3: &S3, source: &Path) -> Command {
    let mut import = wildcity();
    s3.environment(&mut import).arg("import").arg(source);
    import.args(["--twin", "street", "--twins", &S3::url()]).stdout(Stdio::null());
    import
}
