//! Writes the frames of a bus to a file in the format of `candump -L`.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use super::adapter::{Adapter, AdapterError};
use super::candump::Line;
use super::tap::Tap;

/// The function that gets the error when the file can no longer be written.
pub type OnFailure = Box<dyn FnOnce(std::io::Error) + Send>;

/// The file, and what is called once if writing to it fails.
struct Log {
    file: BufWriter<File>,
    failed: Option<OnFailure>,
}

impl Log {
    fn line(&mut self, line: &Line) {
        let Some(failed) = self.failed.take() else { return };
        match writeln!(self.file, "{line}") {
            Ok(()) => self.failed = Some(failed),
            Err(error) => failed(error),
        }
    }
}

impl Drop for Log {
    fn drop(&mut self) {
        if let (Err(error), Some(failed)) = (self.file.flush(), self.failed.take()) {
            failed(error);
        }
    }
}

/// Writes the frames of `adapter` to `path`, which is overwritten. `failed` is called if writing
/// fails later; the bus continues without the trace.
///
/// # Errors
/// [`AdapterError::Open`] if the file cannot be created.
pub fn trace<A: Adapter>(adapter: A, path: &Path, failed: OnFailure) -> Result<Tap<A>, AdapterError> {
    let file = File::create(path).map_err(|source| AdapterError::Open {
        adapter: format!("trace file {}", path.display()),
        source: source.into(),
    })?;
    let mut log = Log { file: BufWriter::new(file), failed: Some(failed) };
    let ear = move |time, frame: &canopen::Frame, _: bool| {
        log.line(&Line { time, interface: "can0".to_string(), frame: *frame });
    };
    Ok(Tap::new(adapter, Box::new(ear)))
}
