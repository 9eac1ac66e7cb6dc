//! `wildcity log`: a log of a generated street, and what a check says of it and of damaged copies.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};
use std::sync::OnceLock;
use std::time::Duration;

use serde_json::{Value, json};
use wildcity_log::{Log, TrackRow};

use crate::wildcity;

/// A street of 100 m, and logs of it that all tests read.
pub(crate) struct Street {
    dir: tempfile::TempDir,
}

/// How late the LiDAR of the log `late` is, in milliseconds.
const LATE_MS: f64 = 40.0;

pub(crate) fn street() -> &'static Street {
    static STREET: OnceLock<Street> = OnceLock::new();
    STREET.get_or_init(|| {
        let street = Street { dir: tempfile::tempdir().unwrap() };
        street.done(&[
            "twin",
            "generate",
            "--twin",
            "town",
            "--length-km",
            "0.1",
            "--density",
            "1",
            "--map",
            "town.map.json",
        ]);
        street.generate("log", &["--map", "town.map.json"]);
        let late = LATE_MS.to_string();
        street.generate(
            "late",
            &["--lidar-late-ms", &late, "--cameras", "left,right", "--drop-every", "13"],
        );
        street
    })
}

impl Street {
    pub(crate) fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    pub(crate) fn run(&self, arguments: &[&str]) -> Output {
        let mut command = wildcity();
        command.args(arguments).current_dir(self.dir.path());
        command.env("XDG_DATA_HOME", self.at("data")).output().unwrap()
    }

