//! `wildcity twin align`, `wildcity twin route from-colmap` and `from-nerfstudio`,
//! `wildcity twin drive`.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use glam::{DMat3, DQuat, DVec3};
use serde_json::{Value, json};
use wildcity_generate::StreetSettings;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Gaussians, Rig, Trajectory};
use wildcity_twin::store::{Catalog, CommitKind, StorageOptions, VersionChange};

use crate::in_folder::{done, misused, refused, warned};
use crate::scene_files::{inria_columns, ply};

/// The axes of a capture: the street, upside down, tilted, moved, and half as large.
fn capture_from_street() -> (Pose, f64) {
    let rotation = DQuat::from_xyzw(0.9, 0.1, -0.3, 0.2).normalize();
    (Pose { position_m: DVec3::new(12.0, -7.0, 3.0), rotation }, 0.5)
}

/// A street in the axes of its capture.
fn captured_street() -> (Gaussians, Trajectory) {
    let street = wildcity_generate::street(&StreetSettings::default()).unwrap();
    let mut gaussians = street.gaussians;
    let (pose, scale) = capture_from_street();
    gaussians.transform(&pose);
    gaussians.scale(scale);
    (gaussians, street.trajectory)
}

/// Imports the street in the axes of its capture. Returns its drive, in its own.
fn import_street(at: &Path, options: &[&str]) -> Trajectory {
    let (gaussians, drive) = captured_street();
    let columns = inria_columns(gaussians.sh_degree, false);
    fs::write(at.join("street.ply"), ply(&gaussians, &columns)).unwrap();
    done(at, &[&["import", "street.ply", "--twin", "street"][..], options].concat());
    drive
}

/// Camera poses of the first keyframes of the street's drive, in the axes of the capture.
fn camera_poses(drive: &Trajectory) -> Vec<Pose> {
    let rig = Rig::preset("vehicle6").unwrap();
    let front = rig.cameras.iter().find(|camera| camera.name == "front").unwrap();
    let (capture_from_street, scale) = capture_from_street();
    let poses = drive.keyframes.iter().take(40).map(|keyframe| {
        let mut pose = capture_from_street * (keyframe.world_from_rig * front.rig_from_camera);
        pose.position_m *= scale;
        pose
    });
    poses.collect()
}

fn write_colmap_text(dir: &Path, poses: &[Pose]) {
    fs::create_dir_all(dir).unwrap();
    fs::write(
        dir.join("cameras.txt"),
        "# cameras\n1 OPENCV 1440 928 1800 1801 720 464 0.01 -0.02 0.001 0\n",
    )
    .unwrap();
    let mut text = "# images\n".to_owned();
    for (index, pose) in poses.iter().enumerate() {
        let inverse = pose.inverse();
        let [w, x, y, z] = inverse.q_wxyz();
        let t = inverse.position_m;
        writeln!(
            text,
            "{} {w} {x} {y} {z} {} {} {} 1 front view/{index}.png",
            index + 1,
            t.x,
            t.y,
            t.z
        )
        .unwrap();
        // The points of an image: some, or an empty line.
        text.push_str(if index % 2 == 0 { "10.5 20.5 -1 3 4 7\n" } else { "\n" });
    }
    fs::write(dir.join("images.txt"), text).unwrap();
}

fn write_colmap_binary(dir: &Path, poses: &[Pose]) {
    fs::create_dir_all(dir).unwrap();
    let mut cameras = 1_u64.to_le_bytes().to_vec();
    cameras.extend(1_i32.to_le_bytes());
    cameras.extend(4_i32.to_le_bytes());
    cameras.extend([1440_u64, 928].iter().flat_map(|side| side.to_le_bytes()));
    let parameters = [1800.0, 1801.0, 720.0, 464.0, 0.01, -0.02, 0.001, 0.0_f64];
    cameras.extend(parameters.iter().flat_map(|value| value.to_le_bytes()));
    fs::write(dir.join("cameras.bin"), cameras).unwrap();
    let mut images = (poses.len() as u64).to_le_bytes().to_vec();
    for (index, pose) in poses.iter().enumerate() {
        let inverse = pose.inverse();
        images.extend((index as i32 + 1).to_le_bytes());
        images.extend(inverse.q_wxyz().iter().flat_map(|value| value.to_le_bytes()));
        images.extend(inverse.position_m.to_array().iter().flat_map(|value| value.to_le_bytes()));
        images.extend(1_i32.to_le_bytes());
        images.extend(format!("front view/{index}.png\0").into_bytes());
        let points = (index % 3) as u64;
        images.extend(points.to_le_bytes());
        images.extend(vec![7; 24 * points as usize]);
    }
    fs::write(dir.join("images.bin"), images).unwrap();
}

