//! Client of the `wildcity.v1` protocol, for agents and training pipelines.
//!
//! [`Client`] drives: it opens a session over one WebSocket and works in lock step, so every call
//! sends one request and waits for its one answer. [`HttpClient`] uploads scenes and publishes them
//! as new versions of a twin. Both connect with and without TLS (`wss://`, `https://`), both need a
//! tokio runtime, and neither uses a proxy. [`HttpClient`] and TLS are the feature `http`, which is
//! on by default.
//!
//! ```no_run
//! use wildcity_client::{Client, Open, Pose};
//!
//! # async fn drive() -> Result<(), Box<dyn std::error::Error>> {
//! let mut client = Client::connect("ws://127.0.0.1:8080/v1/session", "my-agent").await?;
//! client.open(Open::twin("street")).await?;
//! let mut observation = client.reset(1, None).await?;
//! for _ in 0..100 {
//!     // Height by width by 3 bytes: red, green, blue.
//!     let pixels = observation.image(0).expect("every step has images").rgb()?;
//!     let Pose { xyz: [x, y, z], q } = observation.metadata().ego.pose;
//!     let next = my_policy(&pixels, Pose { xyz: [x + 0.5, y, z], q });
//!     observation = client.step(next).await?;
//! }
//! println!("{:?}", client.close().await?);
//! # Ok(())
//! # }
//! # fn my_policy(_: &[u8], pose: Pose) -> Pose { pose }
//! ```
//!
//! The examples of this package follow a trajectory and push a checkpoint. Units, frames, error
//! codes and limits are in `protocol/README.md` of the project.

#![warn(missing_docs)]

#[cfg(feature = "http")]
mod actors;
mod client;
mod connection;
mod decode;
mod error;
#[cfg(feature = "http")]
mod http;
pub mod limits;
mod many;
mod memory;
mod observation;
mod options;
#[cfg(feature = "http")]
mod tls;
#[cfg(feature = "http")]
mod upload;

pub use client::{Client, Movement, ResetOptions, Resumed, StepOptions, Switched, Welcome};
pub use error::{ClientError, FrameError};
#[cfg(feature = "http")]
pub use http::{HttpClient, HttpError};
pub use many::Stepped;
pub use observation::{ImageView, Observation};
pub use options::ConnectOptions;
pub use wildcity_protocol as protocol;
pub use wildcity_protocol::http::{
    ActorAsset, ActorBox, ActorClass, ActorLevel, ActorList, ActorProvenance, AllCells, CellReport,
    CellSelection, DamagedActor, NewActor, NewPush, PreviewRequest, Push, PushFile, PushFrame,
    PushReport, PushState, Upload,
};
pub use wildcity_protocol::message::{
    Action, BranchPoint, Drive, DrivePose, DriveSection, Dynamics, DynamicsChoice, DynamicsModel,
    Open, Pose, RandomStart, ResumedSession, SessionStep, Start, TimedPose,
};
pub use wildcity_protocol::observation::SessionRefusal;
