//! A bus with a listener.

use std::fmt;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use canopen::Frame;

use super::adapter::{passes_on, Adapter, AdapterError};
use super::health::{Health, Losses};

/// A function that gets each frame: the wall clock since 1970, the frame, and whether this tool has
/// sent it.
pub type Ear = Box<dyn FnMut(Duration, &Frame, bool) + Send>;

/// The wall clock, since 1970.
#[must_use]
pub fn wall() -> Duration {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
}

/// An adapter that reports its frames, sent and received, to a function.
pub struct Tap<A> {
    adapter: A,
    /// The wall clock at the adapter's origin of time.
    origin: Duration,
    ear: Ear,
}

impl<A> fmt::Debug for Tap<A> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Tap").field("origin", &self.origin).finish_non_exhaustive()
    }
}

impl<A: Adapter> Tap<A> {
    /// Reports the frames of `adapter` to `ear`.
    pub fn new(adapter: A, ear: Ear) -> Self {
        let origin = wall().saturating_sub(adapter.now());
        Self { adapter, origin, ear }
    }

    fn note(&mut self, frame: &Frame, own: bool) {
        (self.ear)(self.origin + self.adapter.now(), frame, own);
    }
}

impl<A: Adapter> Adapter for Tap<A> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        self.adapter.send(frame)?;
        self.note(frame, true);
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let frame = self.adapter.receive(timeout)?;
        if let Some(frame) = &frame {
            self.note(frame, false);
        }
        Ok(frame)
    }

    passes_on!(this => this.adapter);
}
