//! The turns of the frames: one is prepared and submitted at a time, in the order of the calls.

use std::sync::Arc;
use std::time::Instant;

use super::Gpu;
use super::chain::{Chain, InFlight, Turn, Waited};
use super::device::Device;
use super::read_back::MappedFrame;
use super::resolve::Outputs;
use crate::{Frame, RenderError};

impl Gpu {
    /// Runs `work` on the device after all earlier callers. Opens the device again if it was lost.
    /// The next caller has its turn when this returns.
    pub(super) fn in_turn<T>(
        &self,
        work: impl FnOnce(&mut Chain) -> Result<T, RenderError>,
    ) -> Result<T, RenderError> {
        let _ticket = self.queue.wait();
        self.with_chain(work)
    }

    /// Runs `work` on the device; called in turn.
    fn with_chain<T>(
        &self,
        work: impl FnOnce(&mut Chain) -> Result<T, RenderError>,
    ) -> Result<T, RenderError> {
        let mut slot = self.chain.lock();
        // If `work` panics, the slot stays empty: memory may be half-written then, and the next
        // caller opens the device again.
        let mut chain = match slot.take() {
            Some(chain) => chain,
            None => self.reopen()?,
        };
        let done = work(&mut chain);
        match done {
            // Memory may be half-written here, too.
            Err(RenderError::Device { .. }) => self.discarded.add(chain),
            _ => *slot = Some(chain),
        }
        done
    }

    /// Draws a frame. The next one has its turn while the device draws this one.
    pub(super) fn draw(
        &self,
        frame: &Frame<'_>,
        outputs: &Outputs,
    ) -> Result<MappedFrame, RenderError> {
        let called = Instant::now();
        let ticket = self.queue.wait();
        // After the ticket, so that slots are taken in the order of the calls.
        let slot = self.slots.wait();
        let wait = called.elapsed();
        let turn = self.with_chain(|chain| chain.take_turn(frame, outputs, &self.cull))?;
        // The next frame is prepared while the device draws this one.
        drop(ticket);
        let waited = match turn {
            Turn::Drawn(drawn) => Waited::Drawn(drawn),
            Turn::InFlight(in_flight) => self.finish(*in_flight)?,
        };
        // The device is done with the frame, even if it must be drawn again.
        drop(slot);
        let mut drawn = match waited {
            Waited::Drawn(drawn) => drawn,
            Waited::Overflowed(needs) => {
                self.in_turn(|chain| chain.draw_again(needs, frame, outputs, &self.cull))?
            }
        };
        drawn.stats.stages_ms.insert(0, ("wait", wait.as_secs_f64() * 1e3));
        Ok(drawn)
    }

    /// Waits for a frame in flight. If its device has failed, the next frame opens it again.
    fn finish(&self, in_flight: InFlight) -> Result<Waited, RenderError> {
        let device = in_flight.device.clone();
        let waited = in_flight.wait();
        if let Err(RenderError::Device { .. }) = waited {
            let mut slot = self.chain.lock();
            // Another frame of the same device may have failed before, and the device may be open
            // again.
            if slot.as_ref().is_some_and(|chain| Arc::ptr_eq(&chain.device, &device)) {
                slot.take().into_iter().for_each(|chain| self.discarded.add(chain));
            }
        }
        waited
    }

    /// Opens the device again after it was lost.
    fn reopen(&self) -> Result<Chain, RenderError> {
        let opened =
            Device::open(&self.choice, &self.shaders, self.limits.binding_bytes, self.tuning);
        let checked = match opened {
            Ok(device) if device.info == self.info => Ok(device),
            // Another device would draw other bytes, and was not requested.
            Ok(other) => Err(format!("it was lost, and in its place is {}", other.info.name)),
            Err(error) => Err(error.to_string()),
        };
        let device = checked
            .map_err(|reason| RenderError::Device { device: self.info.name.clone(), reason })?;
        tracing::info!(device = device.info.name, "the GPU was opened again");
        Chain::new(device, self.limits.mirror_bytes)
    }
}
