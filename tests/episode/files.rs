//! Reading: whole, cut, damaged, and with what later builds add.

use std::fs;

use serde_json::json;
use wildcity_episode::{EpisodeFile, diff, drive_record, driven_indices, list};

use crate::written::{self, Made};

#[test]
fn all_lines_are_read() {
    let episode = Made::default().read();
    assert_eq!((episode.frames.len(), episode.actors.len()), (51, 51));
    assert_eq!(episode.scenario.as_ref().unwrap().actors[1].name, "car1");
    assert_eq!(episode.end.as_ref().unwrap().outcome, "completed");
    assert_eq!(episode.cut, None);
    let state = episode.actors[50].actors[1].state().unwrap();
    assert_eq!(state.index, 1);
    assert!(state.world_from_actor.position_m.x > 8.1, "{state:?}");
}

#[test]
fn a_file_cut_anywhere_is_readable_up_to_the_cut() {
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole-1.jsonl");
    written::write(&whole, &Made { steps: 5, ..Made::default() }.lines());
    let bytes = fs::read(&whole).unwrap();
    let head = bytes.iter().position(|&byte| byte == b'\n').unwrap() + 1;
    let cut = dir.path().join("cut-1.jsonl");
    let mut most = 0;
    // Every place of the last lines, and every eleventh of the others.
    let last = bytes.len() - 900;
    for length in (head..last).step_by(11).chain(last..bytes.len()) {
        fs::write(&cut, &bytes[..length]).unwrap();
        let read = EpisodeFile::read(&cut).unwrap();
        let whole_lines = bytes[..length].iter().filter(|&&byte| byte == b'\n').count();
        let lines_read = 1
            + usize::from(read.scenario.is_some())
            + read.actors.len()
            + read.frames.len()
            + usize::from(read.end.is_some());
        assert_eq!(lines_read, whole_lines, "after {length} bytes");
        let is_between_lines = bytes[length - 1] == b'\n';
        assert_eq!(read.cut.is_none(), is_between_lines, "after {length} bytes");
        most = most.max(lines_read);
    }
    assert_eq!(most, 14);
    for length in (0..head).step_by(5) {
        fs::write(&cut, &bytes[..length]).unwrap();
        let error = EpisodeFile::read(&cut).unwrap_err().to_string();
        assert!(error.contains("no header"), "{length}: {error}");
    }
}

#[test]
fn a_damaged_line_ends_the_reading_and_is_named() {
    let mut lines = Made { steps: 3, ..Made::default() }.lines();
    lines[6]["kind"] = json!("frame");
    let read = written::read(&lines);
    let cut = read.cut.unwrap();
    assert_eq!((cut.line, read.frames.len()), (7, 2));
    assert!(cut.reason.contains("missing field"), "{}", cut.reason);
    let mut lines = Made { steps: 3, ..Made::default() }.lines();
    lines.push(lines[3].clone());
    let cut = written::read(&lines).cut.unwrap();
    assert!(cut.reason.contains("follows the end"), "{}", cut.reason);
}

#[test]
fn actors_that_the_scenario_does_not_have_end_the_reading() {
    let made = Made { steps: 3, ..Made::default() };
    type Change = fn(&mut Vec<serde_json::Value>);
    let changes: [(Change, &str); 4] = [
        (|lines| lines[6]["actors"][1][0] = json!(2), "actor 2, but the scenario has 2 actors"),
        (|lines| lines[6]["actors"][0][0] = json!(1), "actor 1 follows actor 1"),
        (|lines| lines[6]["actors"][0][2] = json!([0.5, 0, 0, 0]), "actor 0: "),
        (
            |lines| {
                lines[6] = json!({ "kind": "event", "step": 2, "time_us": 200_000, "event": "left", "actor": 9 });
            },
            "actor 9, but",
        ),
    ];
    for (change, reason) in changes {
        let mut lines = made.lines();
        change(&mut lines);
        let read = written::read(&lines);
        let cut = read.cut.unwrap();
        assert_eq!((cut.line, read.actors.len(), read.frames.len()), (7, 2, 2), "{reason}");
        assert!(cut.reason.contains(reason), "{}", cut.reason);
    }
}

#[test]
fn what_later_builds_add_is_passed_over() {
    let mut lines = Made { steps: 3, ..Made::default() }.lines();
    lines[0]["origin"] = json!({ "episode": "other-1" });
    lines.insert(4, json!({ "kind": "note", "text": "hello" }));
    let read = written::read(&lines);
    assert_eq!((read.cut, read.frames.len()), (None, 4));
    lines[0]["format"] = json!(1);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("new-1.jsonl");
    written::write(&path, &lines);
    let error = EpisodeFile::read(&path).unwrap_err().to_string();
    assert!(error.contains("format 1; this build reads 0"), "{error}");
}

#[test]
fn a_step_that_was_taken_again_counts_once() {
    let mut lines = Made { steps: 3, ..Made::default() }.lines();
    // Back to step 1 and on from there: lines are header, scenario, then actors and frame of each
    // step.
    let again = lines[6..8].to_vec();
    lines.splice(10..10, again);
    let read = written::read(&lines);
    let steps: Vec<u64> = read.driven().iter().map(|frame| frame.step).collect();
    assert_eq!(steps, [0, 1, 2]);
}

