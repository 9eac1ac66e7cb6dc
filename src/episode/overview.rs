//! What a list of episodes shows: from the beginning and the end of a record, however long it is.

use std::fs::File;
use std::io::{self, BufRead as _, BufReader, Read, Seek as _, SeekFrom};
use std::path::Path;

use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, Error as _, IgnoredAny, MapAccess, Visitor};

use crate::file::open_record;
use crate::limits;

/// The twin of an episode, from the first fields of its record.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordHead {
    /// Name of the twin.
    pub twin: String,
    pub version: u64,
    /// Name of the token that drove it; empty if there was none.
    pub owner: String,
}

/// What a list shows of an episode.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Overview {
    pub head: RecordHead,
    /// Name of the scenario, if there was one.
    pub scenario: Option<String>,
    pub steps: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// Why it ended; `None` if it has not.
    pub outcome: Option<String>,
    /// The verdict of the session, if there is one.
    pub verdict: Option<String>,
}

/// The fields of the last lines that a list shows.
#[derive(Deserialize)]
struct LastLine {
    kind: String,
    #[serde(default)]
    step: u64,
    #[serde(default)]
    steps: u64,
    #[serde(default)]
    time_us: i64,
    #[serde(default)]
    outcome: Option<String>,
    #[serde(default)]
    verdict: Option<String>,
}

impl RecordHead {
    /// Reads the beginning of a record: not its rig, which may have overlays of many megabytes.
    ///
    /// # Errors
    /// The file cannot be read, or is no record.
    pub fn read(path: &Path) -> io::Result<Self> {
        Self::from_reader(&mut BufReader::new(open_record(path)?))
    }

    fn from_reader(reader: &mut impl Read) -> io::Result<Self> {
        // The owner, which may be absent, stands before the version, which never is.
        let wanted = ["kind", "format", "twin", "version"];
        let [kind, format, twin, version, owner] = first_fields(reader, wanted, "owner")?;
        let is_record = kind == "episode" && format == crate::EpisodeFile::FORMAT;
        match (twin.as_str(), version.as_u64()) {
            (Some(twin), Some(version)) if is_record => {
                let owner = owner.as_str().unwrap_or_default().to_owned();
                Ok(Self { twin: twin.to_owned(), version, owner })
            }
            _ => Err(io::Error::other("its first line is no header of an episode")),
        }
    }
}

impl Overview {
    /// Reads the beginning and the end of a record.
    ///
    /// # Errors
    /// The file cannot be read, or is no record.
    pub fn read(path: &Path) -> io::Result<Self> {
        let mut reader = BufReader::new(open_record(path)?);
        let head = RecordHead::from_reader(&mut reader)?;
        // From the start again: how much of the line was read is not known.
        reader.seek(SeekFrom::Start(0))?;
        reader.by_ref().take(limits::HEAD_BYTES as u64).skip_until(b'\n')?;
        let scenario = match first_fields(&mut reader, ["kind", "name"], "hash") {
            Ok([kind, name, _]) if kind == "scenario" => name.as_str().map(str::to_owned),
            // Another line, or none.
            Ok(_) | Err(_) => None,
        };
        let mut overview = Self { head, scenario, ..Self::default() };
        overview.add_end(reader.get_mut())?;
        Ok(overview)
    }

    /// Adds what the last lines say. Looks at more of them if a short end has no frame.
    fn add_end(&mut self, file: &mut File) -> io::Result<()> {
        let length = file.metadata()?.len();
        for tail in limits::TAIL_BYTES {
            let from = length.saturating_sub(tail);
            let mut text = Vec::new();
            file.seek(SeekFrom::Start(from))?;
            file.by_ref().take(tail).read_to_end(&mut text)?;
            // An incomplete last line is left out, and the first one unless the file begins with
            // it.
            let mut lines: Vec<&[u8]> = text.split(|byte| *byte == b'\n').collect();
            lines.pop();
            let known = lines.iter().skip(usize::from(from > 0)).rev();
            if self.add_lines(known.copied()) || from == 0 {
                break;
            }
        }
        Ok(())
    }

