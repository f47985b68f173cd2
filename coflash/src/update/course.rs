//! An update under way: what it has done to the device so far, and who hears of it.

use super::event::Event;
use super::left::DeviceState;
use crate::device::flying_master::Mastership;

/// An update under way.
pub(super) struct Course<'t> {
    /// What has become of the device so far.
    pub(super) state: DeviceState,
    /// Whether anything was done that might have changed the device.
    pub(super) touched: bool,
    /// What it was before the erasure.
    pub(super) resting: DeviceState,
    /// What 1F56h read before the erasure, where it was asked.
    pub(super) before: Option<u32>,
    /// Whether any of the new program may be in the device.
    pub(super) wrote: bool,
    /// The NMT mastership, while the tool has it.
    pub(super) mastership: Option<Mastership>,
    tell: &'t mut dyn FnMut(Event),
    /// What was told already, for as long as each thing is told once.
    told: Option<Vec<Event>>,
}

impl<'t> Course<'t> {
    /// An update that has done nothing yet.
    pub(super) fn new(tell: &'t mut dyn FnMut(Event)) -> Self {
        Self {
            state: DeviceState::Untouched,
            touched: false,
            resting: DeviceState::Untouched,
            before: None,
            wrote: false,
            mastership: None,
            tell,
            told: None,
        }
    }

    /// The erasure is about to begin; 1F56h reads this before it, where it was asked.
    pub(super) fn erases(&mut self, before: Option<u32>) {
        self.touched = true;
        if self.state != DeviceState::Erased {
            self.resting = std::mem::replace(&mut self.state, DeviceState::Erased);
            self.before = before;
        }
    }

    /// It was refused, so that nothing is erased.
    pub(super) fn erases_not(&mut self) {
        if !self.wrote {
            self.state = self.resting;
        }
    }

    /// Tells what happens.
    pub(super) fn tell(&mut self, event: Event) {
        if let Some(told) = &mut self.told {
            if told.contains(&event) {
                return;
            }
            told.push(event.clone());
        }
        (self.tell)(event);
    }

    /// From now on each thing is told once, or, again, as often as it happens.
    pub(super) fn tell_once(&mut self, once: bool) {
        self.told = once.then(Vec::new);
    }
}
