//! The value of a variable.

/// The longest variable or string, in bytes. A longer value must be a domain. (A signature with the
/// signed data, 2002h, has 76 bytes.)
pub const VALUE_MAX: usize = 80;