fn transforms(poses: &[Pose]) -> Value {
    let frame = |(index, pose): (usize, &Pose)| {
        let opengl = pose.rotation_matrix() * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let row = |at: usize| {
            let row = opengl.row(at);
            json!([row.x, row.y, row.z, pose.position_m[at]])
        };
        json!({"file_path": format!("front view/{index}.png"),
            "transform_matrix": [row(0), row(1), row(2), [0, 0, 0, 1]]})
    };
    json!({"camera_model": "OPENCV", "w": 1440, "h": 928, "fl_x": 1800, "fl_y": 1801, "cx": 720, "cy": 464,
        "k1": 0.01, "k2": -0.02, "p1": 0.001, "p2": 0,
        "frames": poses.iter().enumerate().map(frame).collect::<Vec<_>>()})
}

fn read<T: serde::de::DeserializeOwned>(path: &Path) -> T {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

#[test]
fn a_capture_becomes_a_street_that_can_be_driven() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let street_drive = import_street(at, &[]);

    // 1. The ground is proposed, and nothing changes before it is confirmed.
    let ends = street_drive.keyframes.iter().map(|keyframe| keyframe.world_from_rig.position_m);
    let (capture, scale) = capture_from_street();
    let ends: Vec<DVec3> = ends.map(|at_m| scale * capture.transform_point(at_m)).collect();
    let (from, to) = (ends[0], ends[100]);
    let point = |at: DVec3| format!("{},{},{}", at.x, at.y, at.z);
    let metres = format!("{}", from.distance(to) / scale);
    let (from, to) = (point(from), point(to));
    let align = ["twin", "align", "street", "--from", &from, "--to", &to, "--distance-m", &metres];
    let said = done(at, &align);
    assert!(said.contains("scale       2 m") || said.contains("scale       1.999999"), "{said}");
    assert!(said.contains("nothing is changed"), "{said}");
    assert!(said.contains("street-align.png, with a grid of 20 m\n"), "{said}");
    let picture = image::open(at.join("street-align.png")).unwrap().into_rgb8();
    let mean = |from: u32| {
        let half = picture.height() / 2;
        let rows = picture.rows().skip(from as usize).take(half as usize);
        rows.flatten().map(|pixel| f64::from(pixel.0[1])).sum::<f64>()
    };
    let [above, below] = [mean(0), mean(picture.height() / 2)];
    assert!(above > 1e6 && below > 1e6, "{above} {below}");
    // Each of the four pictures has a caption in its left upper corner, on this ground.
    for [x, y] in [[0, 0], [726, 0], [0, 446], [726, 446]] {
        assert_eq!(picture.get_pixel(x, y).0, [16, 20, 24], "{x} {y}");
    }
    let catalog = Catalog::open(&at.join("wildcity/twins")).unwrap();
    assert_eq!(catalog.latest("street").unwrap(), 1);
    let said = done(at, &[&align[..], &["--apply"]].concat());
    assert!(said.contains("twin street version 2: the ground is level"), "{said}");

    // 2. The cameras of its training images are a drive on that ground.
    let poses = camera_poses(&street_drive);
    write_colmap_text(&at.join("model/sparse/0"), &poses);
    let said =
        done(at, &["twin", "route", "from-colmap", "model", "--twin", "street", "--out", "drive"]);
    assert!(said.contains("40 keyframes, 19.") && said.contains("cameras front-view"), "{said}");
    let drive: Trajectory = read(&at.join("drive/capture.json"));
    drive.check().unwrap();
    assert!(
        drive.keyframes.iter().all(|k| k.world_from_rig.position_m.z.abs() < 0.05),
        "{drive:?}"
    );
    let rig: Rig = read(&at.join("drive/rig.json"));
    rig.check().unwrap();
    let height_m = rig.cameras[0].rig_from_camera.position_m.z;
    let preset = Rig::preset("vehicle6").unwrap();
    let front = preset.cameras.iter().find(|camera| camera.name == "front").unwrap();
    assert!((height_m - front.rig_from_camera.position_m.z).abs() < 0.05, "{height_m}");

    // 3. The binary model and transforms.json give the same.
    write_colmap_binary(&at.join("binary"), &poses);
    fs::write(at.join("transforms.json"), transforms(&poses).to_string()).unwrap();
    done(at, &["twin", "route", "from-colmap", "binary", "--twin", "street", "--out", "two"]);
    done(
        at,
        &[
            "twin",
            "route",
            "from-nerfstudio",
            "transforms.json",
            "--twin",
            "street",
            "--out",
            "three",
        ],
    );
    for other in ["two", "three"] {
        let same: Trajectory = read(&at.join(other).join("capture.json"));
        for (a, b) in same.keyframes.iter().zip(&drive.keyframes) {
            let off_m = a.world_from_rig.position_m.distance(b.world_from_rig.position_m);
            assert!(off_m < 1e-6, "{other}: {off_m}");
        }
        let same: Rig = read(&at.join(other).join("rig.json"));
        assert_eq!(same.cameras[0].camera, rig.cameras[0].camera, "{other}");
    }

    // 4. The twin gets them, and the Gaussians are where they were.
    let give = [
        "twin",
        "drive",
        "street",
        "--trajectory",
        "drive/capture.json",
        "--rig",
        "drive/rig.json",
    ];
    assert!(done(at, &give).contains("version 3: recorded drives: capture; rig: capture"));
    let [second, third] = [2, 3].map(|number| catalog.version("street", Some(number)).unwrap());
    assert_eq!(second.manifest.chunks, third.manifest.chunks);
    assert_eq!(third.manifest.rig.unwrap().name, "capture");
    assert!(done(at, &["twin", "fsck", "street"]).ends_with("all sound\n"));

    // 5. A push of files in the axes of the import has the same capture, and one of other files has
    //    another.
    let push = |base, provenance| {
        let options = StorageOptions { record: second.manifest.record, levels: true };
        let push = catalog.begin("street", CommitKind::Push, options).unwrap();
        push.change(base, VersionChange::new(provenance)).unwrap()
    };
    let mut trained = Provenance::new("block7.ply".into());
    trained.options = ["axes=identity", "scale=1"].map(str::to_owned).to_vec();
    trained.set_note("epoch 30");
    push(3, trained);
    let mut other = Provenance::new("block8.ply".into());
    other.options.push("axes=y-down-z-forward".to_owned());
    push(4, other);
    let route = |twin, out| ["twin", "route", "from-colmap", "model", "--twin", twin, "--out", out];
    let told = refused(at, &route("street", "five"));
    assert!(told.contains("version 5 was pushed") && told.contains("give --axes"), "{told}");
    assert!(!at.join("five").exists());
    let [of_third, of_fourth] = [("street@3", "six"), ("street@4", "seven")].map(|(twin, out)| {
        done(at, &route(twin, out));
        read::<Trajectory>(&at.join(out).join("capture.json"))
    });
    assert_eq!(of_third, of_fourth);

    // 6. A preset is a rig, and the log says which versions are edits.
    let preset = done(at, &["twin", "drive", "street", "--rig", "vehicle6"]);
    assert!(preset.contains("version 6: recorded drives: capture; rig: vehicle6"), "{preset}");
    let none = refused(at, &["twin", "drive", "street", "--rig", "vehicle7"]);
    assert!(none.contains("\"vehicle7\" is neither a file nor a preset"), "{none}");
    let log = done(at, &["twin", "log", "street"]);
    let how: Vec<&str> = log.lines().map(|line| line[30..46].trim()).collect();
    assert_eq!(
        how,
        ["import", "edit of 1", "edit of 2", "push of 3", "push of 4", "edit of 5"],
        "{log}"
    );
}

