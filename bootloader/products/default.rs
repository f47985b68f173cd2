//! The product: **the only file that a product changes**. Name the fields that differ from the
//! default. `src/product.rs` has all fields with their meaning.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product { ..Product::DEFAULT };
