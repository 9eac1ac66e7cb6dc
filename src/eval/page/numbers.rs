//! Numbers as the page writes them.

/// Decibels without their unit.
pub(super) fn decibels(db: f64) -> String {
    match db {
        f64::INFINITY => "exact".to_owned(),
        db if db.is_nan() => "none".to_owned(),
        db => format!("{db:.2}"),
    }
}

/// A mean of decibels, without their unit. One exact image of many makes it infinite, and the
/// others are not exact.
pub(super) fn mean_decibels(db: f64) -> String {
    if db == f64::INFINITY { "infinite".to_owned() } else { decibels(db) }
}

/// Decibels with their unit.
pub(super) fn with_unit(db: f64) -> String {
    if db.is_finite() { format!("{db:.2} dB") } else { decibels(db) }
}

/// A mean of decibels with their unit.
pub(super) fn mean_with_unit(db: f64) -> String {
    if db.is_finite() { with_unit(db) } else { mean_decibels(db) }
}

/// A number from 0 to 1.
pub(super) fn share(value: f64) -> String {
    if value.is_nan() { "none".to_owned() } else { format!("{value:.4}") }
}

/// A share in percent, without its unit.
pub(super) fn percent(value: f64) -> String {
    if value.is_nan() { "none".to_owned() } else { format!("{:.1}", 100.0 * value) }
}

/// Metres, without their unit.
pub(super) fn metres(value: f64) -> String {
    if value.is_nan() { "none".to_owned() } else { format!("{value:.3}") }
}

/// A difference, with its sign.
pub(super) fn signed(value: f64, digits: usize) -> String {
    if value.is_nan() { "none".to_owned() } else { format!("{value:+.digits$}") }
}
