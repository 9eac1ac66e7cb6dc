//! The devices of the backend, each with a render queue of its own, and the sessions on them.
//!
//! A session stays on one device, whose memory has the twin around it: the one with the fewest
//! sessions when the session opens.

use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::time::Instant;

use wildcity_render::Backend;

use super::render_queue::{FrameCost, RenderQueue, Scratch};
use crate::error::SessionError;

/// The render queues of all devices.
pub(crate) struct Devices {
    backend: Arc<dyn Backend>,
    queues: Vec<RenderQueue>,
    placed: Arc<Mutex<Placed>>,
}

/// Which device has how many sessions.
#[derive(Debug)]
struct Placed {
    /// How many each device has.
    sessions: Vec<usize>,
    /// Sessions so far, the frames of pushes among them.
    numbered: u64,
}

/// A session's place on a device, until dropped.
#[derive(Debug)]
pub(crate) struct DeviceSlot {
    number: u64,
    device: usize,
    placed: Arc<Mutex<Placed>>,
}

/// What a device does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceLoad {
    /// Sessions that are placed on it.
    pub sessions: usize,
    /// Frames that wait for it.
    pub queued_frames: usize,
}

impl Devices {
    /// Starts the render threads of all devices.
    ///
    /// # Errors
    /// [`SessionError::Thread`] if one cannot be started.
    pub(crate) fn start(backend: Arc<dyn Backend>) -> Result<Self, SessionError> {
        let mut devices = backend.devices();
        if devices.is_empty() {
            devices.push(backend.clone());
        }
        let queues: Result<Vec<_>, _> = devices.into_iter().map(RenderQueue::start).collect();
        let queues = queues?;
        // Number 0 belongs to the frames of pushes, which are drawn on device 0.
        let placed = Placed { sessions: vec![0; queues.len()], numbered: 1 };
        Ok(Self { backend, queues, placed: Arc::new(Mutex::new(placed)) })
    }

    /// How many devices there are: as many frames are drawn at once.
    pub(crate) fn count(&self) -> usize {
        self.queues.len()
    }

    /// All devices as one backend.
    pub(crate) fn backend(&self) -> &dyn Backend {
        &*self.backend
    }

    /// Places a session on the device with the fewest.
    pub(crate) fn place(&self) -> DeviceSlot {
        let mut placed = self.placed.lock();
        let devices = placed.sessions.len();
        // The first one of several with as few, so that the same order of sessions gives the same
        // places.
        let device = (0..devices).min_by_key(|&device| placed.sessions[device]).unwrap_or(0);
        placed.sessions[device] += 1;
        // The remainder by the number of devices is the device, so that a frame's session says
        // where it is drawn.
        let number = placed.numbered * devices as u64 + device as u64;
        placed.numbered += 1;
        DeviceSlot { number, device, placed: self.placed.clone() }
    }

    /// As [`RenderQueue::run`], on the device of the session.
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        cost: FrameCost,
        deadline: Instant,
        work: impl FnOnce(&mut Scratch, &dyn Backend) -> T + Send + 'static,
    ) -> Result<(T, Duration), SessionError> {
        let device = cost.session % self.queues.len() as u64;
        self.queues[device as usize].run(cost, deadline, work).await
    }

    /// A number that rises by 1 with each session that is placed, and with each that ends.
    pub(crate) fn changes(&self) -> u64 {
        let placed = self.placed.lock();
        let current: usize = placed.sessions.iter().sum();
        // Placed plus ended, since each that is not there any more has ended, plus a constant 2.
        2 * placed.numbered - current as u64
    }

    /// What each device does, by its place among them.
    pub(crate) fn loads(&self) -> Vec<DeviceLoad> {
        let placed = self.placed.lock().sessions.clone();
        let loads = placed.into_iter().zip(&self.queues);
        loads.map(|(sessions, queue)| DeviceLoad { sessions, queued_frames: queue.len() }).collect()
    }
}

impl DeviceSlot {
    /// The number of the session, by which its frames are scheduled and find their device.
    pub(crate) fn number(&self) -> u64 {
        self.number
    }
}

impl Drop for DeviceSlot {
    fn drop(&mut self) {
        self.placed.lock().sessions[self.device] -= 1;
    }
}

#[cfg(test)]
mod tests {
    use wildcity_render::reference::Reference;
    use wildcity_render::several::SeveralDevices;

    use super::*;

    fn devices(count: usize) -> Devices {
        let each = (0..count).map(|_| Arc::new(Reference) as Arc<dyn Backend>).collect();
        Devices::start(Arc::new(SeveralDevices::new(each).unwrap())).unwrap()
    }

    #[test]
    fn sessions_go_to_the_device_with_the_fewest() {
        let devices = devices(3);
        let mut slots: Vec<DeviceSlot> = (0..7).map(|_| devices.place()).collect();
        let sessions = || devices.loads().iter().map(|load| load.sessions).collect::<Vec<_>>();
        assert_eq!(sessions(), [3, 2, 2]);
        // Both sessions of device 1 end, and the next two come there.
        slots.retain(|slot| slot.device != 1);
        assert_eq!(sessions(), [3, 0, 2]);
        let before = devices.changes();
        slots.extend([devices.place(), devices.place()]);
        slots.pop();
        assert_eq!(devices.changes() - before, 3, "two began, and one ended");
        slots.push(devices.place());
        assert_eq!(sessions(), [3, 2, 2]);
        let numbers: std::collections::BTreeSet<u64> =
            slots.iter().map(DeviceSlot::number).collect();
        assert_eq!(numbers.len(), slots.len(), "each has its own");
        assert!(slots.iter().all(|slot| slot.number % 3 == slot.device as u64));
    }

    #[tokio::test]
    async fn a_busy_device_does_not_hold_up_the_others() {
        let devices = devices(2);
        let busy = devices.place();
        let free = devices.place();
        let deadline = Instant::now() + Duration::from_secs(20);
        let cost = |slot: &DeviceSlot| FrameCost { session: slot.number(), samples: 1 };
        let (release, held) = std::sync::mpsc::channel::<()>();
        let first = devices.run(cost(&busy), deadline, move |_, _| held.recv().is_ok());
        let second = async {
            // Behind the first one, it would wait until its deadline.
            let done = devices.run(cost(&free), deadline, |_, _| ()).await;
            release.send(()).unwrap();
            done
        };
        let (first, second) = tokio::join!(first, second);
        assert!(first.unwrap().0);
        second.unwrap();
    }
}
