//! The standard error of an agent: prints it as it arrives, and keeps its last lines.

use std::collections::VecDeque;
use std::io::{self, BufRead as _, BufReader, Read as _, Write as _};
use std::process::ChildStderr;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

use tokio::sync::oneshot;
use tokio::time::timeout;

use crate::limits;

/// The last lines of a stream that a thread reads.
pub(crate) struct Tail {
    lines: Arc<Mutex<VecDeque<String>>>,
    /// Closed at the end of the stream.
    ended: oneshot::Receiver<()>,
}

impl Tail {
    /// Starts to read. A process that the agent leaves behind may keep the stream open: then the
    /// thread stays.
    pub(crate) fn new(stream: Option<ChildStderr>) -> Self {
        let lines: Arc<Mutex<VecDeque<String>>> = Arc::default();
        let (end, ended) = oneshot::channel::<()>();
        if let Some(stream) = stream {
            let lines = lines.clone();
            thread::spawn(move || {
                read(stream, &lines);
                // The other side of the channel sees the end, without a message.
                drop(end);
            });
        }
        Self { lines, ended }
    }

    /// The last lines, at the end of the stream or [`limits::STDERR_WAIT`] from now.
    pub(crate) async fn text(self) -> String {
        // A closed stream and a time-out are handled alike.
        let _ = timeout(limits::STDERR_WAIT, self.ended).await;
        let lines = self.lines.lock().unwrap_or_else(PoisonError::into_inner);
        let text = lines.iter().map(String::as_str).collect::<Vec<_>>().join("\n");
        // Whole characters of the last bytes.
        let least = text.len().saturating_sub(limits::STDERR_BYTES);
        let from = (least..=text.len()).find(|&at| text.is_char_boundary(at)).unwrap_or(0);
        text[from..].to_owned()
    }
}

fn read(stream: ChildStderr, lines: &Mutex<VecDeque<String>>) {
    let mut reader = BufReader::new(stream);
    let mut bytes = Vec::new();
    loop {
        bytes.clear();
        // A line without an end is read in parts.
        let part = reader.by_ref().take(limits::STDERR_BYTES as u64).read_until(b'\n', &mut bytes);
        if !matches!(part, Ok(1..)) {
            return;
        }
        // A run continues if its own standard error is closed.
        let _ = io::stderr().write_all(&bytes);
        let line = String::from_utf8_lossy(&bytes).trim_end().to_owned();
        // Locked for each line and not while reading, which may wait for hours.
        let mut lines = lines.lock().unwrap_or_else(PoisonError::into_inner);
        // An empty line says nothing and would push out one that does.
        if !line.is_empty() {
            lines.push_back(line);
        }
        while lines.len() > limits::STDERR_LINES {
            lines.pop_front();
        }
    }
}