/// The cameras that a scene was trained from say where the ground is, and how long its unit is.
#[test]
fn the_ground_is_found_below_the_cameras() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let street_drive = import_street(at, &["--axes", "y-down-z-forward"]);
    let poses = camera_poses(&street_drive);
    write_colmap_text(&at.join("model/sparse/0"), &poses);
    fs::write(at.join("transforms.json"), transforms(&poses).to_string()).unwrap();

    let preset = Rig::preset("vehicle6").unwrap();
    let front = preset.cameras.iter().find(|camera| camera.name == "front").unwrap();
    let height_m = front.rig_from_camera.position_m.z.to_string();
    let align = ["twin", "align", "street", "--cameras"];
    for source in ["model", "transforms.json"] {
        let said = done(at, &[&align[..], &[source, "--camera-height-m", &height_m]].concat());
        let scale = said.lines().find_map(|line| line.strip_prefix("scale       ")).unwrap();
        let metres: f64 = scale.strip_suffix(" m per unit").unwrap().parse().unwrap();
        // The pavements are a kerb higher than the road.
        assert!((metres - 2.0).abs() < 0.12, "{said}");
        assert!(said.contains(" m above the ground (median)"), "{said}");
    }
    let said = done(at, &[&align[..], &["model"]].concat());
    assert!(said.contains("scale       1 m per unit"), "{said}");

    let error = refused(at, &[&align[..], &["nowhere"]].concat());
    assert!(error.contains("--cameras") && error.contains("nowhere"), "{error}");
    // A wall, if that is said to be the ground.
    let said = done(at, &[&align[..], &["model", "--up", "x"]].concat());
    assert!(said.contains("up is (0.9"), "{said}");
    let both = ["model", "--camera-height-m", &height_m, "--scale", "2"];
    for (options, said) in [
        (&["model", "--camera-height-m", "0"][..], "a height above the ground in metres"),
        (&["model", "--camera-height-m", "NaN"], "a height above the ground in metres"),
        (&both, "cannot be used with"),
    ] {
        let error = misused(at, &[&align[..], options].concat());
        assert!(error.contains(said), "{error}");
    }
}

