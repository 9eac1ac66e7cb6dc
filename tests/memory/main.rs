//! What importing and serving take: one test, alone in its process, so that the numbers are its
//! own.

#[path = "../support/scene_files.rs"]
mod scene_files;

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use glam::{DQuat, DVec3};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::RenderProfile;
use wildcity_scene::chunk::column;
use wildcity_scene::geometry::camera::{Fisheye, Lens, Pinhole};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_twin::residency::{Cache, Viewpoint};
use wildcity_twin::store::Catalog;

use scene_files::{gaussians, inria_columns, ply, ply_header};

/// The program itself, buffers and thread stacks.
const CONSTANT_BYTES: u64 = 30 << 20;

#[test]
fn import_takes_twice_the_file_and_serving_120_bytes_a_gaussian() {
    let dir = tempfile::tempdir().unwrap();
    let twins = dir.path().join("twins");
    // Degree 0 is the worst for the import: f64 centres and sort keys against 56 bytes of a row.
    // A dense capture lies in one block, of which all levels are made at once.
    let cells = Rows { middle_m: 0.0, reach_m: 30.0, step_m: 64.0 };
    let block = Rows { middle_m: 8.0, reach_m: 7.0, step_m: 1e-4 };
    for (name, sh_degree, n, rows, most_times) in [
        ("degree0", 0, 1_800_000, cells, 2.0),
        ("dense", 0, 1_200_000, block, 2.5),
        ("degree1", 1, 600_000, cells, 2.0),
    ] {
        let source = dir.path().join("scene.ply");
        write_ply(&source, sh_degree, n, rows);
        let file_bytes = fs::metadata(&source).unwrap().len();
        let peak = import_peak_bytes(&source, name, &twins);
        let times = peak as f64 / file_bytes as f64;
        assert!(peak > file_bytes, "{peak} of {file_bytes}: this cannot be the whole import");
        let allowed = (most_times * file_bytes as f64) as u64 + CONSTANT_BYTES;
        assert!(peak <= allowed, "{name}: {peak} bytes, {times:.2} x file");
    }

    // Compressed to 16 bytes, a Gaussian takes what it takes from a row of 56.
    let n = 1_000_000;
    let source = dir.path().join("scene.compressed.ply");
    write_compressed_ply(&source, n);
    let peak = import_peak_bytes(&source, "compressed", &twins);
    let plain_bytes = 56 * n as u64;
    assert!(peak > plain_bytes, "{peak} of {plain_bytes}: this cannot be the whole import");
    assert!(peak <= 2 * plain_bytes + CONSTANT_BYTES, "compressed import: {peak} bytes");

    a_section_that_is_read_part_by_part_takes_the_memory_of_one(&Catalog::open(&twins).unwrap());

    let n = 600_000;
    let cache = Cache::new(Catalog::open(&twins).unwrap());
    let before = status_bytes("self", "VmRSS").unwrap();
    let resident = cache.open("degree1", None).unwrap();
    // What a frame of all of it in full detail draws, and no other level.
    let eye = Viewpoint { position_m: DVec3::ZERO, focal_px: 1000.0 };
    let everything = RenderProfile { tau_px: 0.0, reach_m: None, ..RenderProfile::default() };
    let scene = resident.scene(&[eye], &everything).unwrap();
    assert!(scene.gaussians() == n && scene.bytes() >= 92 * n);
    let peak = status_bytes("self", "VmHWM").unwrap();
    // While loading, one part of a section per thread.
    let allowed = before + 120 * n as u64 + CONSTANT_BYTES;
    assert!(peak <= allowed, "loading: from {before} to {peak} bytes, {allowed} allowed");
    assert!(peak - before >= 92 * n as u64, "the chunks are in memory");

    // A frame of all of it through wide lenses: as much as the backend says, if it may have 48 MiB.
    // At once its splats take 200 MiB.
    let backend = Cpu::new(2, Simd::Best).unwrap();
    backend.limit_frame_bytes(48 << 20);
    let views = views();
    let mut images: Vec<Vec<u8>> =
        views.iter().map(|view| vec![1; 3 * view.camera.pixels()]).collect();
    let mut draw = |views: &[View]| {
        let target = |rgb8| Target { rgb8: Some(rgb8), ..Target::default() };
        let mut targets: Vec<_> = images.iter_mut().map(|image| target(&mut image[..])).collect();
        let frame = Frame { scene: &scene, profile: &everything, views };
        backend.render(&frame, &mut targets[..views.len()], &|_, _| {}).unwrap();
    };
    let before = status_bytes("self", "VmRSS").unwrap();
    // Resets the peak.
    fs::write("/proc/self/clear_refs", "5").unwrap();
    for _ in 0..3 {
        draw(&views);
    }
    let taken = status_bytes("self", "VmHWM").unwrap() - before;
    let allowed = backend.frame_bytes(&views, &everything) + CONSTANT_BYTES;
    assert!(taken <= allowed, "frames: {taken} bytes, {allowed} allowed");
    assert!(taken > 16 << 20, "frames: {taken} bytes cannot be all");
}

