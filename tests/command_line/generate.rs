//! `wildcity twin generate`.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use wildcity_twin::store::Catalog;

#[test]
fn memory_does_not_grow_with_the_route() {
    let dir = tempfile::tempdir().unwrap();
    let [one, three] = ["1", "3"].map(|km| peak_bytes(km, dir.path()));
    // A longer route may have denser parts, but holding all Gaussians of 2 km more, at 104 bytes
    // each, would take 210 MB.
    assert!(three < one + (50 << 20), "{one} bytes at 1 km, {three} at 3 km");

    let version = Catalog::open(dir.path()).unwrap().version("km3", None).unwrap();
    assert!(version.manifest.gaussians() > 2_700_000, "{}", version.manifest.gaussians());
    assert!((version.manifest.trajectories[0].length_m() - 2_984.0).abs() < 10.0);
}

/// Peak memory of generating a city of this length, in bytes.
fn peak_bytes(km: &str, twins: &Path) -> u64 {
    let mut child = Command::new(env!("CARGO_BIN_EXE_wildcity"))
        .args(["twin", "generate", "--twin", &format!("km{km}"), "--length-km", km])
        .args(["--density", "1", "--twins"])
        .arg(twins)
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    // The kernel's high-water mark: it is enough to read it once near the end.
    let mut peak = 0;
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        let status = fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kib = line.and_then(|line| line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
        peak = peak.max(kib.unwrap_or(0) << 10);
        std::thread::sleep(Duration::from_millis(5));
    };
    assert!(status.success(), "{status}");
    assert!(peak > 0);
    peak
}
