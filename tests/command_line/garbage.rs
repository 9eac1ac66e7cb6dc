//! `wildcity twin gc`, `fsck`, `list` and `log`.

use crate::places::{Place, cells_alone, change, commit};
use crate::scene_files::gaussians;
use crate::wildcity;

#[test]
fn gc_fsck_list_and_log_print_their_results() {
    let dir = tempfile::tempdir().unwrap();
    let place = Place::Directory(dir);
    let catalog = place.catalog();
    commit(&catalog, &gaussians(1_000, 0, 40.0, 1));
    for number in 2..=3 {
        change(&catalog, [3, 3], number).change(number - 1, cells_alone()).unwrap();
    }
    let run = |arguments: &[&str]| {
        let mut command = wildcity();
        command.arg("twin").args(arguments).arg("--twins").arg(place.twins());
        let output = command.output().unwrap();
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    let gc = ["gc", "street", "--keep", "1", "--grace", "0s"];
    let (code, said) = run(&gc);
    assert_eq!(code, Some(0));
    assert!(said.starts_with("kept versions 3\nremoved 0 objects"), "{said}");
    let (_, said) = run(&[&gc[..], &["--dry-run"]].concat());
    assert!(said.contains("would be removed 5 objects"), "{said}");
    let (_, said) = run(&gc);
    assert!(said.contains("removed 5 objects") && said.contains("noted 0 objects"), "{said}");
    let (code, said) = run(&["fsck", "street", "--json"]);
    let found: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!((code, &found["sound"]), (Some(0), &true.into()), "{said}");
    assert_eq!(found["collected"], serde_json::json!([1, 2]));
    let (_, said) = run(&["list"]);
    assert!(said.starts_with("street ") && said.contains("version 3"), "{said}");
    let (_, said) = run(&["log", "street", "--json"]);
    assert_eq!(said.lines().count(), 3);
    let (_, said) = run(&["log", "street"]);
    assert!(said.contains("push of 2"), "{said}");
    // A damaged record is listed with its reason, and set aside on demand.
    std::fs::write(place.twins().join("street/log/0000000004"), "").unwrap();
    let (code, said) = run(&["list"]);
    assert_eq!(code, Some(0));
    assert!(
        said.contains("street") && said.contains("damaged: ") && said.contains("log/0000000004"),
        "{said}"
    );
    assert_eq!(run(&["fsck", "street"]).0, Some(1));
    assert_eq!(run(&["fsck", "street", "--repair"]).0, Some(0));
    assert!(run(&["list"]).1.contains("version 3"));
    std::fs::remove_file(place.twins().join("street/log/0000000001")).unwrap();
    let (code, said) = run(&["fsck", "street"]);
    assert_eq!(code, Some(1));
    assert!(said.contains("lost version 1: the log has later ones"), "{said}");
}