#[test]
fn damaged_captures_name_the_file_the_place_and_the_fix() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let (_, street_drive) = captured_street();
    let poses = camera_poses(&street_drive);
    let colmap = ["twin", "route", "from-colmap", "m", "--camera-height-m", "1.6", "--out", "out"];
    fs::create_dir(at.join("m")).unwrap();
    let told = refused(at, &colmap);
    assert!(told.contains("no COLMAP model") && told.contains("model_converter"), "{told}");

    let text = at.join("m");
    let cases: [(&str, &str, &str, &str); 7] = [
        ("cameras.txt", "OPENCV", "OPENKV", "cameras.txt:2: \"OPENKV\" is not a camera model"),
        ("cameras.txt", "OPENCV", "PINHOLE", "cameras.txt:2: 8 parameters; PINHOLE has 4"),
        ("cameras.txt", "OPENCV", "FOV", "cameras.txt:2: the camera model FOV is not supported"),
        ("cameras.txt", "1440", "wide", "cameras.txt:2: WIDTH is \"wide\", not a number"),
        (
            "images.txt",
            " 1 front view/0",
            " 3 front view/0",
            "images.txt:2: camera 3 is not in m/cameras.txt",
        ),
        ("images.txt", " front view/1.png", "", "images.txt:4: expected IMAGE_ID QW"),
        (
            "images.txt",
            "# images\n1 ",
            "# images\n1 9",
            "images.txt:2: the quaternion (w, x, y, z) has length",
        ),
    ];
    for (file, from, to, wanted) in cases {
        write_colmap_text(&text, &poses);
        let whole = fs::read_to_string(text.join(file)).unwrap();
        assert!(whole.contains(from), "{file}: {from}");
        fs::write(text.join(file), whole.replacen(from, to, 1)).unwrap();
        let told = refused(at, &colmap);
        assert!(told.contains(wanted), "{wanted}\n{told}");
    }

    fs::remove_dir_all(&text).unwrap();
    write_colmap_binary(&text, &poses);
    let whole = fs::read(text.join("images.bin")).unwrap();
    fs::write(text.join("images.bin"), &whole[..whole.len() - 5]).unwrap();
    let told = refused(at, &colmap);
    assert!(told.contains("m/images.bin, byte ") && told.contains("copy it again"), "{told}");
    fs::write(text.join("images.bin"), [&whole[..], b"more"].concat()).unwrap();
    assert!(refused(at, &colmap).contains("4 bytes after the last entry"));

    let nerfstudio =
        ["twin", "route", "from-nerfstudio", "t.json", "--camera-height-m", "1.6", "--out", "out"];
    let whole = transforms(&poses);
    let told = |change: &dyn Fn(&mut Value)| {
        let mut changed = whole.clone();
        change(&mut changed);
        fs::write(at.join("t.json"), changed.to_string()).unwrap();
        refused(at, &nerfstudio)
    };
    let said = told(&|file| drop(file.as_object_mut().unwrap().remove("w")));
    assert!(said.contains("t.json, frames[0].w: is missing"), "{said}");
    let said = told(&|file| file["frames"][3]["transform_matrix"][0] = json!([2, 0, 0, 0]));
    assert!(said.contains("t.json, frames[3].transform_matrix: the left 3 x 3"), "{said}");
    let said = told(&|file| file["camera_model"] = json!("EQUIRECTANGULAR"));
    assert!(said.contains("frames[0].camera_model: is \"EQUIRECTANGULAR\""), "{said}");
    fs::write(at.join("t.json"), "{\n \"frames\": [\n}").unwrap();
    assert!(refused(at, &nerfstudio).contains("t.json:3: "));
    assert!(!at.join("out").exists(), "nothing is written");
}

