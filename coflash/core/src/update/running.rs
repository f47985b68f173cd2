//! A running update: what it has done to the device, and the function that gets its events.

use std::cell::RefCell;

use canopen::NodeId;
use coboot_can::Losses;

use super::device_after::DeviceState;
use super::event::{Event, Note, Phase, Warning};
use super::options::FlashOptions;
use crate::device::flying_master::{self, Mastership};
use crate::device::{Dialect, Doing, Error, Session};

/// Carries out `work` in a session that reports silence of the node as an event.
pub(super) fn reporting_silence<R>(
    session: &mut Session<'_>,
    on_event: &mut dyn FnMut(Event),
    work: impl FnOnce(&mut Session<'_>, &mut dyn FnMut(Event)) -> R,
) -> R {
    let on_event = RefCell::new(on_event);
    let silence = |silence| (on_event.borrow_mut())(Warning::Silent(silence).into());
    let mut on_event = |event| (on_event.borrow_mut())(event);
    let (node, timing) = (session.node(), *session.timing());
    work(&mut session.with(node, timing).report_silence(&silence), &mut on_event)
}

/// Gives the NMT mastership back. The result of the update remains, even if this fails.
pub(super) fn give_back(session: &mut Session<'_>, taken: Mastership, on_event: &mut dyn FnMut(Event)) {
    if let Ok(master) = flying_master::give_back(session, taken) {
        on_event(match master {
            Some(master) => Note::MasterBack { node: master.node }.into(),
            None => Warning::MasterMissing.into(),
        });
    }
}

/// What is known of a device, over all attempts of one order: it outlives each change of strategy.
#[derive(Clone, Copy, Debug)]
pub struct Known {
    /// The state of the device so far.
    pub(super) state: DeviceState,
    /// Whether any action may have changed the device.
    pub(super) touched: bool,
    /// The state before the erase.
    pub(super) state_before: DeviceState,
    /// The value of 1F56h before the erase, if it was read.
    pub(super) before: Option<u32>,
    /// Whether the device has not acknowledged the erase yet, or has postponed it and has acknowledged no data
    /// since then.
    pub(super) postponed: bool,
    /// Whether the device may contain a part of the new program, or has lost the old one for it.
    pub(super) wrote: bool,
}

impl Default for Known {
    /// Nothing was done.
    fn default() -> Self {
        let state = DeviceState::Untouched;
        Self { state, touched: false, state_before: state, before: None, postponed: false, wrote: false }
    }
}

impl Known {
    /// Of a device with which an earlier attempt has begun, of which nothing else is known.
    #[must_use]
    pub fn begun() -> Self {
        Self { state: DeviceState::Begun, ..Self::default() }
    }

    /// The state of the device so far.
    #[must_use]
    pub const fn state(&self) -> DeviceState {
        self.state
    }
}

/// A running update.
pub(super) struct RunningUpdate<'t> {
    /// What the user wants.
    pub(super) options: FlashOptions,
    /// The node at its start: a lift's bootloader has another one.
    pub(super) original: NodeId,
    /// The dialect of the bootloader, as far as it is known.
    pub(super) dialect: Dialect,
    /// What is known of the device.
    pub(super) known: &'t mut Known,
    /// The program that was called back to the bootloader for this update.
    pub(super) called: Option<u8>,
    /// What had not gone through the adapter when a program was started, to be watched.
    pub(super) losses: Option<Losses>,
    /// The value of 1F56h, once it was read and is that of the file.
    pub(super) verified: Option<u32>,
    /// Whether the program has passed its trial run.
    pub(super) tried: bool,
    /// The NMT mastership, while the tool holds it.
    pub(super) mastership: Option<Mastership>,
    /// The devices with which it gets its data together, as reported.
    together: usize,
    /// Whether it was reported that somebody else uses a COB-ID of the group.
    disturbed: bool,
    on_event: &'t mut dyn FnMut(Event),
    /// The events that were reported, if each event is reported only once.
    reported: Option<Vec<Event>>,
}

