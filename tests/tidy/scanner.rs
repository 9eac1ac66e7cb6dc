//! Rust read just well enough to know which paths a file names.

/// A path that code names, as `["crate", "scene", "Rig"]` or `["axum"]`, and its line, from 1.
///
/// `self` and `super` are resolved: what lies in the crate starts with `crate`.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Named {
    pub(crate) path: Vec<String>,
    pub(crate) line: usize,
}

/// Every path that the file of a module names; `file` is its place within `src`.
pub(crate) fn paths(file: &str, text: &str) -> Vec<Named> {
    let tokens = tokens(text);
    let mut reader = Reader { tokens: &tokens, at: 0, module: module(file), found: Vec::new() };
    // Depths of braces outside of the inline modules that are open.
    let mut inline = Vec::new();
    let mut depth = 0;
    while let Some(token) = reader.peek(0) {
        match token {
            "use" => {
                reader.at += 1;
                reader.tree(&[]);
            }
            "extern" if reader.peek(1) == Some("crate") => {
                reader.at += 2;
                reader.tree(&[]);
            }
            "mod" if reader.peek(2) == Some("{") => {
                reader.module.push(reader.tokens[reader.at + 1].0.clone());
                inline.push(depth);
                depth += 1;
                reader.at += 3;
            }
            "{" => {
                depth += 1;
                reader.at += 1;
            }
            "}" => {
                depth -= 1;
                if inline.pop_if(|outside| *outside == depth).is_some() {
                    reader.module.pop();
                }
                reader.at += 1;
            }
            // A field or method after a dot is no path.
            "." => reader.at += 2,
            word if is_word(word) && reader.peek(1) == Some("::") => reader.tree(&[]),
            _ => reader.at += 1,
        }
    }
    reader.found
}

struct Reader<'a> {
    tokens: &'a [(String, usize)],
    at: usize,
    module: Vec<String>,
    found: Vec<Named>,
}

impl Reader<'_> {
    fn peek(&self, ahead: usize) -> Option<&str> {
        self.tokens.get(self.at + ahead).map(|(token, _)| token.as_str())
    }

    /// Reads a path or a tree of them, behind what stands before its braces.
    fn tree(&mut self, before: &[String]) {
        let mut path = before.to_vec();
        let line = self.tokens.get(self.at).map_or(0, |(_, line)| *line);
        if self.peek(0) == Some("::") {
            self.at += 1;
        }
        loop {
            match self.peek(0) {
                Some("{") => {
                    self.at += 1;
                    while let Some(token) = self.peek(0) {
                        match token {
                            "}" => break,
                            "," => self.at += 1,
                            _ => self.tree(&path),
                        }
                    }
                    self.at += 1;
                    return;
                }
                Some(word) if is_word(word) || word == "*" => {
                    path.push(word.to_owned());
                    self.at += 1;
                }
                // Behind `::`, as in `Vec::<u8>`; what is within is read by the caller.
                _ => break,
            }
            if self.peek(0) != Some("::") {
                break;
            }
            self.at += 1;
        }
        if self.peek(0) == Some("as") {
            self.at += 2;
        }
        if path.len() == before.len() && !matches!(self.peek(0), Some("<")) {
            self.at += 1;
        }
        let path = self.resolved(path);
        self.found.push(Named { path, line });
    }

    /// Takes `self` and `super` at the start for the modules that they mean.
    fn resolved(&self, path: Vec<String>) -> Vec<String> {
        let supers = path.iter().take_while(|word| *word == "super").count();
        let selfs = path.iter().take_while(|word| *word == "self").count();
        // `self::super::x` is one more.
        let more = path[selfs..].iter().take_while(|word| *word == "super").count();
        let (skip, up) = if selfs > 0 { (selfs + more, more) } else { (supers, supers) };
        if skip == 0 {
            return path;
        }
        let module = &self.module[..self.module.len().saturating_sub(up)];
        let start = std::iter::once("crate".to_owned()).chain(module.iter().cloned());
        start.chain(path[skip..].iter().cloned()).collect()
    }
}

