//! The replacement of `image` in a device without sealed images.

use shared_abi::layout::Layout;

use crate::flash::Flash;
use crate::policy::Policy;
use crate::queue::Piece;
use crate::store::{Parameters, ProgramRecord};

/// An empty state.
#[derive(Debug, Default)]
pub struct Room;

impl Room {
    /// An empty state.
    #[must_use]
    pub const fn new() -> Self {
        Self
    }

    /// The interface to it.
    pub fn unsealer(&mut self) -> Unsealer<'_> {
        Unsealer(core::marker::PhantomData)
    }
}

/// The interface without sealed images.
#[derive(Debug)]
pub struct Unsealer<'b>(core::marker::PhantomData<&'b mut Room>);

#[allow(clippy::unused_self, reason = "the interface is that of `image`")]
impl Unsealer<'_> {
    pub(crate) fn attach<F: Flash>(
        &mut self,
        _: &F,
        _: &impl Parameters,
        _: &'static Layout,
        _: &'static Policy,
    ) {
    }
    pub(crate) fn takes_no_other(&self) -> bool {
        false
    }
    pub(crate) fn rest(&mut self) {}
    pub(crate) fn is_active(&self) -> bool {
        false
    }
    pub(crate) fn waits(&self) -> bool {
        true
    }
    pub(crate) fn is_same(&self) -> bool {
        false
    }
    pub(crate) fn piece(&self) -> Option<Piece> {
        None
    }
    pub(crate) fn data(&self, _: usize) -> u8 {
        0
    }
    pub(crate) fn written(&mut self) {}
    pub(crate) fn mark(&self, record: ProgramRecord) -> ProgramRecord {
        record
    }
}