    /// Adds lines, the last one first, up to a frame. Whether there was one.
    fn add_lines<'a>(&mut self, lines: impl Iterator<Item = &'a [u8]>) -> bool {
        for line in lines {
            let Ok(line) = serde_json::from_slice::<LastLine>(line) else { continue };
            match line.kind.as_str() {
                "end" => {
                    (self.steps, self.time_us) = (line.steps, line.time_us);
                    self.outcome = line.outcome;
                }
                "result" => self.verdict = line.verdict,
                "frame" => {
                    if self.outcome.is_none() {
                        (self.steps, self.time_us) = (line.step, line.time_us);
                    }
                    return true;
                }
                _ => {}
            }
        }
        false
    }
}

/// The first values of some fields of a JSON object, in a bounded part of it, null where they are
/// absent. Reading ends when all of `names` are known; `optional` is read if it stands before.
fn first_fields<const N: usize, const M: usize>(
    reader: &mut impl Read,
    names: [&'static str; N],
    optional: &'static str,
) -> io::Result<[serde_json::Value; M]> {
    let mut values = vec![serde_json::Value::Null; M];
    let mut found = Fields { names: &names, optional, values: &mut values };
    let part = reader.take(limits::HEAD_FIELDS_BYTES);
    let mut deserializer = serde_json::Deserializer::from_reader(part);
    // An error is the regular end: the rest of the object is not read.
    match (&mut found).deserialize(&mut deserializer) {
        Err(error) if error.is_io() => Err(error.into()),
        Ok(()) | Err(_) => values.try_into().map_err(|_| io::Error::other("not as many fields")),
    }
}

struct Fields<'a> {
    names: &'a [&'static str],
    optional: &'static str,
    /// Those of the names, and then the optional one.
    values: &'a mut [serde_json::Value],
}

impl<'de> DeserializeSeed<'de> for &mut Fields<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for &mut Fields<'_> {
    type Value = ();

    fn expecting(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        let count = self.names.len();
        while let Some(name) = map.next_key::<String>()? {
            let wanted = self.names.iter().position(|wanted| *wanted == name);
            match wanted.or((name == self.optional).then_some(count)) {
                Some(index) => self.values[index] = map.next_value()?,
                None => {
                    map.next_value::<IgnoredAny>()?;
                }
            }
            if self.values.iter().take(count).all(|value| !value.is_null()) {
                return Err(A::Error::custom("all fields are known"));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A record of a megabyte: its head, frames with notes, and perhaps its end.
    fn record(end: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        let notes = "n".repeat(100_000);
        let mut text = String::from(concat!(
            r#"{"kind":"episode","format":0,"build":"b","session":"s","owner":"ann","twin":"street","version":3,"#,
            r#""rig":{"overlay":"never read to its end"#
        ));
        text.push_str(&"x".repeat(1 << 20));
        text.push_str("\"}}\n");
        text.push_str(r#"{"kind":"scenario","name":"cut-in","hash":"h"}"#);
        text.push('\n');
        for step in 1..=10 {
            let time_us = step * 100_000;
            text.push_str(&format!(
                r#"{{"kind":"frame","request":"step","step":{step},"time_us":{time_us},"notes":"{notes}"}}"#
            ));
            text.push('\n');
        }
        text.push_str(end);
        std::fs::write(file.path(), text).unwrap();
        file
    }

    #[test]
    fn a_record_is_listed_by_its_head_and_its_end() {
        let end = concat!(
            r#"{"kind":"result","verdict":"passed","faults":[]}"#,
            "\n",
            r#"{"kind":"end","outcome":"completed","steps":10,"time_us":1000000,"distance_m":1.0}"#,
            "\n"
        );
        let expected = Overview {
            head: RecordHead { twin: "street".to_owned(), version: 3, owner: "ann".to_owned() },
            scenario: Some("cut-in".to_owned()),
            steps: 10,
            time_us: 1_000_000,
            outcome: Some("completed".to_owned()),
            verdict: Some("passed".to_owned()),
        };
        assert_eq!(Overview::read(record(end).path()).unwrap(), expected);
        // Still being written: the last line is incomplete.
        let driven = Overview { outcome: None, verdict: None, ..expected };
        assert_eq!(Overview::read(record(r#"{"kind":"fra"#).path()).unwrap(), driven);
    }

    #[test]
    fn what_is_no_record_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        for text in ["", "no json", r#"{"kind":"end","twin":"a","version":1}"#, "[1]"] {
            std::fs::write(file.path(), text).unwrap();
            assert!(RecordHead::read(file.path()).is_err(), "{text}");
        }
        assert!(RecordHead::read(Path::new("/")).is_err());
    }
}
