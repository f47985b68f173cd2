//! For the tests: all options that a product may switch off are off.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product {
    autostart: None,
    node: Node { auto_bit_rate: false, ..Node::DEFAULT },
    nmt: Nmt { boot_up_emergency: false, ..Nmt::DEFAULT },
    watchdog: Watchdog { bootloader_ms: None, ..Watchdog::DEFAULT },
    renewal: None,
    lss: None,
    sdo: Sdo { block_upload: false, ..Sdo::DEFAULT },
    block_download: None,
    download: Download { resume: false, ..Download::DEFAULT },
    ..Product::DEFAULT
};
