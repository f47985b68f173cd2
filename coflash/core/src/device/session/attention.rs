//! What a session notices besides its transfers: it reports silence of the node, and stops if
//! another tool uses the node.

use std::sync::{MutexGuard, PoisonError};
use std::time::Duration;

use super::watch::{Silence, Watch, LISTEN, SILENCE};
use super::Session;
use crate::device::doing::Doing;
use crate::device::error::{Error, Intruder};

/// How long a request of another tool counts.
const FRESH: Duration = Duration::from_secs(2);
/// The answers of two devices to one request come within this time: a frame on the slowest bus takes 13 ms.
const ANSWERS: Duration = Duration::from_millis(30);
/// How long to wait for a moment without requests of others: the start-up procedure of a CANopen
/// master (CiA 302-2) is some ten reads, each of which may take a few hundred milliseconds.
const PEACE: Duration = Duration::from_secs(3);

impl<'a> Session<'a> {
    /// Reports silence to `hook` while it lasts, once for each silence.
    #[must_use]
    pub fn report_silence(mut self, hook: &'a dyn Fn(Silence)) -> Self {
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
        if silent < SILENCE || silent >= limit || std::mem::replace(&mut self.watch().reported, true) {
            return;
        }
        hook(Silence { doing, silent, limit });
    }

    /// Checks whether another tool is using the node: listens for a moment, in which the time counts
    /// that the session has listened already, and includes the requests of the last seconds.
    ///
    /// # Errors
    /// [`Error::NotAlone`], [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn ensure_alone(&mut self) -> Result<(), Error> {
        if self.hears_the_bus() {
            let now = self.now();
            let heard = now.saturating_sub(self.watch().began.unwrap_or(now));
            self.wait(LISTEN.saturating_sub(heard))?;
        }
        self.still_alone()
    }

    /// Waits until nobody else has sent a request to the node for a moment, counted from its boot-up
    /// after `called`. A CANopen master reads 1000h and 1018h of each node that boots up (CiA 302-2),
    /// and is then done; another tool goes on, or commands the bootloader.
    ///
    /// # Errors
    /// [`Error::NotAlone`] at once after such a command, otherwise after some seconds; [`Error::Adapter`] or [`Error::Cancelled`].
    pub(crate) fn await_peace(&mut self, called: Duration) -> Result<(), Error> {
        if !self.hears_the_bus() {
            return Ok(());
        }
        let began = self.now();
        loop {
            let (booted, foreign) = self.watch().boot_up_and_requests();
            let booted = booted.filter(|at| *at >= called).unwrap_or(began);
            let last = foreign.map_or(booted, |(at, _)| at.max(booted));
            let left = (last + LISTEN).saturating_sub(self.now());
            if left.is_zero() && !self.is_commanded_since(called) {
                // What was asked for before is done.
                self.watch().foreign = None;
                return Ok(());
            }
            if self.is_commanded_since(called) || self.now() >= began + PEACE {
                let what = foreign.and_then(|(_, what)| what);
                return Err(Error::NotAlone { node: self.node, who: Intruder::Requests(what) });
            }
            self.wait(left)?;
        }
    }

    /// Whether another tool has written a program or a command to the node since this time.
    pub(crate) fn is_commanded_since(&self, time: Duration) -> bool {
        self.watch().commanded.is_some_and(|at| at >= time)
    }

    /// Whether a second device has answered a read of this session: listens for the answers that may still
    /// be on their way.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn is_answered_twice(&mut self) -> Result<bool, Error> {
        self.wait(ANSWERS)?;
        Ok(self.watch().is_twice)
    }

    /// The check of [`ensure_alone`](Self::ensure_alone) without listening any longer.
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
