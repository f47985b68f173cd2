//! Listens to a bus without a session.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use canopen::Frame;

use super::error::Error;
use coboot_can::Adapter;

/// Receives for `time`, or until `enough` returns true.
///
/// # Errors
/// [`Error::Adapter`] or [`Error::Cancelled`].
pub fn listen(
    adapter: &mut dyn Adapter,
    time: Duration,
    cancelled: &Arc<AtomicBool>,
    enough: &mut dyn FnMut(&Frame) -> bool,
) -> Result<(), Error> {
    let deadline = adapter.now() + time;
    while adapter.now() < deadline {
        if cancelled.load(Ordering::Relaxed) {
            return Err(Error::Cancelled);
        }
        let left = deadline.saturating_sub(adapter.now());
        if let Some(frame) = adapter.receive(left.min(Duration::from_millis(100)))? {
            if enough(&frame) {
                return Ok(());
            }
        }
    }
    Ok(())
}