/// The module of a file, as `["render", "cpu", "bin"]`.
fn module(file: &str) -> Vec<String> {
    let stem = file.trim_end_matches(".rs").trim_end_matches("/mod");
    stem.split('/').map(str::to_owned).collect()
}

fn is_word(token: &str) -> bool {
    token.starts_with(|c: char| c.is_alphabetic() || c == '_')
}

/// Words, `::` and single signs, each with its line; no comments, no text, no lifetimes.
fn tokens(text: &str) -> Vec<(String, usize)> {
    let chars: Vec<char> = text.chars().collect();
    let (mut at, mut line, mut tokens) = (0, 1, Vec::new());
    while at < chars.len() {
        let rest = &chars[at..];
        let length = match rest[0] {
            '/' if rest.get(1) == Some(&'/') => until(rest, |c| c[0] == '\n'),
            '/' if rest.get(1) == Some(&'*') => block_comment(rest),
            '"' => quoted(rest),
            'r' | 'b' | 'c' if prefixed_text(rest).is_some() => prefixed_text(rest).unwrap_or(1),
            // A character, not a lifetime: 'x' or '\x'.
            '\'' if rest.get(1) == Some(&'\\') => 3 + until(&rest[3..], |c| c[0] == '\''),
            '\'' if rest.get(2) == Some(&'\'') => 3,
            '\'' => 1 + until(&rest[1..], |c| !(c[0].is_alphanumeric() || c[0] == '_')),
            c if c.is_alphanumeric() || c == '_' => {
                let length = until(rest, |c| !(c[0].is_alphanumeric() || c[0] == '_'));
                tokens.push((rest[..length].iter().collect(), line));
                length
            }
            ':' if rest.get(1) == Some(&':') => {
                tokens.push(("::".to_owned(), line));
                2
            }
            c => {
                if !c.is_whitespace() {
                    tokens.push((c.to_string(), line));
                }
                1
            }
        };
        let length = length.min(rest.len());
        line += rest[..length].iter().filter(|c| **c == '\n').count();
        at += length;
    }
    tokens
}

fn until(chars: &[char], end: impl Fn(&[char]) -> bool) -> usize {
    (0..chars.len()).find(|&at| end(&chars[at..])).unwrap_or(chars.len())
}

fn block_comment(chars: &[char]) -> usize {
    let mut depth = 0;
    let mut at = 0;
    while at + 1 < chars.len() {
        match (chars[at], chars[at + 1]) {
            ('/', '*') => (depth, at) = (depth + 1, at + 2),
            ('*', '/') => (depth, at) = (depth - 1, at + 2),
            _ => at += 1,
        }
        if depth == 0 {
            return at;
        }
    }
    chars.len()
}

/// Length of a text in quotes, with them.
fn quoted(chars: &[char]) -> usize {
    let mut at = 1;
    while at < chars.len() && chars[at] != '"' {
        at += if chars[at] == '\\' { 2 } else { 1 };
    }
    at + 1
}

/// Length of `b"..."`, `r#"..."#` and the like; none if it is none.
fn prefixed_text(chars: &[char]) -> Option<usize> {
    let letters = until(chars, |c| !"rbc".contains(c[0]));
    let hashes = until(&chars[letters..], |c| c[0] != '#');
    let body = letters + hashes;
    if letters > 2 || chars.get(body) != Some(&'"') {
        return None;
    }
    if !chars[..letters].contains(&'r') {
        return (hashes == 0).then(|| letters + quoted(&chars[letters..]));
    }
    let end: Vec<char> = std::iter::once('"').chain(std::iter::repeat_n('#', hashes)).collect();
    Some(body + 1 + until(&chars[body + 1..], |c| c.starts_with(&end)) + end.len())
}
