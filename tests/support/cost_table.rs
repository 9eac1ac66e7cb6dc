//! Tables of what one message or request of a client may cost, and their page.

use std::time::Duration;

/// The most that one message or request may cost.
pub(crate) struct Cost {
    /// Type of the message, method and path of the route, or method of the service.
    pub(crate) of: &'static str,
    /// Bytes of memory, in addition to what its session or the server has reserved before.
    pub(crate) memory_bytes: u64,
    /// Longest time of a processor.
    pub(crate) time: Duration,
    /// Bytes that are written to the disk.
    pub(crate) disk_bytes: u64,
    /// What bounds it, in a few words.
    pub(crate) why: &'static str,
}

pub(crate) const fn cost(
    of: &'static str,
    memory_bytes: u64,
    time: Duration,
    disk_bytes: u64,
    why: &'static str,
) -> Cost {
    Cost { of, memory_bytes, time, disk_bytes, why }
}

/// A page of the documentation.
pub(crate) struct Page {
    /// File of the tables.
    pub(crate) from: &'static str,
    /// Arguments of the `cargo test` that writes the page.
    pub(crate) test: &'static str,
    pub(crate) title: &'static str,
    pub(crate) introduction: &'static str,
    /// Titles and rows; a table without a title has none.
    pub(crate) tables: Vec<(&'static str, &'static [Cost])>,
}

impl Page {
    pub(crate) fn text(&self) -> String {
        let Self { from, test, title, introduction, tables } = self;
        let mut text = format!(
            "<!-- Generated from {from}: WILDCITY_BLESS=1 cargo test {test} -->\n\n# {title}\n\n{introduction}\n"
        );
        for (title, costs) in tables {
            if !title.is_empty() {
                text.push_str(&format!("\n## {title}\n"));
            }
            text.push_str(
                "\n| of | memory, MiB | time, s | disk, MiB | bound by |\n|---|---|---|---|---|\n",
            );
            for Cost { of, memory_bytes, time, disk_bytes, why } in *costs {
                let [memory, disk] = [*memory_bytes, *disk_bytes].map(mib);
                let seconds = time.as_secs();
                text.push_str(&format!("| `{of}` | {memory} | {seconds} | {disk} | {why} |\n"));
            }
        }
        text
    }
}

fn mib(bytes: u64) -> f64 {
    (bytes as f64 / f64::from(1 << 20) * 10.0).round() / 10.0
}
