//! Errors say their cause once: in their own text, or as the source that is printed after it.

use crate::source::packages;

/// The lines of a text at which an error has a source, and a text of its own besides.
fn said_twice(text: &str) -> Vec<usize> {
    let mut is_transparent = false;
    let mut lines = Vec::new();
    for (number, line) in (1..).zip(text.lines().map(str::trim)) {
        if line.starts_with("#[error(") {
            is_transparent = line == "#[error(transparent)]";
        }
        let has_source = line.contains("#[from]") || line.contains("#[source]");
        if has_source && !line.starts_with("//") && !is_transparent {
            lines.push(number);
        }
    }
    lines
}

#[test]
fn errors_say_their_cause_once() {
    let found: Vec<String> = packages()
        .iter()
        .flat_map(|package| {
            package.files.iter().flat_map(move |(file, text)| {
                let place = move |line| format!("{}/{file}:{line}", package.folder);
                said_twice(text).into_iter().map(place)
            })
        })
        .collect();
    assert_eq!(
        found,
        Vec::<String>::new(),
        "a source and a text of its own: `{{error:#}}` says it twice"
    );
}

#[test]
fn a_planted_source_is_found() {
    let planted = "#[error(transparent)]\nA(#[from] A),\n#[error(\"b: {0}\")]\nB(#[from] B),\n";
    assert_eq!(said_twice(planted), [4]);
}
