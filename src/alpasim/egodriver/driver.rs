//! The methods of a driver.

use std::time::Duration;

use http::Uri;
use http::uri::PathAndQuery;
use tokio::time::timeout;
use tonic::client::Grpc;
use tonic::{Code, Request, Status};
use tonic_prost::ProstCodec;

use super::channel::Channel;
use crate::limits;
use crate::wire::{common, egodriver as wire};

/// `AvailableCamera.rig_to_camera` is the pose of the optical frame, as AlpaSim has it. Without
/// this entry the package `carla-driver-interface` takes it for that of a body frame.
const CONTRACT: (&str, &str) = ("carla-driver-interface-contract", "2");

/// Why a driver did not answer as it must.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DriverError {
    /// The address is invalid.
    #[error("{0:?} is no address of a driver; expected HOST:PORT")]
    Address(String),
    /// It cannot be reached, or went away.
    #[error("the driver is not there: {0}")]
    Lost(String),
    /// It did not answer in time.
    #[error("the driver did not answer {method} within {seconds} s")]
    TimedOut {
        method: &'static str,
        /// How long it had.
        seconds: f64,
    },
    /// It refused a request.
    #[error("{method}: {code}: {text}")]
    Refused { method: &'static str, code: String, text: String },
    /// Its plan cannot be driven.
    #[error("the plan {0}")]
    Plan(String),
    /// An image is larger than a driver accepts.
    #[error(
        "the image of camera {camera:?} has {bytes} bytes, and drivers accept 4 MiB: choose a smaller --size"
    )]
    Image {
        camera: String,
        /// Size of the file.
        bytes: usize,
    },
}

/// A driver, and its session.
pub(super) struct Driver {
    grpc: Grpc<Channel>,
    uuid: String,
    max_wait: Duration,
}

impl Driver {
    /// Connects, and waits until the driver answers `get_version`.
    ///
    /// # Errors
    /// The address is invalid, or no driver answers within [`limits::DRIVER_START`].
    pub(super) async fn connect(
        address: &str,
        uuid: String,
        max_wait: Duration,
    ) -> Result<Self, DriverError> {
        let no_address = |_| DriverError::Address(address.to_owned());
        let origin: Uri = format!("http://{address}").parse().map_err(no_address)?;
        // The wait for the first connection is longer than that for an answer: the network is
        // loaded then.
        let channel = Channel::connect(address, limits::DRIVER_START)
            .await
            .map_err(|reason| DriverError::Lost(format!("{address}: {reason}")))?;
        let mut driver = Self { grpc: Grpc::with_origin(channel, origin), uuid, max_wait };
        let version: common::VersionId = driver.call("get_version", common::Empty {}).await?;
        tracing::info!(driver = version.version_id, "connected");
        Ok(driver)
    }

    /// Name of the session.
    pub(super) fn uuid(&self) -> String {
        self.uuid.clone()
    }

    pub(super) async fn start_session(
        &mut self,
        request: wire::DriveSessionRequest,
    ) -> Result<(), DriverError> {
        self.call::<_, wire::SessionRequestStatus>("start_session", request).await.map(drop)
    }

    pub(super) async fn close_session(&mut self) -> Result<(), DriverError> {
        let request = wire::DriveSessionCloseRequest { session_uuid: self.uuid() };
        self.call::<_, common::Empty>("close_session", request).await.map(drop)
    }

    pub(super) async fn submit_image(
        &mut self,
        image: wire::CameraImage,
    ) -> Result<(), DriverError> {
        let request =
            wire::RolloutCameraImage { session_uuid: self.uuid(), camera_image: Some(image) };
        self.call::<_, common::Empty>("submit_image_observation", request).await.map(drop)
    }

    /// Sends poses of the ego.
    pub(super) async fn submit_egomotion(
        &mut self,
        trajectory: common::Trajectory,
        dynamic_states: Vec<wire::DynamicState>,
    ) -> Result<(), DriverError> {
        let trajectory = Some(trajectory);
        let request =
            wire::RolloutEgoTrajectory { session_uuid: self.uuid(), trajectory, dynamic_states };
        self.call::<_, common::Empty>("submit_egomotion_observation", request).await.map(drop)
    }

    /// Sends the route ahead.
    pub(super) async fn submit_route(&mut self, route: wire::Route) -> Result<(), DriverError> {
        let request = wire::RouteRequest { session_uuid: self.uuid(), route: Some(route) };
        self.call::<_, common::Empty>("submit_route", request).await.map(drop)
    }

    /// Asks for a plan.
    pub(super) async fn drive(
        &mut self,
        time_now_us: u64,
        time_query_us: u64,
    ) -> Result<wire::DriveResponse, DriverError> {
        let request = wire::DriveRequest { session_uuid: self.uuid(), time_now_us, time_query_us };
        self.call("drive", request).await
    }

    async fn call<Asked, Answer>(
        &mut self,
        method: &'static str,
        message: Asked,
    ) -> Result<Answer, DriverError>
    where
        Asked: prost::Message + Send + Sync + 'static,
        Answer: prost::Message + Default + Send + Sync + 'static,
    {
        let path = format!("/egodriver.EgodriverService/{method}");
        // The names of methods are literals of this file, so that this fails only by a defect.
        let path = PathAndQuery::try_from(path).map_err(|error| DriverError::Refused {
            method,
            code: "INTERNAL".to_owned(),
            text: error.to_string(),
        })?;
        let mut request = Request::new(message);
        let (key, value) = CONTRACT;
        request.metadata_mut().insert(key, tonic::metadata::MetadataValue::from_static(value));
        let max_wait = self.max_wait;
        let grpc = &mut self.grpc;
        let calling = async {
            grpc.ready().await.map_err(|error| DriverError::Lost(error.to_string()))?;
            let codec = ProstCodec::<Asked, Answer>::default();
            let answer = grpc.unary(request, path, codec).await;
            answer.map(tonic::Response::into_inner).map_err(|status| driver_error(method, &status))
        };
        let seconds = max_wait.as_secs_f64();
        // The limit includes the wait until the connection takes a request.
        timeout(max_wait, calling).await.unwrap_or(Err(DriverError::TimedOut { method, seconds }))
    }
}

fn driver_error(method: &'static str, status: &Status) -> DriverError {
    let text = status.message().to_owned();
    match status.code() {
        // Lost and refused are different outcomes of an episode: only the second one is the
        // driver's choice.
        Code::Unavailable => DriverError::Lost(text),
        // hyper's errors have no status of the driver.
        Code::Unknown | Code::Cancelled if text.contains("connection") => DriverError::Lost(text),
        code => DriverError::Refused { method, code: format!("{code:?}"), text },
    }
}