#[test]
fn times_of_frames_are_those_of_the_drive() {
    let Some(timed) = crate::data::real("cases/transforms_time_us/tj_time.json") else { return };
    let dir = tempfile::tempdir().unwrap();
    let run = |more: &[&str]| {
        let mut command = crate::wildcity();
        command.args([
            "twin",
            "route",
            "from-nerfstudio",
            timed.to_str().unwrap(),
            "--axes",
            "identity",
        ]);
        command.args(["--out", "out"]).args(more).current_dir(dir.path()).output().unwrap()
    };
    let output = run(&[]);
    assert!(output.status.success(), "{output:?}");
    let drive = std::fs::read(dir.path().join("out/capture.json")).unwrap();
    let drive: serde_json::Value = serde_json::from_slice(&drive).unwrap();
    let times_us = drive["keyframes"].as_array().unwrap().iter().map(|k| k["time_us"].as_i64());
    assert!(times_us.eq((0..12).map(|i| Some(500_000 * i))), "{drive}");
    let told = String::from_utf8(run(&["--fps", "10"]).stderr).unwrap();
    assert!(told.contains("leave out --fps"), "{told}");
}

/// A camera ahead and one to the sky, on the ground of a small scene.
#[test]
fn cameras_that_see_nothing_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let mut ground = Gaussians::with_capacity(0, 10_000);
    for i in 0..10_000 {
        let (x, y) = (0.2 * f64::from(i % 100), 0.2 * f64::from(i / 100) - 10.0);
        ground.means_m.push([x, y, 0.0]);
        ground.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        ground.ln_scales.push([-1.5, -1.5, -4.0]);
        ground.logit_opacities.push(4.0);
        ground.sh.extend([0.3; 3]);
    }
    fs::write(at.join("ground.ply"), ply(&ground, &inria_columns(0, false))).unwrap();
    let ahead = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    let upwards = DMat3::from_cols(DVec3::NEG_Y, DVec3::X, DVec3::Z);
    let camera = |name: &str, rotation: &DMat3| {
        let q = DQuat::from_mat3(rotation);
        json!({"name": name, "width": 640, "height": 400, "fx": 500, "fy": 500, "cx": 320, "cy": 200,
               "camera_to_rig": {"xyz": [0, 0, 1.5], "q": [q.w, q.x, q.y, q.z]}})
    };
    let rig = |cameras: Value| {
        fs::write(at.join("rig.json"), json!({"name": "two", "cameras": cameras}).to_string())
    };
    let drive = |height_m: f64| {
        let keyframe = |i: i64| {
            json!({"time_us": 100_000 * i,
                   "world_from_rig": {"xyz": [0.5 * i as f64, 0, height_m], "q": [1, 0, 0, 0]}})
        };
        let keyframes: Vec<Value> = (0..20).map(keyframe).collect();
        let drive = json!({"name": "log", "keyframes": keyframes});
        fs::write(at.join("drive.json"), drive.to_string()).unwrap();
    };
    drive(0.0);
    rig(json!([camera("front", &ahead), camera("up", &upwards)])).unwrap();
    let with = ["--rig", "rig.json", "--trajectory", "drive.json"];
    let import = [&["import", "ground.ply", "--twin", "ground"][..], &with].concat();
    let give = [&["twin", "drive", "ground"][..], &with].concat();
    for command in [&import, &give] {
        let told = warned(at, command);
        let wanted =
            "rig two: these cameras see nothing of the twin, wherever the drive is: up; look at";
        assert!(told.contains(wanted), "{told}");
    }
    // Far above, in another unit, neither sees anything.
    drive(3_000.0);
    let told = warned(at, &give);
    assert!(told.contains("wherever the drive is: front, up; look"), "{told}");
    let told = warned(at, &["twin", "align", "ground", "--apply"]);
    assert!(told.contains("wherever the drive is: front, up; look"), "{told}");
    // A camera that sees the ground is not named.
    drive(0.0);
    rig(json!([camera("front", &ahead)])).unwrap();
    let told = warned(at, &give);
    assert!(!told.contains("see nothing"), "{told}");
}
