//! NaN and infinity in requests.
//!
//! JSON cannot represent them, but agents that divide by zero send them nevertheless: Python writes `NaN`,
//! JavaScript `null`, others `1e999`. The answer to them names the field instead of saying "not JSON".

/// A number of a request that is not finite.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct NonFinite {
    /// The number of the request, if it can be read.
    pub(super) seq: Option<u64>,
    /// The field, as `pose.xyz[0]`.
    pub(super) field: String,
}

/// Finds the first number of a pose or an action that is NaN, infinite or `null`.
pub(super) fn find_non_finite(text: &str) -> Option<NonFinite> {
    let value: serde_json::Value = serde_json::from_str(&without_infinities(text)).ok()?;
    let seq = value.get("seq").and_then(serde_json::Value::as_u64);
    let in_pose = |name: &str, pose: &serde_json::Value| {
        ["xyz", "q"].into_iter().find_map(|part| {
            let numbers = pose.get(part)?.as_array()?;
            let index = numbers.iter().position(serde_json::Value::is_null)?;
            Some(format!("{name}.{part}[{index}]"))
        })
    };
    let single = ["/pose", "/start/pose"]
        .into_iter()
        .find_map(|pointer| in_pose(&pointer[1..].replace('/', "."), value.pointer(pointer)?));
    let of_list = |pointer: &str, name: &str, inner: &str| {
        let list = value.pointer(pointer)?.as_array()?;
        list.iter().enumerate().find_map(|(index, entry)| {
            let pose = if inner.is_empty() { Some(entry) } else { entry.get(&inner[1..]) };
            in_pose(&format!("{name}[{index}]{inner}"), pose?)
        })
    };
    let field = single
        .or_else(|| of_list("/poses", "poses", ""))
        .or_else(|| of_list("/trajectory", "trajectory", ".pose"))
        .or_else(|| {
            let parts = ["acceleration", "curvature"];
            let is_null = |part: &&str| {
                value.pointer(&format!("/action/{part}")).is_some_and(serde_json::Value::is_null)
            };
            parts.into_iter().find(is_null).map(|part| format!("action.{part}"))
        })
        .or_else(|| of_list("/rig/cameras", "rig.cameras", ".camera_to_rig"))?;
    Some(NonFinite { seq, field })
}

/// The text with every bare number that is not finite replaced by `null`.
fn without_infinities(text: &str) -> String {
    let is_number = |c: char| c.is_ascii_alphanumeric() || "+-.".contains(c);
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let end = if first == '"' {
            string_end(rest)
        } else if is_number(first) {
            rest.find(|c| !is_number(c)).unwrap_or(rest.len())
        } else {
            first.len_utf8()
        };
        let (token, after) = rest.split_at(end);
        let infinite = is_number(first) && token.parse::<f64>().is_ok_and(|x| !x.is_finite());
        out.push_str(if infinite { "null" } else { token });
        rest = after;
    }
    out
}

/// Length of the string literal at the start of a text, its quotes included.
fn string_end(text: &str) -> usize {
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

    #[test]
    fn the_field_and_the_number_of_the_request_are_found() {
        let text = r#"{"seq": 7, "action": {"acceleration": Infinity, "curvature": 0}}"#;
        let field = "action.acceleration".to_owned();
        assert_eq!(find_non_finite(text), Some(NonFinite { seq: Some(7), field }));
        assert_eq!(find_non_finite(r#"{"seq": 7, "action": {"acceleration": 1}}"#), None);
    }
}
