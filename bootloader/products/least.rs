//! For the tests: all options that a product may switch off are off.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product {
    autostart: Autostart::List(&[]),
    rescue_window_ms: 0,
    auto_bit_rate: false,
    boot_up_emergency: false,
    watchdog_ms: None,
    renewal: false,
    lss: false,
    crystal_failure: CrystalFailure::RunFromHsi,
    block_download: false,
    block_upload: false,
    second_server: false,
    resume: false,
    ..Product::DEFAULT
};
