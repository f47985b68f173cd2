//! A session's attention to what it notices beside its transfers: silence is told, and somebody else
//! at the node ends what would harm both.

use std::sync::{MutexGuard, PoisonError};
use std::time::Duration;

use super::watch::{Silence, Watch, SILENCE};
use super::Session;
use crate::device::doing::Doing;
use crate::device::error::{Error, Intruder};

/// Requests of somebody else are held against the session for so long.
const FRESH: Duration = Duration::from_secs(2);
/// Another tool that is at work on a node asks it at least so often: while a sector is erased, four
/// times a second.
const LISTEN: Duration = Duration::from_millis(300);

impl<'a> Session<'a> {
    /// Tells silence to `hook` while it lasts, once each time.
    #[must_use]
    pub fn tell_silence(mut self, hook: &'a dyn Fn(Silence)) -> Self {
        self.on_silence = Some(hook);
        self
    }

    pub(super) fn watch(&self) -> MutexGuard<'_, Watch> {
        // Nobody panics while it is held; and if so, what it says is still right.
        self.watch.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How long nothing has been heard of the node: since `began` where it has never been heard.
    pub(super) fn silent_since(&self, began: Duration) -> Duration {
        let heard = self.watch().heard;
        self.now().saturating_sub(heard.unwrap_or(began))
    }

    /// Tells a silence that has lasted since `began` or longer, if it is worth it.
    pub(crate) fn note_silence(&self, began: Duration, limit: Duration, doing: Doing) {
        let Some(hook) = self.on_silence else { return };
        let silent = self.silent_since(began);
        if silent < SILENCE || silent >= limit || std::mem::replace(&mut self.watch().told, true) {
            return;
        }
        hook(Silence { node: self.node, doing, silent, limit });
    }

    /// Looks whether somebody else is at work on the node: listens for a moment, and takes what was
    /// heard in the last seconds.
    ///
    /// # Errors
    /// [`Error::NotAlone`], [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn ensure_alone(&mut self) -> Result<(), Error> {
        if self.hears_the_bus() {
            self.wait(LISTEN)?;
        }
        self.still_alone()
    }

    /// The same without listening any further.
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
