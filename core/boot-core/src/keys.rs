//! Whether the device takes sealed images, and whether it has keys and therefore accepts and starts no
//! others.

use seal::key_block::{COUNTER, EPOCH};
use shared_abi::layout::Layout;
use shared_abi::renewal::BOOTLOADER;

use crate::flash::Flash;
use crate::store::{Key, Parameters};

/// A proof that the code for sealed images is linked. Without the feature `sealed` this type has no value:
/// then the compiler leaves out all code that needs one. No other line depends on the feature.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Linked {
    /// It is.
    #[cfg(feature = "sealed")]
    Yes,
}

impl Linked {
    /// The proof, if there is one.
    pub(crate) const PROOF: Option<Self> = {
        #[cfg(feature = "sealed")]
        let proof = Some(Self::Yes);
        #[cfg(not(feature = "sealed"))]
        let proof = None;
        proof
    };
}

/// What only a device that takes sealed images has: in any other device there is none, and without the
/// feature the compiler knows it.
pub(crate) struct OfSealed<'b, T>(Option<&'b mut T>);

impl<'b, T> OfSealed<'b, T> {
    pub(crate) fn new(state: Option<&'b mut T>) -> Self {
        Self(state)
    }

    /// The state, if there is one.
    pub(crate) fn get(&self) -> Option<&T> {
        Linked::PROOF.and(self.0.as_deref())
    }

    /// See [`get`](Self::get).
    pub(crate) fn get_mut(&mut self) -> Option<&mut T> {
        Linked::PROOF.and(self.0.as_deref_mut())
    }
}

/// The images that a device takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Images {
    /// Plain ones: it knows no sealed ones.
    Plain,
    /// Both: it has no keys yet.
    Both(Linked),
    /// Sealed ones alone.
    Sealed(Linked),
}

impl Images {
    /// The proof, if sealed images are among them.
    pub(crate) fn sealed(self) -> Option<Linked> {
        match self {
            Self::Plain => None,
            Self::Both(linked) | Self::Sealed(linked) => Some(linked),
        }
    }

    /// The proof, if plain images are refused.
    pub(crate) fn only_sealed(self) -> Option<Linked> {
        match self {
            Self::Sealed(linked) => Some(linked),
            Self::Plain | Self::Both(_) => None,
        }
    }
}

/// Whether the place of the key block (`seal::key_block`) is not empty, unless the holder of a root
/// key has opened the device permanently. A damaged key block does not open the device: no image
/// passes the checks then. A bootloader without sealed images ignores keys.
pub fn is_sealed<F: Flash>(flash: &F, parameters: &impl Parameters, layout: &Layout) -> bool {
    if Linked::PROOF.is_none() {
        return false;
    }
    let [_, opened, ..] = parameters.get(flash, Key::GRANTS).unwrap_or([0; 4]);
    opened == 0 && !flash.is_blank(layout.key_block())
}

/// The lowest security counter of an image for this program, and the lowest epoch of its key, that the
/// device accepts.
pub(crate) fn floor<F: Flash>(
    flash: &F,
    parameters: &impl Parameters,
    layout: &Layout,
    lowest: u32,
    program: u8,
) -> (u32, u32) {
    let block = layout.key_block().base;
    let is_sound = is_sound(flash, block);
    let word = |at: usize| if is_sound { flash.read_word(block + at as u32) } else { 0 };
    let counters = |program| parameters.get(flash, Key::counter(program)).unwrap_or([0; 4]);
    // The epoch is the device's: a key that is revoked for one program signs for none.
    let programs = layout.programs.len() as u8;
    let epoch = (1..=programs).chain([BOOTLOADER]).fold(word(EPOCH), |epoch, program| {
        let [_, proved, ..] = counters(program);
        epoch.max(proved)
    });
    // A program that has proved itself has raised the counter, if the policy raises it at
    // confirmation.
    let [mut counter, _, installed, _] = counters(program);
    if program == BOOTLOADER {
        // It counts by itself.
        return (counter, epoch);
    }
    if parameters.program(flash, program).is_some_and(|record| record.confirmed) {
        counter = counter.max(installed);
    }
    (counter.max(word(COUNTER)).max(lowest), epoch)
}

/// Whether the key block is valid.
pub fn is_sound<F: Flash>(flash: &F, key_block: u32) -> bool {
    use seal::key_block::{CHECK, MAGIC};
    use shared_abi::geometry::Region;

    flash.read_word(key_block) == u32::from_le_bytes(MAGIC)
        && flash.crc32(0, Region::new(key_block, CHECK as u32)) == flash.read_word(key_block + CHECK as u32)
}
