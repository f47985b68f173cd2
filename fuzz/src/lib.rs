//! What the fuzz targets share. `cargo xtask fuzz` runs them; each says in its first lines what
//! must hold.

/// The devices and the wire of `canopen`'s own tests.
#[path = "../../canopen/tests/common/mod.rs"]
pub mod device;
/// The memory of `canopen`'s own tests of the debugger interface.
#[path = "../../canopen/tests/memory/mod.rs"]
pub mod memory;
/// The strict flash of `boot-core`'s own tests.
#[path = "../../boot-core/tests/model/mod.rs"]
pub mod model;

use canopen::node::Node;
use canopen::sdo::client::{Step, Transfer};
use canopen::sdo::SdoError;
use canopen::Instant;
use device::Device;

/// The fuzzer's bytes, taken from the front.
pub struct Input<'a>(&'a [u8]);

impl<'a> Input<'a> {
    /// All of them.
    #[must_use]
    pub fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    /// The next byte, until there is none.
    pub fn byte(&mut self) -> Option<u8> {
        let (first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(*first)
    }

    /// The next `N` bytes, until there are not so many.
    pub fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (first, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*first)
    }

    /// The next bytes, at most so many.
    pub fn take(&mut self, most: usize) -> &'a [u8] {
        let (first, rest) = self.0.split_at(most.min(self.0.len()));
        self.0 = rest;
        first
    }

    /// What is left.
    #[must_use]
    pub fn rest(self) -> &'a [u8] {
        self.0
    }
}

/// More frames than anything sends in a row: whoever sends more never comes to an end.
pub const ENDLESS: usize = 1000;

/// Fetches all frames that a node has to send.
pub fn drain(node: &mut Node, now: Instant, device: &mut Device) {
    let sent = std::iter::from_fn(|| node.poll(now, device)).take(ENDLESS).count();
    assert!(sent < ENDLESS, "the node never stops sending");
}

/// Runs a transfer to its end over a wire that loses nothing.
pub fn run(
    transfer: &mut impl Transfer,
    node: &mut Node,
    device: &mut Device,
    now: Instant,
) -> Result<(), SdoError> {
    for _ in 0..100 * ENDLESS {
        match transfer.poll(now) {
            Step::Send(frame) => {
                node.handle(&frame, now, device);
                while let Some(answer) = node.poll(now, device) {
                    transfer.handle(&answer, now);
                }
            }
            Step::Wait(_) => panic!("the transfer stands still"),
            Step::Done(result) => return result,
        }
    }
    panic!("the transfer never ends");
}
