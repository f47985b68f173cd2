//! Places for connections. A connection that has shown the token keeps its place; of the others,
//! which may be idle, the oldest gives way to a new one.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;

use tokio::task::AbortHandle;

/// A connection: whether it has shown the token.
#[derive(Clone, Debug, Default)]
pub(super) struct Guest(Arc<AtomicBool>);

impl Guest {
    /// Notes that a request of this connection had the token.
    pub(super) fn admit(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    fn is_admitted(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// The connections that had no token when they were last looked at, the oldest first.
#[derive(Debug, Default)]
pub(super) struct Guests(VecDeque<(Guest, AbortHandle)>);

impl Guests {
    /// Adds a connection, and the task that serves it.
    pub(super) fn add(&mut self, guest: Guest, task: AbortHandle) {
        self.0.retain(|(guest, task)| !guest.is_admitted() && !task.is_finished());
        self.0.push_back((guest, task));
    }

    /// Ends the oldest connection without the token, if there is one.
    pub(super) fn dismiss_oldest(&mut self) {
        while let Some((guest, task)) = self.0.pop_front() {
            if !guest.is_admitted() && !task.is_finished() {
                return task.abort();
            }
        }
    }
}
