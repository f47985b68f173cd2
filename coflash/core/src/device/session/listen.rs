//! What a session receives on the bus, and what it sends besides SDO.

use std::sync::atomic::Ordering;
use std::time::Duration;

use canopen::nmt::{parse_boot_up, NmtCommand};
use canopen::{CobId, Frame, NodeId};

use super::watch::Watch;
use super::{Access, Session};
use crate::device::doing::Doing;
use crate::device::error::{of_gateway, Error};

/// The longest single wait: a cancelled session notices within this time.
pub(super) const SLICE: Duration = Duration::from_millis(100);

/// A wait that takes so much longer than it may: the computer has slept.
const SLEEP: Duration = Duration::from_secs(10);

impl Session<'_> {
    /// Waits on the bus. Frames that arrive are ignored.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn wait(&mut self, time: Duration) -> Result<(), Error> {
        self.listen(time, |_| false).map(|_| ())
    }

    /// Receives all frames on the bus for `time`.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn observe(&mut self, time: Duration, heard: &mut dyn FnMut(&Frame)) -> Result<(), Error> {
        self.listen(time, |frame| {
            heard(frame);
            false
        })
        .map(|_| ())
    }

    /// Receives all frames on the bus until `enough` returns true, for at most `time`; returns
    /// whether it did.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn observe_until(
        &mut self,
        time: Duration,
        enough: &mut dyn FnMut(&Frame) -> bool,
    ) -> Result<bool, Error> {
        self.listen(time, enough)
    }

    /// Waits for the node's boot-up message for at most `time`; returns whether it came.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn await_boot_up(&mut self, time: Duration) -> Result<bool, Error> {
        let boot_up = Frame::of(CobId::heartbeat(self.node), &[0]);
        self.listen(time, |frame| *frame == boot_up)
    }

    /// The time of the node's last boot-up message, if it came at `began` or later.
    pub(crate) fn booted_since(&mut self, began: Duration) -> Option<Duration> {
        self.watch().boot_up_and_requests().0.filter(|at| *at >= began)
    }

    /// Another node that has sent a boot-up message at `began` or later: the last one.
    pub(crate) fn booted_elsewhere_since(&mut self, began: Duration) -> Option<NodeId> {
        let elsewhere = self.watch().elsewhere;
        elsewhere.filter(|(at, _)| *at >= began).map(|(_, node)| node)
    }

    /// Waits for the end of a program that has started at `first`, for at most `time`: another boot-up
    /// message of the node, or an emergency for its software; returns whether it came.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub(crate) fn await_end(&mut self, first: Duration, time: Duration) -> Result<bool, Error> {
        let deadline = self.now() + time;
        loop {
            let Watch { booted, failed, .. } = *self.watch();
            if booted.is_some_and(|at| at > first) || failed.is_some_and(|at| at >= first) {
                return Ok(true);
            }
            let left = deadline.saturating_sub(self.now());
            if left.is_zero() {
                return Ok(false);
            }
            // A frame may be the end.
            self.listen(left, |_| true)?;
        }
    }

    /// Waits for the boot-up message of any other node for at most `time`; returns the node.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn await_boot_up_of_another(&mut self, time: Duration) -> Result<Option<NodeId>, Error> {
        let (this, mut other) = (self.node, None);
        self.listen(time, |frame| {
            other = parse_boot_up(frame).filter(|node| *node != this);
            other.is_some()
        })?;
        Ok(other)
    }

    /// Makes the node restart by network management (NMT reset node). NMT has no answer.
    ///
    /// # Errors
    /// [`Error::Adapter`].
    pub fn reset_node(&mut self) -> Result<(), Error> {
        let node = self.node;
        match &mut self.access {
            Access::Bus(adapter) => {
                Ok(adapter.send(&Frame::of(CobId::NMT, &[NmtCommand::ResetNode as u8, node.get()]))?)
            }
            Access::Gateway(gateway) => {
                gateway.reset_node(node).map_err(|error| of_gateway(error, node, Doing::Restart))
            }
        }
    }

    /// Sends a frame that is not SDO. A gateway carries no such frames, and the method does nothing
    /// there.
    ///
    /// # Errors
    /// [`Error::Adapter`].
    pub fn send(&mut self, frame: &Frame) -> Result<(), Error> {
        match &mut self.access {
            Access::Bus(adapter) => adapter.send(frame)?,
            Access::Gateway(_) => return Ok(()),
        }
        self.watch().sent(frame, self.node);
        Ok(())
    }

    /// Returns the next frame from the bus. Frames that need an answer of
    /// [`answer_by`](Self::answer_by) are answered here. A gateway reports only boot-up messages.
    pub(super) fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, Error> {
        let began = self.now();
        let frame = self.receive_now(began, timeout)?;
        let beyond = self.now().saturating_sub(began + timeout);
        if beyond > SLEEP {
            // The device did not have this time for its answer.
            self.slept.fetch_add(beyond.as_millis() as u64, Ordering::Relaxed);
        }
        Ok(frame)
    }

    fn receive_now(&mut self, began: Duration, timeout: Duration) -> Result<Option<Frame>, Error> {
        let adapter = match &mut self.access {
            Access::Bus(adapter) => adapter,
            Access::Gateway(gateway) => {
                let booted = gateway.wait(timeout);
                let booted = booted.map_err(|error| of_gateway(error, self.node, Doing::Restart))?;
                if let Some(booted) = booted {
                    self.watch().heard_boot_up(booted, self.node, self.now());
                }
                return Ok(booted.map(|node| Frame::of(CobId::heartbeat(node), &[0])));
            }
        };
        let frame = adapter.receive(timeout)?;
        if let (Some(answer), Some(frame)) = (self.answer, &frame) {
            if let Some(answer) = answer(frame) {
                adapter.send(&answer)?;
            }
        }
        self.watch().began.get_or_insert(began);
        if let Some(frame) = &frame {
            self.watch().received(frame, self.node, self.now());
        }
        Ok(frame)
    }

    /// Receives until `enough` returns true, for at most `time`; returns whether it did.
    pub(super) fn listen(
        &mut self,
        time: Duration,
        mut enough: impl FnMut(&Frame) -> bool,
    ) -> Result<bool, Error> {
        let deadline = self.now() + time;
        loop {
            self.check_cancelled()?;
            let left = deadline.saturating_sub(self.now());
            if let Some(frame) = self.receive(left.min(SLICE))? {
                if enough(&frame) {
                    return Ok(true);
                }
            }
            if self.now() >= deadline {
                return Ok(false);
            }
        }
    }
}
