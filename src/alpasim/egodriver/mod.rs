//! wildcity driven by AlpaSim's drivers: the service `egodriver.EgodriverService`, as its client.
//!
//! ```text
//! channel   HTTP/2 to a driver
//! driver    the methods of a driver
//! route     the recorded drive ahead
//! plan      a driver's answer as a trajectory
//! bridge    one episode with a session of wildcity and a session of a driver
//! ```

mod bridge;
mod channel;
mod driver;
mod plan;
mod route;

pub use bridge::{BridgeError, EpisodeReport, EpisodeSettings, Outcome, drive_episode};
pub use driver::DriverError;
