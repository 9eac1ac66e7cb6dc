//! The group of processes of an agent, which ends as a whole.
//!
//! An agent is a command for the shell, and starts processes of its own: killing the shell alone
//! would leave them running. So the shell leads a group. A second shell waits on a pipe that this
//! process holds, and kills the group when the pipe is closed: when the agent is done with, and
//! also when this process is killed.

use std::io;
use std::os::unix::process::CommandExt as _;
use std::process::{Child, ChildStdin, Command, Stdio};

/// Reads until the pipe is closed. Then the group is killed, of which nothing may be left.
const WATCH: &str = "read -r line; kill -s KILL -- \"-$0\" 2>/dev/null";

/// A process with all that it has started.
pub(crate) struct ProcessGroup {
    pub(crate) leader: Child,
    watcher: Child,
    pipe: Option<ChildStdin>,
}

impl ProcessGroup {
    /// Starts a command as the leader of a group.
    ///
    /// # Errors
    /// The command or the shell that watches cannot be started.
    pub(crate) fn start(command: &mut Command) -> io::Result<Self> {
        let mut leader = command.process_group(0).spawn()?;
        let watching = Command::new("sh")
            .args(["-c", WATCH])
            .arg(leader.id().to_string())
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            // A signal of the terminal must not end it before the group.
            .process_group(0)
            .spawn();
        match watching {
            Ok(mut watcher) => {
                let pipe = watcher.stdin.take();
                Ok(Self { leader, watcher, pipe })
            }
            Err(error) => {
                // It has only begun. If it has ended already, there is nothing to kill.
                let _ = leader.kill();
                let _ = leader.wait();
                Err(error)
            }
        }
    }
}

impl Drop for ProcessGroup {
    fn drop(&mut self) {
        drop(self.pipe.take());
        // Errors mean that they have ended.
        let _ = self.watcher.wait();
        let _ = self.leader.kill();
        let _ = self.leader.wait();
    }
}