    pub(crate) fn done(&self, arguments: &[&str]) -> String {
        let output = self.run(arguments);
        assert!(output.status.success(), "{arguments:?}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    }

    pub(crate) fn refused(&self, arguments: &[&str]) -> String {
        let output = self.run(arguments);
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {output:?}");
        String::from_utf8(output.stderr).unwrap()
    }

    fn generate(&self, out: &str, options: &[&str]) {
        let all = ["log", "generate", "town", "--out", out, "--width", "240", "--backend", "cpu"];
        self.done(&[&all[..], options].concat());
    }

    /// The numbers of `log check --json`.
    fn report(&self, log: &str) -> Value {
        let page = format!("{log}.html");
        let text = self.run(&["log", "check", log, "--json", "--out", &page]).stdout;
        serde_json::from_slice(&text).unwrap()
    }

    /// A copy of a log of which one file is changed.
    fn changed(&self, name: &str, file: &str, change: impl Fn(&str) -> String) -> String {
        let copy = self.at(name);
        fs::create_dir(&copy).unwrap();
        for entry in fs::read_dir(self.at("log")).unwrap() {
            let entry = entry.unwrap();
            let to = copy.join(entry.file_name());
            if entry.path().is_dir() {
                std::os::unix::fs::symlink(entry.path(), to).unwrap();
            } else {
                fs::copy(entry.path(), to).unwrap();
            }
        }
        let text = fs::read_to_string(copy.join(file)).unwrap();
        assert_ne!(change(&text), text);
        fs::write(copy.join(file), change(&text)).unwrap();
        name.to_owned()
    }
}

fn texts(report: &Value, level: &str) -> Vec<String> {
    let findings = report["findings"].as_array().unwrap().iter();
    let of_level = findings.filter(|finding| finding["level"] == level);
    of_level.map(|finding| finding["text"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn a_generated_log_is_whole() {
    let street = street();
    let said = street.done(&["log", "show", "log"]);
    for line in [
        "images of 6: 294 rows, 0.0 to 4.8 s",
        "  rear: 49 rows, 0.0 to 4.8 s, 10.0 Hz",
        "  top: 49 rows, 0.0 to 4.8 s, 10.0 Hz",
        "poses: 500 rows, 0.0 to 5.0 s, 100.0 Hz",
        "tracks of 3: 150 rows",
        "map: 14 lanes",
    ] {
        assert!(said.contains(line), "{said} lacks {line}");
    }
    let log = Log::open(&street.at("log")).unwrap();
    let tracks: Vec<TrackRow> = log.tracks().unwrap().unwrap().map(Result::unwrap).collect();
    // The oncoming van drives at 8 m/s, against the drive.
    let vans: Vec<&TrackRow> = tracks.iter().filter(|row| row.track == "van").collect();
    let [first, .., last] = &vans[..] else { panic!("{vans:?}") };
    let moved_m = last.world_from_box.position_m - first.world_from_box.position_m;
    assert!((moved_m.length() / 4.9 - 8.0).abs() < 0.3, "{moved_m}");
    let again = street.refused(&["log", "generate", "town", "--out", "log"]);
    assert!(again.contains("log exists: give another folder"), "{again}");
    assert!(street.refused(&["log", "show", "data"]).contains("is no log: it has no log.json"));
}

#[test]
fn a_check_finds_the_clock_of_the_lidar_and_lost_images() {
    let street = street();
    let report = street.report("log");
    assert_eq!(texts(&report, "error"), [""; 0], "{report:#}");
    assert_eq!(texts(&report, "warning"), [""; 0], "{report:#}");
    assert_eq!(texts(&report, "note"), ["not all images have a mask of the ground"]);
    let known_ms = |report: &Value| -> Vec<(String, f64)> {
        let all = report["alignment"].as_array().unwrap().iter();
        let known = all.filter_map(|one| Some((one, one["lidar_late_ms"].as_f64()?)));
        known.map(|(one, ms)| (one["camera"].as_str().unwrap().to_owned(), ms)).collect()
    };
    // A street looks alike in many places: not every camera tells, but none tells wrong.
    let found = known_ms(&report);
    assert!(found.len() >= 3 && found.iter().all(|(_, ms)| ms.abs() < 5.0), "{found:?}");
    let report = street.report("late");
    let found = known_ms(&report);
    assert!(found.iter().any(|(camera, _)| camera == "left"), "{found:?}");
    assert!(found.iter().all(|(_, ms)| (ms - LATE_MS).abs() < 5.0), "{found:?}");
    let warnings = texts(&report, "warning").join("\n");
    assert!(warnings.contains("camera left: the times of the LiDAR are"), "{warnings}");
    // Of 98 images 7 are lost, every 13th.
    let streams = report["streams"].as_array().unwrap().iter();
    let lost: u64 = streams.map(|stream| stream["missing"].as_u64().unwrap()).sum();
    assert_eq!(lost, 7, "{report:#}");
    let page = fs::read_to_string(street.at("late.html")).unwrap();
    assert_eq!(page.matches("data:image/jpeg;base64,").count(), 2);
    assert_eq!(page.matches("<svg").count(), 3);
    assert!(!page.contains("Lanes of the map"), "this log has no map");
    let is_alone = !page.contains("src=\"http") && !page.contains("href=");
    assert!(is_alone, "the page loads nothing");
}

#[test]
fn a_check_finds_a_mount_that_moves() {
    let street = street();
    street.generate("moving", &["--cameras", "left,right"]);
    let log = Log::open(&street.at("moving")).unwrap();
    // From the middle on, what the left camera sees is 6 px farther to the right in its images.
    for row in log.images().unwrap().unwrap() {
        let row = row.unwrap();
        if row.camera == "left" && row.time_us > 2_400_000 {
            let path = log.path(&row.file);
            let image = image::open(&path).unwrap().into_rgb8();
            let moved = |x: u32, y: u32| *image.get_pixel(x.saturating_sub(6), y);
            let moved = image::RgbImage::from_fn(image.width(), image.height(), moved);
            moved.save(path).unwrap();
        }
    }
    let report = street.report("moving");
    let drift = |camera: usize| report["alignment"][camera]["drift_px"].clone();
    let found_px = drift(0).as_f64().unwrap();
    assert!((found_px - 6.0).abs() <= 1.0, "{found_px}");
    assert_eq!(drift(1), Value::Null);
    let warnings = texts(&report, "warning").join("\n");
    assert!(warnings.contains("camera left: its images move by"), "{warnings}");
}

#[test]
fn a_check_names_what_is_wrong_with_a_damaged_log() {
    let street = street();
    let backwards = street.changed("backwards", "images.jsonl", |text| {
        let mut lines: Vec<&str> = text.lines().collect();
        lines.swap(10, 11);
        lines.join("\n")
    });
    let said = street.refused(&["log", "check", &backwards, "--out", "no.html"]);
    assert!(
        said.contains("images.jsonl line 12: time_us: ") && said.contains("is before"),
        "{said}"
    );
    assert!(!street.at("no.html").exists());

    let lost = street.changed("lost", "images.jsonl", |text| text.replace("left/", "lost/"));
    let output = street.run(&["log", "check", &lost, "--images", "1", "--out", "lost.html"]);
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8(output.stdout).unwrap();
    // Images and masks of the sky, of `left` and of `front_left`.
    let expected = "error: 196 files that rows name do not exist; the first is ";
    assert!(said.contains(expected) && said.contains("lost.html"), "{said}");
    assert!(
        String::from_utf8(output.stderr).unwrap().contains("a twin of this log would be wrong")
    );

    // Poses that begin a second later, and leap by 30 m in the middle.
    let leaping = street.changed("leaping", "poses.jsonl", |text| {
        let rows = text.lines().skip(100).enumerate().map(|(at, line)| {
            let mut row: Value = serde_json::from_str(line).unwrap();
            let x_m = row["world_from_rig"]["xyz"][0].as_f64().unwrap();
            row["world_from_rig"]["xyz"][0] = json!(if at < 200 { x_m } else { x_m + 30.0 });
            row.to_string() + "\n"
        });
        rows.collect()
    });
    let report = street.report(&leaping);
    let warnings = texts(&report, "warning").join("\n");
    assert!(warnings.contains("poses leap 1 times, first at 3.00 s"), "{warnings}");
    assert!(warnings.contains("camera rear: 10 of 49 images have no pose"), "{warnings}");
    assert!(warnings.contains("poses drift by 30.0 m against satellite fixes"), "{warnings}");
}

#[test]
fn the_memory_of_a_check_does_not_grow_with_the_images() {
    let street = street();
    let peaks = [2_000, 40_000].map(|images| {
        let name = format!("rows{images}");
        write_rows(&street.at(&name), images);
        let mut command = wildcity();
        command.args(["log", "check", &name, "--images", "2", "--out", "rows.html"]);
        command.current_dir(street.dir.path()).stdout(Stdio::null());
        let mut child = command.spawn().unwrap();
        let mut peak = 0;
        while child.try_wait().unwrap().is_none() {
            peak = peak_bytes(child.id()).unwrap_or(0).max(peak);
            std::thread::sleep(Duration::from_millis(2));
        }
        assert!(child.wait().unwrap().success());
        peak
    });
    let [few, many] = peaks;
    assert!(few > 5 << 20, "{few} bytes cannot be all");
    // 38,000 rows of 200 bytes in memory would be 8 MB and more; poses of 64 bytes are 4 MB.
    assert!(many < few + (8 << 20), "{few} and {many} bytes");
}

/// Highest resident memory of a process so far; `None` once it has ended.
fn peak_bytes(process: u32) -> Option<u64> {
    let status = fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib << 10)
}

/// A log of many rows that all name the files of the first ones of the log of the street.
fn write_rows(out: &Path, images: i64) {
    let log = out.with_file_name("log");
    fs::create_dir(out).unwrap();
    for file in ["log.json", "rig.json"] {
        fs::copy(log.join(file), out.join(file)).unwrap();
    }
    let first = |table: &str| -> Value {
        let text = fs::read_to_string(log.join(table)).unwrap();
        let mut row: Value = serde_json::from_str(text.lines().next().unwrap()).unwrap();
        row["file"] = format!("../log/{}", row["file"].as_str().unwrap()).into();
        row.as_object_mut().unwrap().remove("sky_mask");
        row
    };
    let write = |table: &str, count: i64, row: &dyn Fn(i64) -> Value| {
        let mut file = std::io::BufWriter::new(File::create(out.join(table)).unwrap());
        (0..count).for_each(|at| writeln!(file, "{}", row(at)).unwrap());
    };
    let [mut image, sweep] = ["images.jsonl", "lidar.jsonl"].map(first);
    let pose = json!({"xyz": [0, 0, 0], "q": [1, 0, 0, 0]});
    for (field, value) in [("exposure_us", json!(5000)), ("exposure_stops", json!(0.5))] {
        image[field] = value;
    }
    let timed = |row: &Value, times: &[(&str, i64)]| {
        let mut row = row.clone();
        times.iter().for_each(|(field, us)| row[*field] = json!(us));
        row
    };
    write("images.jsonl", images, &|at| timed(&image, &[("time_us", 16_000 * at)]));
    write("lidar.jsonl", images / 6, &|at| {
        timed(
            &sweep,
            &[
                ("time_us", 96_000 * at),
                ("until_us", 96_000 * at + 95_999),
                ("compensated_to_us", 96_000 * at),
            ],
        )
    });
    write("poses.jsonl", 2 * images, &|at| {
        let mut pose = pose.clone();
        pose["xyz"][0] = json!(at as f64 / 20.0);
        json!({"time_us": 8000 * at, "world_from_rig": pose})
    });
}
