//! Writes the frames of a bus to a file in the format of `candump -L`.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use canopen::Frame;

use super::adapter::{Adapter, AdapterError};
use super::candump::Line;
use super::health::Health;

/// An adapter that writes its frames, sent and received, to a file.
pub struct Trace<A> {
    adapter: A,
    file: BufWriter<File>,
    /// The wall clock at the adapter's origin of time.
    origin: Duration,
    /// Called once if writing to the file fails. The bus continues without the trace.
    failed: Option<OnFailure>,
}

/// The function that gets the error when the file can no longer be written.
pub type OnFailure = Box<dyn FnOnce(std::io::Error) + Send>;

impl<A> std::fmt::Debug for Trace<A> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Trace").field("origin", &self.origin).finish_non_exhaustive()
    }
}

impl<A: Adapter> Trace<A> {
    /// Writes the frames of `adapter` to `path`, which is overwritten. `failed` is called if
    /// writing fails later.
    ///
    /// # Errors
    /// [`AdapterError::Open`] if the file cannot be created.
    pub fn new(adapter: A, path: &Path, failed: OnFailure) -> Result<Self, AdapterError> {
        let file = File::create(path).map_err(|source| AdapterError::Open {
            adapter: format!("trace file {}", path.display()),
            source,
        })?;
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let origin = wall.saturating_sub(adapter.now());
        Ok(Self { adapter, file: BufWriter::new(file), origin, failed: Some(failed) })
    }

    fn note(&mut self, frame: &Frame) {
        let time = self.origin + self.adapter.now();
        let line = Line { time, interface: "can0".to_string(), frame: *frame };
        let Some(failed) = self.failed.take() else { return };
        match writeln!(self.file, "{line}") {
            Ok(()) => self.failed = Some(failed),
            Err(error) => failed(error),
        }
    }
}

impl<A> Drop for Trace<A> {
    fn drop(&mut self) {
        if let (Err(error), Some(failed)) = (self.file.flush(), self.failed.take()) {
            failed(error);
        }
    }
}

impl<A: Adapter> Adapter for Trace<A> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        self.adapter.send(frame)?;
        self.note(frame);
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let frame = self.adapter.receive(timeout)?;
        if let Some(frame) = &frame {
            self.note(frame);
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
