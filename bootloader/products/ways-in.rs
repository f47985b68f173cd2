//! For the tests: a board without an entry strap has other ways into a bootloader.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product =
    Product { ways_in: WaysIn { two_resets: true, rom_loader: true }, ..Product::DEFAULT };