/// As contacts read the full detail of a dense capture: its 1.2 million Gaussians in parts.
fn a_section_that_is_read_part_by_part_takes_the_memory_of_one(catalog: &Catalog) {
    let version = catalog.version("dense", None).unwrap();
    let full = version.manifest.chunks.iter().flat_map(|chunk| {
        let sections = chunk.sections.iter().filter(|section| section.is_full_detail());
        sections.map(move |section| (chunk, section))
    });
    let (chunk, section) = full.max_by_key(|(_, section)| section.count).unwrap();
    assert!(section.count > 1_000_000, "{} Gaussians", section.count);
    let before = status_bytes("self", "VmRSS").unwrap();
    fs::write("/proc/self/clear_refs", "5").unwrap();
    let mut means_m = Vec::with_capacity(3 * section.count as usize);
    let mut parts = 0;
    catalog
        .visit_parts(&version, chunk, section, &mut |part| {
            parts += 1;
            let mean = |k| [0, 1, 2].map(|axis| part.value(k, column::MEAN + axis));
            means_m.extend((0..part.len()).flat_map(mean));
        })
        .unwrap();
    let taken = status_bytes("self", "VmHWM").unwrap() - before;
    // The bytes as stored, the means, and one part of 65,536 Gaussians in 60 bytes and as stored.
    let expected = u64::from(section.bytes) + 4 * means_m.len() as u64 + (6 << 20);
    assert!(parts > 15, "{parts} parts");
    assert!(taken < expected + (4 << 20), "{taken} bytes, expected {expected}");
    let whole = catalog.section(&version, chunk, section).unwrap();
    let mean = |k| [0, 1, 2].map(|axis| whole.value(k, column::MEAN + axis));
    assert!((0..whole.len()).flat_map(mean).eq(means_m), "the same Gaussians in the same order");
}

/// Four cameras, with a lens and without, that see most of the scene, along its length.
fn views() -> Vec<View> {
    let camera =
        Camera::from_pinhole(480, 300, Pinhole { fx: 200.0, fy: 200.0, cx: 240.0, cy: 150.0 });
    let lens = Lens::Fisheye(Fisheye::new([-0.03, -0.005, -0.0008, 0.001], None));
    let rotation = DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2);
    let at = |x: f64| Pose { position_m: DVec3::new(x, 0.0, 0.0), rotation };
    [-60.0, -90.0]
        .into_iter()
        .flat_map(|x| [View::new(camera, at(x)), View::new(Camera { lens, ..camera }, at(x))])
        .collect()
}

/// Where the rows of a large file lie.
#[derive(Clone, Copy)]
struct Rows {
    /// Middle of the first rows along x and y, and how far they reach from it.
    middle_m: f64,
    reach_m: f64,
    /// How far the next ones are shifted.
    step_m: f64,
}

/// Writes a large file of a small one's rows, shifted each time, without holding it: this process'
/// own peak counts, too.
fn write_ply(path: &Path, sh_degree: u8, n: usize, rows: Rows) {
    let few = 20_000;
    let columns = inria_columns(sh_degree, false);
    let mut scene = gaussians(few, sh_degree, rows.reach_m, 1);
    for mean in &mut scene.means_m {
        mean[0] += rows.middle_m;
        mean[1] += rows.middle_m;
    }
    let mut out = BufWriter::new(File::create(path).unwrap());
    out.write_all(ply_header(n, &columns).as_bytes()).unwrap();
    let header_bytes = ply_header(few, &columns).len();
    for _ in 0..n / few {
        out.write_all(&ply(&scene, &columns)[header_bytes..]).unwrap();
        for mean in &mut scene.means_m {
            mean[0] += rows.step_m;
        }
    }
    out.into_inner().unwrap().sync_all().unwrap();
}

/// Writes a compressed PLY of chunks that are alike, 10 m apart.
fn write_compressed_ply(path: &Path, n: usize) {
    let fields = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    header += &format!("element chunk {}\n", n.div_ceil(256));
    for end in ["min", "max"] {
        header += &fields.map(|field| format!("property float {end}_{field}\n")).concat();
    }
    header += &format!("element vertex {n}\n");
    for field in ["position", "rotation", "scale", "color"] {
        header += &format!("property uint packed_{field}\n");
    }
    header += "end_header\n";
    let mut out = BufWriter::new(File::create(path).unwrap());
    out.write_all(header.as_bytes()).unwrap();
    for chunk in 0..n.div_ceil(256) {
        let x = 10.0 * (chunk % 100) as f32;
        let low = [x, 0.0, 0.0, -6.0, -6.0, -6.0, 0.0, 0.0, 0.0];
        let high = [x + 10.0, 10.0, 5.0, -2.0, -2.0, -2.0, 1.0, 1.0, 1.0];
        for value in [low, high].concat() {
            out.write_all(&value.to_le_bytes()).unwrap();
        }
    }
    for index in 0..n as u32 {
        let mixed = index.wrapping_mul(0x9E37_79B9);
        // All but the largest component of the rotation are in the middle of their range: zero.
        for word in [mixed, 0x2008_0200, mixed.rotate_left(7), mixed.rotate_left(15)] {
            out.write_all(&word.to_le_bytes()).unwrap();
        }
    }
    out.into_inner().unwrap().sync_all().unwrap();
}

fn import_peak_bytes(source: &Path, twin: &str, twins: &Path) -> u64 {
    let import = Command::new(env!("CARGO_BIN_EXE_wildcity"))
        .arg("import")
        .arg(source)
        .args(["--twin", twin, "--twins"])
        .arg(twins)
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    peak_bytes(import)
}

/// Highest resident memory that a child was seen with before it ended well.
fn peak_bytes(mut child: Child) -> u64 {
    let mut peak = 0;
    while child.try_wait().unwrap().is_none() {
        peak = status_bytes(&child.id().to_string(), "VmHWM").unwrap_or(0).max(peak);
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(child.wait().unwrap().success());
    peak
}

/// A size of /proc/<pid>/status; none once the process has ended.
fn status_bytes(process: &str, field: &str) -> Option<u64> {
    let status = fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find(|line| line.starts_with(field))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib << 10)
}
