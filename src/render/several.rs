//! Several devices of one kind as one backend.

use std::sync::Arc;

use crate::lidar::{LidarView, Sweep};
use crate::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target, View};
use wildcity_scene::geometry::Lidar;
use wildcity_scene::{RenderProfile, Scene};

/// Several devices of one kind. A program that keeps frames apart, such as a server with its
/// sessions, asks for [`Backend::devices`]; any other draws on the first one.
pub struct SeveralDevices {
    devices: Vec<Arc<dyn Backend>>,
}

/// Why devices are not used together.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SeveralError {
    #[error("there is no device")]
    None,
    /// A session's pixels would depend on the device that it is placed on.
    #[error(
        "device {number} is {other:?} and device 0 is {first:?}: the last bit of a pixel depends on the device; name \
         devices of one kind"
    )]
    OtherKind { number: usize, first: String, other: String },
}

impl SeveralDevices {
    /// # Errors
    /// There is none, or they are of several kinds.
    pub fn new(devices: Vec<Arc<dyn Backend>>) -> Result<Self, SeveralError> {
        let kind =
            |device: &Arc<dyn Backend>| [device.name().to_owned(), device.detail()].join(" ");
        let first = devices.first().map(kind).ok_or(SeveralError::None)?;
        match devices.iter().map(kind).enumerate().find(|(_, other)| *other != first) {
            Some((number, other)) => Err(SeveralError::OtherKind { number, first, other }),
            None => Ok(Self { devices }),
        }
    }

    fn first(&self) -> &dyn Backend {
        // `new` refuses an empty list.
        &*self.devices[0]
    }
}

impl Backend for SeveralDevices {
    fn name(&self) -> &'static str {
        self.first().name()
    }

    fn detail(&self) -> String {
        self.first().detail()
    }

    fn devices(&self) -> Vec<Arc<dyn Backend>> {
        self.devices.clone()
    }

    fn threads(&self) -> usize {
        self.first().threads()
    }

    fn draws_exact_rays(&self) -> bool {
        self.first().draws_exact_rays()
    }

    fn has_idle_cores(&self) -> bool {
        self.first().has_idle_cores()
    }

    fn limit_frame_bytes(&self, bytes: u64) {
        // All may draw at once.
        let each = bytes / self.devices.len() as u64;
        self.devices.iter().for_each(|device| device.limit_frame_bytes(each));
    }

    fn frame_bytes(&self, views: &[View], profile: &RenderProfile) -> u64 {
        self.devices.iter().map(|device| device.frame_bytes(views, profile)).sum()
    }

    fn bytes_beside(&self, views: &[View], profile: &RenderProfile) -> u64 {
        self.devices.iter().map(|device| device.bytes_beside(views, profile)).sum()
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        on_view_done: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        self.first().render(frame, targets, on_view_done)
    }

    fn sweep(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: &LidarView,
    ) -> Result<Sweep, RenderError> {
        self.first().sweep(scene, profile, view)
    }

    fn sweep_bytes(&self, lidar: &Lidar) -> u64 {
        self.devices.iter().map(|device| device.sweep_bytes(lidar)).sum()
    }
}
