//! Times as text.

use std::time::Duration;

/// A time such as `2026-11-21T08:52:20Z`, from microseconds since 1970.
///
/// The algorithm is Hinnant's ("chrono-Compatible Low-Level Date Algorithms"). Years begin in
/// March, so that the leap day is the last day of a year. Then 400 years (an era) have 146,097
/// days, and every group of five months, counted from March, has 153 days.
pub(super) fn utc(time_us: i64) -> String {
    let seconds = time_us.div_euclid(1_000_000);
    let days_since_1970 = seconds.div_euclid(86_400);
    let second = seconds.rem_euclid(86_400);
    // 0000-03-01 is 719,468 days before 1970-01-01.
    let days = days_since_1970 + 719_468;
    let era = days.div_euclid(146_097);
    let day_of_era = days.rem_euclid(146_097);
    // Leap days: one in 1,460 days, none in 36,524, one in 146,096.
    let year_of_era =
        (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    // 0 is March.
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = (month_from_march + 2) % 12 + 1;
    let year = 400 * era + year_of_era + i64::from(month <= 2);
    let hour = second / 3_600;
    let minute = second / 60 % 60;
    let second = second % 60;
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

/// A time such as 24h.
pub(super) fn duration(text: &str) -> Result<Duration, String> {
    let wrong = || "expected a whole number and s, m, h or d, for example 24h".to_owned();
    let unit = text.chars().last().ok_or_else(wrong)?;
    let seconds = match unit {
        's' => 1,
        'm' => 60,
        'h' => 3_600,
        'd' => 86_400,
        _ => return Err(wrong()),
    };
    let number: u64 = text[..text.len() - 1].parse().map_err(|_| wrong())?;
    number.checked_mul(seconds).map(Duration::from_secs).ok_or_else(wrong)
}

#[cfg(test)]
mod tests {
    use super::{duration, utc};

    #[test]
    fn times_are_of_the_calendar() {
        // From `date -u -d @SECONDS`.
        for (seconds, text) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_399, "2000-02-28T23:59:59Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (1_709_251_199, "2024-02-29T23:59:59Z"),
            (1_709_251_200, "2024-03-01T00:00:00Z"),
            (1_795_250_457, "2026-11-21T08:40:57Z"),
            (4_107_542_400, "2100-03-01T00:00:00Z"),
            (-1, "1969-12-31T23:59:59Z"),
        ] {
            assert_eq!(utc(seconds * 1_000_000), text);
        }
    }

    #[test]
    fn times_have_a_unit() {
        for (text, seconds) in [("0s", 0), ("90s", 90), ("30m", 1_800), ("24h", 86_400)] {
            assert_eq!(duration(text).unwrap().as_secs(), seconds);
        }
        assert_eq!(duration("7d").unwrap().as_secs(), 7 * 86_400);
        for text in ["", "24", "h", "-1h", "1.5h", "99999999999999999999d", "1 h", "1µ"] {
            assert!(duration(text).unwrap_err().contains("for example 24h"), "{text}");
        }
    }
}
