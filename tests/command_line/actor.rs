//! `wildcity actor`: how sharp a mesh is as an actor, damaged assets, and removing assets.

use std::path::Path;

use crate::format_files::glb;
use crate::wildcity;

/// Half of the plate's length and thickness, and its height, in metres. Its 65 m² are those of the
/// lorry that `tests/actors/softness.py` measures, so that its Gaussians are as large.
const HALF_LENGTH_M: f32 = 5.2;
const HALF_THICKNESS_M: f32 = 0.05;
const HEIGHT_M: f32 = 3.0;
/// The distance that `show` draws the plate from, in metres, and its camera.
const DISTANCE_M: f64 = 8.0;
const FOCAL_PX: f64 = 1800.0;
/// The background of `show`; the plate is white.
const GREY: f64 = 0.55;

/// A white plate as a binary glTF: twelve triangles.
fn plate() -> Vec<u8> {
    let mut buffer = Vec::new();
    for corner in 0..8 {
        let end = |bit: u32| if corner >> bit & 1 == 1 { 1.0 } else { -1.0 };
        let height_m = HEIGHT_M * 0.5 * (1.0 + end(2));
        for m in [HALF_LENGTH_M * end(0), HALF_THICKNESS_M * end(1), height_m] {
            buffer.extend(f32::to_le_bytes(m));
        }
    }
    // The corners of each side, in turn around it: bit 0 of a corner is its x, bit 1 its y, bit 2
    // its z.
    for [a, b, c, d] in
        [[0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5], [0, 1, 3, 2], [4, 5, 7, 6_u8]]
    {
        buffer.extend([a, b, c, a, c, d]);
    }
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}}]}}],
        "accessors":[
        {{"bufferView":0,"componentType":5126,"count":8,"type":"VEC3",
          "min":[-{HALF_LENGTH_M},-{HALF_THICKNESS_M},0],"max":[{HALF_LENGTH_M},{HALF_THICKNESS_M},{HEIGHT_M}]}},
        {{"bufferView":1,"componentType":5121,"count":36,"type":"SCALAR"}}],
        "bufferViews":[{{"buffer":0,"byteLength":96}},{{"buffer":0,"byteOffset":96,"byteLength":36}}],
        "buffers":[{{"byteLength":132}}]}}"#
    );
    glb((json, buffer))
}

/// The edges of the plate in its picture.
#[derive(Debug)]
struct Edges {
    /// From 10 to 90 % of the upper edge, in pixels.
    width_px: f64,
    /// How much higher the plate is than its triangles are, in pixels.
    grown_px: f64,
}

/// Imports the plate with more options, and measures its picture.
fn edges(dir: &Path, options: &[&str]) -> Edges {
    let file = dir.join("plate.glb");
    std::fs::write(&file, plate()).unwrap();
    let twins = dir.join(format!("twins{}", options.join("")));
    let run = |command: &mut std::process::Command| {
        let output = command.arg("--twins").arg(&twins).output().unwrap();
        assert!(output.status.success(), "{output:?}");
    };
    run(wildcity().args(["actor", "import"]).arg(&file).args(options));
    let picture = dir.join("plate.png");
    let distance = DISTANCE_M.to_string();
    run(wildcity()
        .args(["actor", "show", "plate", "--distance", &distance, "--picture"])
        .arg(&picture));
    let image = image::open(&picture).unwrap().into_rgb8();

    // From the background to the plate, down its middle.
    let middle = image.width() / 2 - 100..image.width() / 2 + 100;
    let row = |y: u32| -> f64 {
        let sum: f64 = middle.clone().map(|x| f64::from(image.get_pixel(x, y).0[1])).sum();
        (sum / 200.0 / 255.0 - GREY) / (1.0 - GREY)
    };
    let rows: Vec<f64> = (0..image.height()).map(row).collect();
    let crossing = |rows: &mut dyn Iterator<Item = f64>, level: f64| -> f64 {
        let mut before = 0.0;
        for (y, share) in rows.enumerate() {
            if share > level {
                return y as f64 - (share - level) / (share - before);
            }
            before = share;
        }
        panic!("no edge at {level}")
    };
    let from_above = |level: f64| crossing(&mut rows.iter().copied(), level);
    let from_below = crossing(&mut rows.iter().rev().copied(), 0.5);
    let height_px = rows.len() as f64 - 1.0 - from_below - from_above(0.5);
    let wanted_px = f64::from(HEIGHT_M) * FOCAL_PX / DISTANCE_M;
    Edges { width_px: from_above(0.9) - from_above(0.1), grown_px: height_px - wanted_px }
}

