//! Work that may never end.

use std::sync::mpsc;
use std::thread;
use std::time::Duration;

/// Returns the result of `work` if it ends within `limit`. Otherwise its thread keeps running
/// without a receiver.
pub(super) fn in_time<T: Send + 'static>(
    limit: Duration,
    work: impl FnOnce() -> T + Send + 'static,
) -> Option<T> {
    let (done, result) = mpsc::sync_channel(1);
    thread::spawn(move || {
        let _ = done.send(work());
    });
    result.recv_timeout(limit).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_that_never_ends_is_given_up() {
        assert_eq!(in_time(Duration::from_secs(60), || 7), Some(7));
        let (_held, never) = mpsc::channel::<()>();
        assert_eq!(in_time(Duration::from_millis(10), move || never.recv()), None);
        // Work that panics gives no result either.
        assert_eq!(in_time::<()>(Duration::from_secs(60), || std::panic::resume_unwind(Box::new(()))), None);
    }
}
