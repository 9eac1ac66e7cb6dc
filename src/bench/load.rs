//! `wildcity-bench load`.

use std::fs;
use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::Instant;

use anyhow::Context;

use wildcity::cli::directories::{TwinVersion, Twins};
use wildcity::cli::progress;
use wildcity_scene::manifest::{ChunkEntry, Section};
use wildcity_twin::ingest;
use wildcity_twin::store::{Catalog, Version};

/// Measure how fast a twin is read: every section is checked against its hash and decoded.
///
/// For comparison, the bytes are also read without checks and decoding ("bare bytes"). Sections of
/// a twin in an object store are read through the disk cache, unless --cache-gib is 0. With --cold,
/// the system's page cache is emptied before each reading, which needs root. Without --cold,
/// everything is read once beforehand, so that the times do not include the disk.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Load {
    /// The twin: NAME, or NAME@NUMBER for an older version.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    #[command(flatten)]
    twins: Twins,

    /// A scene file with the same Gaussians, which is read and checked as by `wildcity import`.
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,

    /// Threads that read sections [default: one per core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,

    /// Readings of each kind; the median is printed.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeat: u32,

    /// Empty the system's page cache before each reading (needs root).
    #[arg(long)]
    cold: bool,
}

const EXAMPLES: &str = "\
Examples:
  wildcity-bench load street --file street.ply
  sudo wildcity-bench load street --cold --twins ./twins";

/// One line of the result: the data that was read, and its speed.
struct Line {
    what: String,
    bytes: u64,
    gaussians: u64,
    seconds: f64,
}

impl Load {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let version = catalog.version(&self.twin.name, self.twin.number)?;
        let sections: Vec<(&ChunkEntry, &Section)> = version
            .manifest
            .chunks
            .iter()
            .flat_map(|chunk| chunk.sections.iter().map(move |section| (chunk, section)))
            .collect();
        let gaussians = sections.iter().map(|(_, section)| u64::from(section.count)).sum();
        let bytes = version.manifest.chunks.iter().map(|chunk| chunk.bytes).sum();
        let cores = thread::available_parallelism()?.get();
        let bar = progress::count("reading");
        let kinds = if self.file.is_some() { 4 } else { 3 };
        bar.set_length(kinds);
        // First, because the other lines are compared with it.
        let mut lines = vec![Line {
            what: "bare bytes".into(),
            bytes,
            gaussians,
            seconds: self.time(|| read_bare(&catalog, &version))?,
        }];
        bar.inc(1);
        for threads in [1, self.threads.map_or(cores, |threads| threads as usize)] {
            lines.push(Line {
                what: format!("sections, {threads} threads"),
                bytes,
                gaussians,
                seconds: self.time(|| read_decoded(&catalog, &version, &sections, threads))?,
            });
            bar.inc(1);
        }
        if let Some(file) = &self.file {
            let bytes = fs::metadata(file).with_context(|| file.display().to_string())?.len();
            let mut gaussians = 0;
            let seconds = self.time(|| {
                gaussians = ingest::read(file, &mut |_, _| {})?.len() as u64;
                Ok(())
            })?;
            lines.push(Line { what: "scene file".into(), bytes, gaussians, seconds });
        }
        bar.finish_and_clear();
        print(&mut io::stdout().lock(), &lines)?;
        Ok(())
    }

    /// Median time of reading, in seconds.
    fn time(&self, mut read: impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<f64> {
        // Fills the page cache, so that every timed reading finds the same state.
        if !self.cold {
            read()?;
        }
        let mut seconds = Vec::new();
        for _ in 0..self.repeat {
            if self.cold {
                fs::write("/proc/sys/vm/drop_caches", "3")
                    .context("--cold: cannot empty the page cache; run as root, or omit --cold")?;
            }
            let start = Instant::now();
            read()?;
            seconds.push(start.elapsed().as_secs_f64());
        }
        seconds.sort_by(f64::total_cmp);
        Ok(seconds[seconds.len() / 2])
    }
}

/// Reads the bytes of all chunks of a version, one after the other, without decoding them.
fn read_bare(catalog: &Catalog, version: &Version) -> anyhow::Result<()> {
    for chunk in &version.manifest.chunks {
        catalog.read_and_discard(version, chunk)?;
    }
    Ok(())
}

/// Reads and decodes all sections of a version on several threads.
fn read_decoded(
    catalog: &Catalog,
    version: &Version,
    sections: &[(&ChunkEntry, &Section)],
    threads: usize,
) -> anyhow::Result<()> {
    let next = AtomicUsize::new(0);
    let read = || -> anyhow::Result<()> {
        // One counter for all threads: sections differ in size, and equal shares would end at
        // different times. Relaxed, because the number carries no other data.
        while let Some((chunk, section)) = sections.get(next.fetch_add(1, Ordering::Relaxed)) {
            std::hint::black_box(catalog.section(version, chunk, section)?);
        }
        Ok(())
    };
    thread::scope(|scope| {
        let readers: Vec<_> = (0..threads).map(|_| scope.spawn(read)).collect();
        readers.into_iter().try_for_each(|reader| match reader.join() {
            Ok(read) => read,
            Err(_) => anyhow::bail!("a thread that read sections panicked"),
        })
    })
}

fn print(out: &mut impl Write, lines: &[Line]) -> io::Result<()> {
    for line in lines {
        let Line { what, bytes, gaussians, seconds } = line;
        writeln!(
            out,
            "{what:<22} {:>9.1} ms  {:>8.1} MB  {:>8.0} MB/s  {gaussians:>10} Gaussians  {:>7.2} M/s  \
             {:>6.2} of bare speed",
            1e3 * seconds,
            *bytes as f64 / 1e6,
            *bytes as f64 / 1e6 / seconds,
            *gaussians as f64 / seconds / 1e6,
            lines[0].seconds / seconds,
        )?;
    }
    Ok(())
}
