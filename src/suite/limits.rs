//! Limits of this package.

use std::time::Duration;

/// Largest suite or scenario file, in bytes.
pub const FILE_BYTES: u64 = 16 << 20;

/// Largest result of a run, in bytes: an episode has 21 scores with their parts, 7 kB, and there
/// are at most 100,000.
pub const RESULT_BYTES: u64 = 1 << 30;

/// Largest number of episodes of a suite.
pub const EPISODES: usize = 100_000;

/// Steps of an episode whose scenario gives no time: 10 minutes at 10 Hz.
pub const STEPS: u64 = 6_000;

/// Longest step of a suite, in microseconds: no verdict passes with longer ones.
pub const STEP_US: i64 = wildcity_score::own::MOST_STEP_US;

/// Most episodes that are driven at once.
pub const JOBS: usize = 64;

/// How long an external agent may take for an episode, unless the command line says otherwise.
pub const AGENT_TIMEOUT: Duration = Duration::from_secs(600);

/// Time between two looks at whether the command of an agent has ended.
pub const AGENT_POLL: Duration = Duration::from_millis(20);

/// How long the server waits for the connection of an agent to close after its command has ended.
pub const CLOSE_WAIT: Duration = Duration::from_secs(5);

/// How long a run waits at its end for the MCAP files of its episodes.
pub const EXPORT_WAIT: Duration = Duration::from_secs(60);

/// Worst episodes that the report shows with pictures.
pub const WORST: usize = 12;

/// Largest number of lines of an agent's standard error that are kept, from the end.
pub const STDERR_LINES: usize = 12;
/// Largest number of bytes of these lines.
pub const STDERR_BYTES: usize = 4 << 10;

/// How long to wait for the rest of an agent's standard error after the agent has ended, because a
/// process that it started may keep the stream open.
pub const STDERR_WAIT: Duration = Duration::from_millis(500);

/// Exit statuses of a shell that finds no such command, or cannot run it.
pub const NO_COMMAND_STATUSES: [i32; 2] = [127, 126];

/// Exit status of an agent that ran out of time: that of the command `timeout`.
pub const TIMEOUT_STATUS: i32 = 124;

/// Exit status of an agent that lost a resource: EX_UNAVAILABLE.
pub const LOST_STATUS: i32 = 69;
