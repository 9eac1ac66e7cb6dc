//! Limits of this package.

use std::time::Duration;

/// Largest suite or scenario file, in bytes.
pub const FILE_BYTES: u64 = 16 << 20;

/// Most episodes of a suite.
pub const EPISODES: usize = 100_000;

/// Steps of an episode whose scenario gives no time: 10 minutes at 10 Hz.
pub const STEPS: u64 = 6_000;

/// Episodes at once.
pub const JOBS: usize = 64;

/// How long an agent that is a command may take for an episode, unless the command line says otherwise.
pub const AGENT_TIMEOUT: Duration = Duration::from_secs(600);

/// Time between two looks at whether the command of an agent has ended.
pub const AGENT_POLL: Duration = Duration::from_millis(20);

/// How long the server waits for the connection of an agent to close after its command has ended.
pub const CLOSE_WAIT: Duration = Duration::from_secs(5);

/// How long a run waits at its end for the MCAP files of its episodes.
pub const EXPORT_WAIT: Duration = Duration::from_secs(60);

/// Share of episodes that may end off the model.
pub const OFF_MODEL_SHARE: f64 = 0.1;

/// Worst episodes that the report shows with pictures.
pub const WORST: usize = 12;

/// Exit status of an agent that ran out of time: that of the command `timeout`.
pub const TIMEOUT_STATUS: i32 = 124;

/// Exit status of an agent that lost what it needs: EX_UNAVAILABLE.
pub const LOST_STATUS: i32 = 69;
