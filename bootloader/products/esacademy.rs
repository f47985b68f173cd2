//! For the tests: the dialect of ESAcademy.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product::of(Profile::ESACADEMY);
