//! The two forms of a program that goes in one download.

use std::borrow::Cow;

use crate::file::{ihex, Program};

/// The contents of the flash, from the program's start on.
pub(super) fn raw(program: &Program) -> Cow<'_, [u8]> {
    program.flash_image()
}

/// Intel HEX text.
pub(super) fn hex(program: &Program) -> Cow<'_, [u8]> {
    ihex::emit(program.image()).into_bytes().into()
}
