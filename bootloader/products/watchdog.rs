//! For the tests: a program must feed the watchdog from its first instruction on.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product { program_watchdog_ms: Some(1000), ..Product::DEFAULT };
