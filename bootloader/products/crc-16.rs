//! For the tests: CRC-16.

use super::*;

/// The choices of this product. The step is so large that the tests see the cost of a long
/// computation.
pub const PRODUCT: Product = Product {
    download: Download { crc: CrcKind::Crc16, crc_step: 64 * 1024, ..Download::DEFAULT },
    ..Product::DEFAULT
};
