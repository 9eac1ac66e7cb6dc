//! `wildcity-bench actors` on a short street.

use std::fs;

use serde_json::Value;

use wildcity_generate::StreetSettings;
use wildcity_scene::manifest::Provenance;
use wildcity_twin::store::NewVersion;

use crate::bench;
use crate::versions::commit;

#[test]
fn cars_cost_something_as_actors_and_within_the_twin() {
    let settings =
        StreetSettings { length_m: 100.0, crossing_m: 50.0, density: 0.1, ..Default::default() };
    let street = wildcity_generate::street(&settings).unwrap();
    let twins = tempfile::tempdir().unwrap();
    let new = NewVersion {
        trajectories: vec![street.trajectory],
        ..NewVersion::from_gaussians(
            "street",
            &street.gaussians,
            Provenance::new("test".to_owned()),
        )
    };
    commit(twins.path(), new).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let output = bench("actors")
        .args(["street", "--backend", "cpu", "--json", "--size", "96x60"])
        .args(["--cars", "6", "--gaussians", "3000", "--pairs", "2"])
        .arg("--twins")
        .arg(twins.path())
        .env("TMPDIR", dir.path())
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    let rows: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(rows.len(), 2);
    assert_eq!(rows[0]["tau_px"], 0.0);
    for row in &rows {
        let number = |field: &str| row[field].as_f64().unwrap();
        assert!(number("actors_ms") > 0.0 && number("baked_ms") > 0.0, "{row}");
        assert!(number("ratio") > 0.1 && number("ratio") < 10.0, "{row}");
        assert!(row["actors_stages_ms"]["project"].as_f64().unwrap() > 0.0, "{row}");
        // The same cars are there: only their contact shadows differ.
        assert!(number("psnr_db") > 25.0 && number("psnr_db") < 90.0, "{row}");
    }
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0, "nothing is left");

    let output =
        bench("actors").args(["street", "--backend", "cpu", "--size", "96by60"]).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("expected WxH, for example 96x60"), "{said}");
}
