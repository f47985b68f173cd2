//! For the tests: a lift (CiA 417, CiA 814-1).

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product::of(Profile::LIFT);
