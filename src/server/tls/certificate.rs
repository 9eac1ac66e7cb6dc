//! When a certificate expires (RFC 5280, section 4.1), of which rustls checks all but this.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

const UTC_TIME: u8 = 0x17;
const GENERALIZED_TIME: u8 = 0x18;
/// Tag of the version, which may be absent.
const VERSION: u8 = 0xA0;

/// The end of the validity of a certificate in DER; `None` if it has none that can be read.
pub(crate) fn expiry(der: &[u8]) -> Option<SystemTime> {
    // A certificate is a sequence of the signed part, the algorithm and the signature. The first
    // element of it has all that is needed.
    let (_, certificate, _) = element(der)?;
    let (_, mut fields, _) = element(certificate)?;
    if element(fields)?.0 == VERSION {
        fields = element(fields)?.2;
    }
    // Serial number, signature algorithm and issuer are before the validity.
    for _ in 0..3 {
        fields = element(fields)?.2;
    }
    let (_, validity, _) = element(fields)?;
    let (_, _, not_after) = element(validity)?;
    let (tag, text, _) = element(not_after)?;
    time(tag, std::str::from_utf8(text).ok()?)
}

/// The tag and the content of the first element, and the bytes after it.
fn element(der: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let (&tag, rest) = der.split_first()?;
    let (&first, rest) = rest.split_first()?;
    let (length, rest) = match first {
        0..=0x7F => (usize::from(first), rest),
        // The long form: the low bits count the bytes of the length. Four bytes are 4 GiB, and fit
        // a usize.
        0x81..=0x84 => {
            let (bytes, rest) = rest.split_at_checked(usize::from(first & 0x7F))?;
            (bytes.iter().fold(0, |length, byte| (length << 8) | usize::from(*byte)), rest)
        }
        // 0x80 is the indefinite length, which DER forbids. More than four bytes of length are no
        // certificate.
        _ => return None,
    };
    let (content, rest) = rest.split_at_checked(length)?;
    Some((tag, content, rest))
}

/// A time as `YYMMDDHHMMSSZ` or, as a generalized time, `YYYYMMDDHHMMSSZ`.
fn time(tag: u8, text: &str) -> Option<SystemTime> {
    let digits = text.strip_suffix('Z')?;
    let (year, rest) = match tag {
        UTC_TIME => {
            let (year, rest) = digits.split_at_checked(2)?;
            let year: u64 = year.parse().ok()?;
            // Two digits are 1950 to 2049 (RFC 5280, section 4.1.2.5.1).
            (if year < 50 { 2000 + year } else { 1900 + year }, rest)
        }
        GENERALIZED_TIME => {
            let (year, rest) = digits.split_at_checked(4)?;
            (year.parse().ok()?, rest)
        }
        _ => return None,
    };
    let part = |at: usize| rest.get(at..at + 2)?.parse::<u64>().ok();
    let month = part(0)?;
    let day = part(2)?;
    let hour = part(4)?;
    let minute = part(6)?;
    let second = part(8)?;
    if year < 1970 || !(1..=12).contains(&month) || !(1..=31).contains(&day) {
        return None;
    }
    // Days since 1970-01-01 in the Gregorian calendar; years begin in March, so that a leap day
    // ends one.
    let (year, month) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    // (153 m + 2) / 5 counts the days before month m of a year that begins in March. 719,469 are
    // the days from its year 0 to 1970, plus 1, because days of a month count from 1.
    let days =
        365 * year + year / 4 - year / 100 + year / 400 + (153 * month + 2) / 5 + day - 719_469;
    let seconds = ((days * 24 + hour) * 60 + minute) * 60 + second;
    UNIX_EPOCH.checked_add(Duration::from_secs(seconds))
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, KeyPair, date_time_ymd};

    use super::*;

    #[test]
    fn the_expiry_is_that_of_the_certificate() {
        for ((year, month, day), seconds) in [
            ((2026, 11, 23), 1_795_392_000),
            ((2028, 2, 29), 1_835_395_200),
            ((2049, 12, 31), 2_524_521_600),
            // From 2050 on as a generalized time.
            ((2050, 1, 1), 2_524_608_000),
            ((2100, 3, 1), 4_107_542_400),
        ] {
            let mut params = CertificateParams::new(vec!["a.org".to_owned()]).unwrap();
            params.not_after = date_time_ymd(year, month, day);
            let key = KeyPair::generate().unwrap();
            let certificate = params.self_signed(&key).unwrap();
            let der = certificate.der();
            let expected = UNIX_EPOCH + Duration::from_secs(seconds);
            assert_eq!(expiry(der), Some(expected), "{year}-{month}-{day}");
            // Truncated certificates cause no panic.
            for length in 0..der.len() {
                let _ = expiry(&der[..length]);
            }
        }
    }
}
