//! XML texts, with bounds: a parser compares all attributes of an element with each other.

use crate::ConvertError;

/// Most attributes of one element: no format here knows more than 30.
const ATTRIBUTES: usize = 256;

/// Deepest nesting of elements: no format here has more than 40.
const DEPTH: usize = 256;

/// Parses a text of at most so many elements and texts, after [`check`].
pub(crate) fn parse(text: &str, nodes: u32) -> Result<roxmltree::Document<'_>, ConvertError> {
    check(text)?;
    // Without a DTD there are no entities, which could expand without bound.
    let options =
        roxmltree::ParsingOptions { allow_dtd: false, nodes_limit: nodes, ..Default::default() };
    roxmltree::Document::parse_with_options(text, options)
        .map_err(|error| ConvertError::new("XML", error.to_string()))
}

/// Refuses a text with an element of too many attributes, or with too deep a nesting, in one pass.
pub(crate) fn check(text: &str) -> Result<(), ConvertError> {
    let mut rest = text;
    let mut depth = 0_usize;
    // Counted only for a message, so that a sound text is passed once.
    let line = |rest: &str| 1 + text[..text.len() - rest.len()].matches('\n').count();
    while let Some(open) = rest.find('<') {
        rest = &rest[open..];
        // The longer beginnings come first, because `<!` is that of a comment, too.
        let ends = [("<!--", "-->"), ("<![CDATA[", "]]>"), ("<?", "?>"), ("<!", ">")];
        if let Some((_, end)) = ends.iter().find(|(begin, _)| rest.starts_with(begin)) {
            // It has no end, which the parser reports.
            let Some(at) = rest.find(end) else { return Ok(()) };
            rest = &rest[at + end.len()..];
            continue;
        }
        let (attributes, length) = tag(rest);
        if attributes > ATTRIBUTES {
            let message = format!("{attributes} attributes; at most {ATTRIBUTES} are read");
            return Err(ConvertError::new(format!("line {}", line(rest)), message));
        }
        let tag = &rest[..length];
        if tag.starts_with("</") {
            // The parser refuses what closes more than was opened.
            depth = depth.saturating_sub(1);
        } else if !tag.ends_with("/>") {
            depth += 1;
        }
        if depth > DEPTH {
            let message = format!("elements are nested more than {DEPTH} deep");
            return Err(ConvertError::new(format!("line {}", line(rest)), message));
        }
        rest = &rest[length..];
    }
    Ok(())
}

/// The number of attributes of the tag at the start of a text, and its length in bytes.
fn tag(text: &str) -> (usize, usize) {
    let mut attributes = 0;
    // Within quotes, `=` and `>` are text.
    let mut quote = None;
    for (at, byte) in text.bytes().enumerate() {
        match (quote, byte) {
            (Some(open), _) if open == byte => quote = None,
            (Some(_), _) => {}
            (None, b'"' | b'\'') => quote = Some(byte),
            (None, b'=') => attributes += 1,
            (None, b'>') => return (attributes, at + 1),
            (None, _) => {}
        }
    }
    (attributes, text.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_attributes_are_refused_without_comparing_them() {
        let attributes: String = (0..30_000).map(|i| format!(" a{i}=\"1\"")).collect();
        let error = check(&format!("<a>\n<b{attributes}/></a>")).unwrap_err();
        assert_eq!((error.place.as_str(), error.message.contains("30000")), ("line 2", true));
        let quoted = "=".repeat(1000);
        // Neither a comment nor a quoted text has attributes.
        assert_eq!(check(&format!("<!-- {quoted} --><a b='>{quoted}'/>")), Ok(()));
    }

    #[test]
    fn deep_nesting_is_refused() {
        assert!(check(&"<a>".repeat(DEPTH + 1)).is_err());
        assert_eq!(check(&"<a><b/></a>".repeat(DEPTH + 1)), Ok(()));
    }
}
