//! `wildcity log show`.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;

use wildcity_log::{Log, LogError, Row, Rows};

use crate::cli::output::{self, counted};

/// Print what a log has: its source, and of each table the rows, their times and their rate.
///
/// Reads every row of every table once, and refuses the first one that is not valid. It opens no
/// image and no sweep: `wildcity log check` does.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Example:
  wildcity log show log")]
pub(super) struct Show {
    /// Folder of the log.
    #[arg(value_name = "LOG")]
    log: PathBuf,
}

/// The rows of a table, or of one camera, LiDAR or track of it.
#[derive(Clone, Copy, Debug, Default)]
struct Count {
    rows: usize,
    span_us: Option<[i64; 2]>,
}

impl Count {
    fn add(&mut self, time_us: i64) {
        self.rows += 1;
        let first_us = self.span_us.map_or(time_us, |[first_us, _]| first_us);
        self.span_us = Some([first_us, time_us]);
    }

    /// `30 rows, 0.0 to 2.9 s, 10.0 Hz`.
    fn text(&self) -> String {
        let rows = counted(self.rows, "row");
        let Some([first_us, last_us]) = self.span_us else { return rows };
        let [first_s, last_s] = [first_us, last_us].map(|us| us as f64 / 1e6);
        // There is one period less than rows.
        let steps = self.rows.saturating_sub(1) as f64;
        // All rows of a table may have one time, such as those of several cameras.
        let rate = if last_s > first_s {
            format!(", {:.1} Hz", steps / (last_s - first_s))
        } else {
            String::new()
        };
        format!("{rows}, {first_s:.1} to {last_s:.1} s{rate}")
    }
}

impl Show {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let log = Log::open(&self.log)?;
        let mut out = output::stdout();
        let header = &log.header;
        let source = &header.source;
        writeln!(out, "{}: {} {}, by {}", header.name, source.kind, source.id, source.converter)?;
        writeln!(out, "licence: {}", source.licence)?;
        let geo = header.world.geo.as_ref().map(serde_json::to_string).transpose()?;
        writeln!(out, "place on the earth: {}", geo.as_deref().unwrap_or("not known"))?;
        let cameras = counted(log.rig.cameras.len(), "camera");
        writeln!(
            out,
            "rig {}: {cameras}, {}",
            log.rig.name,
            counted(header.lidars.len(), "LiDAR")
        )?;
        print_table(&mut out, "poses", Some(log.pose_rows()?), false)?;
        print_table(&mut out, "images", log.images()?, true)?;
        print_table(&mut out, "lidar", log.sweeps()?, true)?;
        print_table(&mut out, "tracks", log.tracks()?, false)?;
        print_table(&mut out, "imu", log.imu()?, false)?;
        print_table(&mut out, "gps", log.gps()?, false)?;
        let map = log.map()?;
        let lanes = map.map_or("none".to_owned(), |map| counted(map.lanes.len(), "lane"));
        writeln!(out, "map: {lanes}")?;
        for sentence in &header.left_out {
            writeln!(out, "left out: {sentence}")?;
        }
        Ok(())
    }
}

/// Prints the rows of a table, and with `by_key` those of each camera or LiDAR.
fn print_table<R: Row>(
    out: &mut impl Write,
    name: &str,
    rows: Option<Rows<R>>,
    by_key: bool,
) -> anyhow::Result<()> {
    let Some(rows) = rows else {
        writeln!(out, "{name}: none")?;
        return Ok(());
    };
    let (all, keys) = count(rows)?;
    let things = if keys.is_empty() { String::new() } else { format!(" of {}", keys.len()) };
    writeln!(out, "{name}{things}: {}", all.text())?;
    for (key, count) in keys.iter().filter(|_| by_key) {
        writeln!(out, "  {key}: {}", count.text())?;
    }
    Ok(())
}

fn count<R: Row>(rows: Rows<R>) -> Result<(Count, BTreeMap<String, Count>), LogError> {
    let mut all = Count::default();
    let mut keys: BTreeMap<String, Count> = BTreeMap::new();
    for row in rows {
        let row = row?;
        all.add(row.time_us());
        let Some(key) = row.key() else { continue };
        match keys.get_mut(key) {
            Some(count) => count.add(row.time_us()),
            None => keys.entry(key.to_owned()).or_default().add(row.time_us()),
        }
    }
    Ok((all, keys))
}