/// With the default number of Gaussians, edges at 8 m are about as sharp as those of triangles,
/// which take up to 1.6 px between pixels: the table in BENCHMARKS.md.
#[test]
fn an_edge_of_a_mesh_at_eight_metres_is_sharp() {
    let dir = tempfile::tempdir().unwrap();
    let own = edges(dir.path(), &[]);
    assert!((0.8..2.0).contains(&own.width_px), "{own:?}");
    assert!((0.0..4.0).contains(&own.grown_px), "both edges together: {own:?}");
    // Half as many would not do.
    let few = edges(dir.path(), &["--gaussians", "100000"]);
    assert!(few.width_px > 2.0, "{few:?}, {own:?}");
}

/// Runs `wildcity actor` on a directory. Returns whether it succeeded, and its output.
fn actor(twins: &Path, arguments: &[&str]) -> (bool, String) {
    let output =
        wildcity().arg("actor").args(arguments).arg("--twins").arg(twins).output().unwrap();
    let said = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8(said).unwrap())
}

#[test]
fn a_damaged_asset_is_listed_and_removed() {
    let dir = tempfile::tempdir().unwrap();
    let twins = dir.path().join("twins");
    let file = dir.path().join("plate.glb");
    std::fs::write(&file, plate()).unwrap();
    let import = |name: &str| {
        let file = file.to_str().unwrap();
        let (done, said) = actor(&twins, &["import", file, "--name", name, "--gaussians", "1000"]);
        assert!(done, "{said}");
        said.trim_end().rsplit(' ').next().unwrap().to_owned()
    };
    let hashes = [import("good"), import("bad")];
    let path = twins.join(".actors/objects").join(&hashes[1][..2]).join(&hashes[1]);
    let mut bytes = std::fs::read(&path).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    std::fs::write(&path, bytes).unwrap();

    let (done, said) = actor(&twins, &["list"]);
    let lines: Vec<&str> = said.lines().collect();
    assert!(done && lines.len() == 2, "{said}");
    assert!(lines[0].starts_with("good ") && lines[0].ends_with(&hashes[0]), "{said}");
    assert!(lines[1].starts_with("bad ") && lines[1].ends_with(&hashes[1]), "{said}");
    assert!(lines[1].contains("damaged: its bytes hash to"), "{said}");
    let (done, said) = actor(&twins, &["show", "good"]);
    assert!(done && said.contains(&hashes[0]), "{said}");
    let (done, said) = actor(&twins, &["show", "bad"]);
    let remove = format!("wildcity actor remove {}", &hashes[1][..12]);
    assert!(!done && said.contains("is damaged") && said.contains(&remove), "{said}");
    // The error names the directory that was searched.
    let (done, said) = actor(&twins, &["show", "bus"]);
    assert!(!done && said.contains(&*twins.to_string_lossy()) && said.contains("good"), "{said}");
    let found = wildcity().arg("doctor").arg("--twins").arg(&twins).output().unwrap();
    let found = String::from_utf8(found.stdout).unwrap();
    assert!(found.contains(&remove), "{found}");

    let (done, said) = actor(&twins, &["remove", "bad", "--dry-run"]);
    assert!(done && said.starts_with("would remove") && path.exists(), "{said}");
    let (done, said) = actor(&twins, &["remove", "bad"]);
    assert!(done && said.starts_with("removed") && !path.exists(), "{said}");
    let (done, said) = actor(&twins, &["remove", "bad"]);
    assert!(!done && said.contains("there is no actor"), "{said}");
    let (done, said) = actor(&twins, &["list"]);
    assert!(done && said.lines().count() == 1, "{said}");
}
