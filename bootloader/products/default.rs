//! The product: **the only file that a product changes**. It has the settings that matter first;
//! docs/product.md has all of them. What is not named has its default.

use super::*;

/// The dialect of the tools that write programs.
const DIALECT: Profile = Profile::STANDARD;

/// The choices of this product.
pub const PRODUCT: Product = Product {
    // What starts by itself after a reset, and how long a new program is held back.
    autostart: Some(Start { programs: Autostart::InOrder, rescue_window_ms: 300, ..Start::DEFAULT }),
    // Where node-ID and bit rate come from, and which ones the device takes.
    node: Node { source: NodeSource::Stored, ids: 1..=127, bit_rates: 0..=8, ..Node::DEFAULT },
    // Whose device it is: as the board file says, or the nameplate of an OEM in the chip.
    identity: Identity { source: IdentitySource::Board, ..Identity::DEFAULT },
    // The watchdog of the bootloader, and the one that a program must feed from its start on.
    watchdog: Watchdog { bootloader_ms: Some(1000), program_ms: None },
    ..Product::of(DIALECT)
};
