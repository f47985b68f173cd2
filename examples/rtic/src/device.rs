//! The device that the program is for.

use coboot_app::layout::Layout;

/// 1018h/1 to 3: those of the bootloader.
pub const VENDOR_ID: u32 = 0;
pub const PRODUCT_CODE: u32 = 0x4007_D151;
pub const REVISION: u32 = 0x0001_0000;

/// Where everything is on this board: `build.rs` names it.
pub static LAYOUT: Layout = coboot_app::layout!();
