//! For the tests: the dialect of port's Paulus.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product::of(Profile::PAULUS);
