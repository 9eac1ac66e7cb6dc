//! Commands on twins in an object store.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::places::commit;
use crate::s3::{S3, keys};
use crate::scene_files::{gaussians, inria_columns, ply};
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
    let (code, out, error) = run(&["inspect", "street"]);
    assert_eq!(code, Some(0), "{error}");
    assert!(out.contains("gaussians   500"), "{out}");
    let (code, out, _) = run(&["twin", "log", "street"]);
    assert!(code == Some(0) && out.contains("import"), "{out}");
    let (code, out, error) = run(&["bench", "load", "street", "--repeat", "1"]);
    assert!(code == Some(0) && out.contains("bare bytes"), "{out}{error}");
    let mut command = wildcity();
    let output = command.args(["inspect", "street", "--twins", "ftp://bucket/x"]).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("cannot use ftp://bucket/x for twins: one of s3://"), "{said}");
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

fn import(s3: &S3, source: &Path) -> Command {
    let mut import = wildcity();
    s3.environment(&mut import).arg("import").arg(source);
    import.args(["--twin", "street", "--twins", &S3::url()]).stdout(Stdio::null());
    import
}
