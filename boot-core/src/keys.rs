//! Whether the device has keys, which make it take and start sealed programs alone.

use shared_abi::layout::Layout;

use crate::flash::Flash;
#[cfg(feature = "sealed")]
use crate::store::Key;
use crate::store::Parameters;

/// Whether anything stands in the key block's place (`seal::key_block`), unless the holder of a root
/// key has opened the device for good. A key block that is damaged does not open it: then no image
/// passes.
#[cfg(feature = "sealed")]
pub fn is_sealed<F: Flash>(flash: &F, parameters: &impl Parameters, layout: &Layout) -> bool {
    let [_, opened, ..] = parameters.get(flash, Key::Grants).unwrap_or([0; 4]);
    opened == 0 && !flash.is_blank(layout.key_block())
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
pub fn is_sealed<F: Flash>(_: &F, _: &impl Parameters, _: &Layout) -> bool {
    false
}
