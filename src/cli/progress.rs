//! Progress bars on standard error, where it is a terminal.

use indicatif::{ProgressBar, ProgressStyle};

/// A bar that counts bytes. indicatif hides it where standard error is no terminal.
pub(super) fn bytes(label: &'static str) -> ProgressBar {
    bar(label, "{msg:10} {wide_bar} {bytes}/{total_bytes} {eta}")
}

/// A bar that counts anything else.
pub(super) fn count(label: &'static str) -> ProgressBar {
    bar(label, "{msg:10} {wide_bar} {human_pos}/{human_len} {eta}")
}

/// A bar whose label says what is counted now.
pub(super) fn state() -> ProgressBar {
    bar("waiting", "{msg:12} {wide_bar} {percent} %")
}

/// Sets how much is done of how much.
pub(super) fn show(bar: &ProgressBar) -> impl FnMut(u64, u64) {
    |done, total| {
        bar.set_length(total);
        bar.set_position(done);
    }
}

fn bar(label: &'static str, template: &str) -> ProgressBar {
    let style = ProgressStyle::with_template(template);
    ProgressBar::new(0)
        .with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
        .with_message(label)
}
