//! Whether the device has keys, which make it take and start sealed programs alone.

use shared_abi::layout::Layout;

use crate::flash::Flash;

/// Whether anything stands in the key block's place (`seal::key_block`). A key block that is damaged
/// does not open the device: then no image passes.
#[cfg(feature = "sealed")]
pub fn has_key_block<F: Flash>(flash: &F, layout: &Layout) -> bool {
    !flash.is_blank(layout.key_block())
}

/// Whether the key block there is sound.
#[cfg(feature = "sealed")]
pub fn is_sound<F: Flash>(flash: &F, key_block: u32) -> bool {
    use seal::key_block::{CHECK, MAGIC};
    use shared_abi::geometry::Region;

    flash.read_word(key_block) == u32::from_le_bytes(MAGIC)
        && flash.crc32(0, Region::new(key_block, CHECK as u32)) == flash.read_word(key_block + CHECK as u32)
}

/// No key means anything to a bootloader without sealed images.
#[cfg(not(feature = "sealed"))]
pub fn has_key_block<F: Flash>(_: &F, _: &Layout) -> bool {
    false
}
