//! For the tests: a product whose applications write flash. Its bootloader is not renewed (docs/renewal.md).

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product { renewal: None, ..Product::DEFAULT };
