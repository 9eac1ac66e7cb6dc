//! NaN and infinity in JSON.
//!
//! JSON cannot represent them, but agents that divide by zero send them nevertheless: Python writes
//! `NaN`, JavaScript `null`, others `1e999`. The answer to them names the field instead of saying
//! "not JSON".

/// The text with every bare number that is not finite replaced by `null`.
pub(super) fn without_infinities(text: &str) -> String {
    let is_number = |c: char| c.is_ascii_alphanumeric() || "+-.".contains(c);
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        // A string is copied whole: the word NaN in it is text.
        let end = if first == '"' {
            string_end(rest)
        } else if is_number(first) {
            rest.find(|c| !is_number(c)).unwrap_or(rest.len())
        } else {
            first.len_utf8()
        };
        let (token, after) = rest.split_at(end);
        // Rust reads `NaN`, `inf` and `Infinity` in any case and with a sign; `true` and `null` are
        // no numbers to it, and stay.
        let infinite = is_number(first) && token.parse::<f64>().is_ok_and(|x| !x.is_finite());
        out.push_str(if infinite { "null" } else { token });
        rest = after;
    }
    out
}

/// Length of the string literal at the start of a text, its quotes included.
fn string_end(text: &str) -> usize {
    // The opening quote must not end the string.
    let mut escaped = true;
    for (index, byte) in text.bytes().enumerate() {
        match byte {
            _ if escaped => escaped = false,
            b'\\' => escaped = true,
            b'"' => return index + 1,
            _ => {}
        }
    }
    text.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strings_are_left_alone() {
        let text = r#"{"a":"NaN, \"NaN\\","b":[NaN,1.5,true]}"#;
        let clean = r#"{"a":"NaN, \"NaN\\","b":[null,1.5,true]}"#;
        assert_eq!(without_infinities(text), clean);
        assert_eq!(without_infinities("\"open"), "\"open");
    }
}