impl<'t> RunningUpdate<'t> {
    /// An attempt to update this node.
    pub(super) fn new(
        original: NodeId,
        options: FlashOptions,
        known: &'t mut Known,
        on_event: &'t mut dyn FnMut(Event),
    ) -> Self {
        Self {
            options,
            original,
            dialect: Dialect::Block,
            known,
            called: None,
            losses: None,
            verified: None,
            tried: false,
            mastership: None,
            together: 0,
            disturbed: false,
            on_event,
            reported: None,
        }
    }

    /// Records that the application is called back: this program runs, if the device says which one.
    pub(super) fn calls(&mut self, running: Option<u8>) {
        let known = &mut *self.known;
        // A program that runs is complete, whatever an earlier attempt was about to do.
        let runs = running == Some(self.options.program) && known.state == DeviceState::Erased;
        if runs || matches!(known.state, DeviceState::Untouched | DeviceState::Begun) {
            (known.state, known.wrote) = (DeviceState::Called, false);
        }
    }

    /// The result of what has started a program: no verdict on it are a silence in which the adapter failed,
    /// and a watch that a restart of the adapter has interrupted.
    ///
    /// # Errors
    /// [`Error::NoVerdict`], and that of `result`.
    pub(super) fn verdict<R>(&self, session: &Session<'_>, result: Result<R, Error>) -> Result<R, Error> {
        let losses = self.losses.map_or(Losses::default(), |before| session.losses().since(before));
        let is_open = match &result {
            Ok(_) => losses.restarts > 0,
            Err(error) => losses != Losses::default() && error.is_silence(),
        };
        if is_open {
            return Err(Error::NoVerdict { node: session.node(), losses });
        }
        result
    }

    /// Records that the erase is about to start; `before` is the value of 1F56h, if it was read.
    pub(super) fn erases(&mut self, before: Option<u32>) {
        let known = &mut *self.known;
        known.touched = true;
        if known.state != DeviceState::Erased {
            known.state_before = std::mem::replace(&mut known.state, DeviceState::Erased);
            // Until the device has said that it is done, it may have its program.
            (known.before, known.postponed) = (before, before != Some(0));
        } else if before == Some(0) && known.before.is_some_and(|crc| crc != 0) {
            // An earlier attempt has erased it.
            (known.wrote, known.postponed) = (true, false);
        }
    }

    /// Records the failure of the erase, or of what it needs. If the device has refused that, it has erased
    /// nothing; one that refuses a question after it may have.
    pub(super) fn erase_failed(&mut self, error: &Error) {
        let is_question = matches!(error, Error::Refused { doing: Doing::Read(_), .. });
        let is_refused = error.is_refusal() && !is_question || matches!(error, Error::NotInDialect { .. });
        if is_refused && self.known.state == DeviceState::Erased && !self.known.wrote {
            self.known.state = self.known.state_before;
        }
    }

    /// The state as far as it is known without an answer of the device.
    pub(super) fn last_known(&self) -> DeviceState {
        match self.known.state {
            DeviceState::Erased if self.known.postponed => DeviceState::Postponed,
            state => state,
        }
    }

    /// Reports an event.
    pub(super) fn report(&mut self, event: Event) {
        match &event {
            Event::Phase(Phase::Erased { postponed: Some(postponed), .. }) => {
                self.known.postponed = *postponed && !self.known.wrote
            }
            Event::Phase(Phase::Verified { crc } | Phase::VerifiedAgain { crc }) => {
                self.verified = Some(*crc)
            }
            Event::Phase(Phase::TrialPassed(_)) => self.tried = true,
            Event::Note(Note::Together { devices }) if self.together == *devices => return,
            Event::Note(Note::Together { devices }) => self.together = *devices,
            Event::Warning(Warning::GroupDisturbed) if std::mem::replace(&mut self.disturbed, true) => return,
            Event::Warning(Warning::BeginsAgain { .. }) => (self.together, self.disturbed) = (0, false),
            _ => {}
        }
        if let Some(reported) = &mut self.reported {
            if reported.contains(&event) {
                return;
            }
            reported.push(event.clone());
        }
        (self.on_event)(event);
    }

    /// Sets whether repeated events are reported only once.
    pub(super) fn report_once(&mut self, once: bool) {
        self.reported = once.then(Vec::new);
    }
}
