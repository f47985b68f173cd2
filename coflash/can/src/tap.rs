//! A bus with a listener.

use std::fmt;
use std::time::Duration;

use canopen::Frame;

use super::adapter::{Adapter, AdapterError};
use super::health::Health;

/// A function that gets the bus time and each frame, sent or received.
pub type Ear = Box<dyn FnMut(Duration, &Frame) + Send>;

/// An adapter that reports its frames, sent and received, to a function.
pub struct Tap<A> {
    adapter: A,
    ear: Ear,
}

impl<A> fmt::Debug for Tap<A> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Tap").finish_non_exhaustive()
    }
}

impl<A: Adapter> Tap<A> {
    /// Reports the frames of `adapter` to `ear`.
    pub fn new(adapter: A, ear: Ear) -> Self {
        Self { adapter, ear }
    }
}

impl<A: Adapter> Adapter for Tap<A> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        self.adapter.send(frame)?;
        (self.ear)(self.adapter.now(), frame);
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let frame = self.adapter.receive(timeout)?;
        if let Some(frame) = &frame {
            (self.ear)(self.adapter.now(), frame);
        }
        Ok(frame)
    }

    fn now(&self) -> Duration {
        self.adapter.now()
    }

    fn health(&mut self) -> Option<Health> {
        self.adapter.health()
    }
}
