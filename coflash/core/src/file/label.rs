//! The label in an image, which names its target device and version. [`shared_abi::label`] defines
//! the format.

use std::fmt;

use shared_abi::block_file::ProgramVersion;
use shared_abi::label::{Label, OFFSET, SIZE};

use super::image::Image;

/// The label of a program that starts at `start`; `None` if it is missing or damaged.
#[must_use]
pub fn label_of(image: &Image, start: u32) -> Option<Label> {
    image.bytes::<SIZE>(start.checked_add(OFFSET)?).as_ref().and_then(Label::parse)
}

/// A label as text.
#[derive(Clone, Copy, Debug)]
pub struct Words<'l>(pub &'l Label);

impl fmt::Display for Words<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Label { vendor_id, product_code, version, .. } = self.0;
        write!(
            f,
            "vendor-ID {vendor_id:08X}h, product code {product_code:08X}h, version {}",
            ProgramVersion(*version)
        )
    }
}