#[test]
fn two_hundred_steps_with_thirty_actors_stay_below_a_megabyte() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("many-1.jsonl");
    written::write(&path, &Made { steps: 200, actors: 30, ..Made::default() }.lines());
    let bytes = fs::metadata(&path).unwrap().len();
    assert!(bytes < 1_000_000, "{bytes} bytes");
    // Plans have all their digits, since a replay needs them: docs/suites.md has the figures.
    let with_plans = dir.path().join("plans-1.jsonl");
    let made = Made { steps: 200, actors: 30, plan_poses: 64, ..Made::default() };
    written::write(&with_plans, &made.lines());
    let plans_bytes = fs::metadata(&with_plans).unwrap().len() - bytes;
    assert!(plans_bytes < 1_600_000, "{plans_bytes} bytes of plans");
    eprintln!("{bytes} bytes, and {plans_bytes} of plans");
    assert_eq!(EpisodeFile::read(&path).unwrap().actors.len(), 201);
}

#[test]
fn a_directory_is_listed_newest_first() {
    let dir = tempfile::tempdir().unwrap();
    assert_eq!(list(&dir.path().join("nowhere")).unwrap(), []);
    for name in ["a-1.jsonl", "b-1.jsonl", "notes.txt"] {
        written::write(&dir.path().join(name), &Made::default().lines());
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    let listed = list(dir.path()).unwrap();
    let names: Vec<&str> = listed.iter().map(|listed| listed.name.as_str()).collect();
    assert_eq!(names, ["b-1", "a-1"]);
    assert!(listed[0].bytes > 1000);
}

#[test]
fn what_a_session_undid_did_not_happen() {
    let lines = Made { steps: 5, ..Made::default() }.lines();
    let left = |step: u64| {
        let time_us = 100_000 * step;
        json!({ "kind": "event", "step": step, "time_us": time_us, "event": "left", "actor": 1 })
    };
    let is_frame =
        |line: &serde_json::Value, step: u64| line["kind"] == "frame" && line["step"] == step;
    let at = |step: u64| lines.iter().position(|line| is_frame(line, step)).unwrap();
    let mut went_back = lines.clone();
    // Both events are before the frames of their steps; then the session goes back to step 2.
    went_back.insert(at(4), left(4));
    went_back.insert(at(1), left(1));
    let end = went_back.pop().unwrap();
    let whole = written::read(&went_back);
    assert_eq!(
        whole.events.iter().map(|event| event.time_us).collect::<Vec<_>>(),
        [100_000, 400_000]
    );
    went_back.extend([lines[at(2)].clone(), end]);
    let read = written::read(&went_back);
    assert_eq!(read.cut, None);
    assert_eq!(read.events.iter().map(|event| event.time_us).collect::<Vec<_>>(), [100_000]);
}

#[test]
fn a_record_without_a_step_time_is_no_record() {
    let mut lines = Made { steps: 3, ..Made::default() }.lines();
    lines[0]["dt_us"] = json!(0);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("still-1.jsonl");
    written::write(&path, &lines);
    let error = EpisodeFile::read(&path).unwrap_err().to_string();
    assert!(error.contains("dt_us is 0"), "{error}");
}

#[test]
fn the_first_line_is_read_alone() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a-1.jsonl");
    written::write(&path, &Made::default().lines());
    let whole = EpisodeFile::read(&path).unwrap();
    assert_eq!(EpisodeFile::header(&path).unwrap(), whole.header);
    // What follows it does not matter.
    let text = fs::read_to_string(&path).unwrap();
    let first = text.lines().next().unwrap();
    fs::write(&path, format!("{first}\n{{ this is no line")).unwrap();
    assert_eq!(EpisodeFile::header(&path).unwrap(), whole.header);
    fs::write(&path, first).unwrap();
    let error = EpisodeFile::header(&path).unwrap_err().to_string();
    assert!(error.contains("no header") && error.contains("incomplete"), "{error}");
    let missing = EpisodeFile::header(&dir.path().join("b-1.jsonl")).unwrap_err().to_string();
    assert!(missing.contains("cannot read"), "{missing}");
}

#[test]
fn later_frames_of_a_step_replace_the_earlier_ones() {
    let steps = [Some(0), Some(1), None, Some(2), Some(3), Some(1), Some(2), None];
    assert_eq!(driven_indices(steps), [0, 5, 6]);
    assert_eq!(driven_indices([None, None]), Vec::<usize>::new());
}

#[test]
fn an_mcap_file_is_refused_with_the_name_of_its_record() {
    let dir = tempfile::tempdir().unwrap();
    let record = dir.path().join("a-1.jsonl");
    written::write(&record, &Made::default().lines());
    let mcap = dir.path().join("a-1.mcap");
    wildcity_episode::export_file(&record, &mcap).unwrap();
    let error = EpisodeFile::read(&mcap).unwrap_err().to_string();
    assert!(error.contains("a-1.mcap is an MCAP export"), "{error}");
    assert!(error.ends_with("a-1.jsonl"), "{error}");
}

/// Earlier builds wrote a name for each field of a plan's poses.
#[test]
fn plans_with_named_fields_are_read_as_the_same() {
    let made = Made { steps: 5, plan_poses: 4, ..Made::default() };
    let now = made.read();
    let mut lines = made.lines();
    let named = |row: &serde_json::Value| {
        let pose = json!({ "xyz": row[1], "q": row[2] });
        json!({ "time_us": row[0], "start_from_rig": pose })
    };
    let frames = lines.iter_mut().filter(|line| line["command"]["trajectory"].is_array());
    let mut changed = 0;
    for line in frames {
        let rows = line["command"]["trajectory"].as_array().unwrap();
        line["command"]["trajectory"] = rows.iter().map(named).collect();
        changed += 1;
    }
    let before = written::read(&lines);
    assert_eq!((changed, before.cut.clone()), (5, None));
    assert_eq!(before.frames[3].plan().unwrap().len(), 4);
    assert_eq!(before.frames[3].plan(), now.frames[3].plan());
    assert_eq!(drive_record(&before), drive_record(&now));
    assert_eq!(diff(&before, &now), None);
}
