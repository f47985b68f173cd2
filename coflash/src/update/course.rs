//! An update under way: what it has done to the device so far, and who hears of it.

use super::event::{DeviceState, Event};
use crate::device::flying_master::Mastership;

/// An update under way.
pub(super) struct Course<'t> {
    /// What has become of the device so far.
    pub(super) state: DeviceState,
    /// The NMT mastership, while the tool has it.
    pub(super) mastership: Option<Mastership>,
    tell: &'t mut dyn FnMut(Event),
    /// What was told already, for as long as each thing is told once.
    told: Option<Vec<Event>>,
}

impl<'t> Course<'t> {
    /// An update that has done nothing yet.
    pub(super) fn new(tell: &'t mut dyn FnMut(Event)) -> Self {
        Self { state: DeviceState::Untouched, mastership: None, tell, told: None }
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
