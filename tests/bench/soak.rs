//! `wildcity-bench soak` of some seconds.

use std::fs;
use std::process::Output;

use crate::{CITY, bench};

fn soak(arguments: &[&str]) -> Output {
    let mut command = bench("soak");
    command.args(["city", "--backend", "cpu", "--sessions", "3", "--steps", "4"]);
    // Room for the full cameras of a client that does not read, whose views have levels of their own.
    command.args(["--memory-gib", "0.25", "--threads", "1", "--twins"]).arg(CITY.dir.path());
    command.args(arguments).output().unwrap()
}

#[test]
fn a_soak_repeats_rounds_and_compares_their_images() {
    let output = soak(&["--minutes", "0.05", "--growth", "1000"]);
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    let line = text.lines().find(|line| line.contains(" steps in ")).unwrap();
    let rounds = line.split(" steps in ").nth(1).and_then(|rest| rest.split(' ').next());
    assert!(rounds.unwrap().parse::<u32>().unwrap() > 3, "no session drove a second round: {line}");
    assert!(line.contains("every image as in its first round"), "{line}");
    let polls =
        text.lines().last().and_then(|line| line.split_once(" polls of the server's tasks"));
    assert!(polls.unwrap().0.parse::<u64>().unwrap() > 100, "{text}");
}

#[test]
fn a_mixed_soak_pushes_to_a_copy() {
    let twin = CITY.dir.path().join("city");
    let versions = || fs::read_dir(twin.join("log")).unwrap().count();
    let before = versions();
    let output = soak(&["--mixed", "--minutes", "0.05", "--growth", "1000"]);
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    let others = text.lines().find(|line| line.contains(" pushes, each with garbage collection; "));
    let numbers = others.unwrap().split("; ").map(|part| part.split(' ').next().unwrap());
    let numbers: Vec<u32> = numbers.map(|number| number.parse().unwrap()).collect();
    assert!(numbers.len() == 3 && numbers.iter().all(|&number| number > 0), "{text}");
    assert_eq!(versions(), before, "the soak pushed to the user's twin");
}

#[test]
fn a_soak_whose_memory_grows_fails() {
    // The largest later memory may be less than the first, but not a hundredth of it.
    let output = soak(&["--minutes", "0.03", "--growth=-99"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.contains("memory grew by"), "{text}");
}
