//! What a session notices besides its transfers: it reports silence of the node, and stops if
//! another tool uses the node.

use std::sync::{MutexGuard, PoisonError};
use std::time::Duration;

use super::watch::{Silence, Watch, SILENCE};
use super::Session;
use crate::device::doing::Doing;
use crate::device::error::{Error, Intruder};

/// How long a request of another tool counts.
const FRESH: Duration = Duration::from_secs(2);
/// Another tool that is working with a node sends requests at least this often: during the erase of
/// a sector, four times a second.
const LISTEN: Duration = Duration::from_millis(300);

impl<'a> Session<'a> {
    /// Reports silence to `hook` while it lasts, once for each silence.
    #[must_use]
    pub fn tell_silence(mut self, hook: &'a dyn Fn(Silence)) -> Self {
        self.on_silence = Some(hook);
        self
    }

    pub(super) fn watch(&self) -> MutexGuard<'_, Watch> {
        // No thread panics while it holds the lock; and if one did, the contents are still valid.
        self.watch.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How long the node has been silent; since `began` if it has never been heard.
    pub(super) fn silent_since(&self, began: Duration) -> Duration {
        let heard = self.watch().heard;
        self.now().saturating_sub(heard.unwrap_or(began))
    }

    /// Reports a silence since `began` or longer, if it is long enough.
    pub(crate) fn note_silence(&self, began: Duration, limit: Duration, doing: Doing) {
        let Some(hook) = self.on_silence else { return };
        let silent = self.silent_since(began);
        if silent < SILENCE || silent >= limit || std::mem::replace(&mut self.watch().told, true) {
            return;
        }
        hook(Silence { node: self.node, doing, silent, limit });
    }

    /// Checks whether another tool is using the node: listens for a moment, and includes the
    /// requests of the last seconds.
    ///
    /// # Errors
    /// [`Error::NotAlone`], [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn ensure_alone(&mut self) -> Result<(), Error> {
        if self.hears_the_bus() {
            self.wait(LISTEN)?;
        }
        self.still_alone()
    }

    /// The same check without listening any longer.
    ///
    /// # Errors
    /// [`Error::NotAlone`].
    pub fn still_alone(&self) -> Result<(), Error> {
        let now = self.now();
        match self.watch().foreign {
            Some((at, what)) if now.saturating_sub(at) < FRESH => {
                Err(Error::NotAlone { node: self.node, who: Intruder::Requests(what) })
            }
            _ => Ok(()),
        }
    }
}
