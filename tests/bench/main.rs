//! The program `wildcity-bench`: what it prints, not how fast it is.

#[path = "../support/city.rs"]
mod city;
#[path = "../support/gpu.rs"]
mod gpu;
#[path = "../support/images.rs"]
mod images;
#[path = "../support/scene_files.rs"]
mod scene_files;
#[path = "../support/streets.rs"]
mod streets;
#[path = "../support/versions.rs"]
mod versions;

mod actors;
mod drive;
mod gpu_report;
mod soak;
mod step;

use std::process::Command;
use std::sync::LazyLock;

use city::{City, city};

/// The twin "city", of a kilometre and 300 m more.
static CITY: LazyLock<City> = LazyLock::new(|| city(1_300.0));

fn bench(subcommand: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity-bench"));
    command.arg(subcommand);
    command
}
