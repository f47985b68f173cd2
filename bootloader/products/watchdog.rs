//! For the tests: a program must feed the watchdog from its first instruction on.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product =
    Product { watchdog: Watchdog { program_ms: Some(1000), ..Watchdog::DEFAULT }, ..Product::DEFAULT };
