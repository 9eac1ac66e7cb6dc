//! Progress bars on standard error. indicatif hides them if standard error is not a terminal.

use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

/// A bar that counts bytes.
pub fn bytes(label: &'static str) -> ProgressBar {
    bar(label, "{msg:10} {wide_bar} {bytes}/{total_bytes} {eta}")
}

/// A bar that counts items.
pub fn count(label: &'static str) -> ProgressBar {
    bar(label, "{msg:10} {wide_bar} {human_pos}/{human_len} {eta}")
}

/// A bar with a label that names the item in progress.
pub fn state() -> ProgressBar {
    bar("waiting", "{msg:12} {wide_bar} {percent} %")
}

/// A spinner for work of unknown progress.
pub fn waiting(label: &'static str) -> ProgressBar {
    let sign = ProgressBar::new_spinner().with_message(label);
    sign.enable_steady_tick(Duration::from_millis(100));
    sign
}

/// A callback that sets the bar to `done` of `total`.
pub fn show(bar: &ProgressBar) -> impl FnMut(u64, u64) {
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
