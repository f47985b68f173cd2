//! A board whose watchdog chip ends a program that hangs, by the pin NRST.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product {
    autostart: Some(Start { pin_resets_are_crashes: true, ..Start::DEFAULT }),
    ..Product::DEFAULT
};
