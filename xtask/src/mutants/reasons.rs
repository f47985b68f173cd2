//! The changes that no test notices, and why.

/// The file, the change as cargo-mutants prints it behind the place, and the reason. A change that
/// stands several times in one function has one entry.
pub const REASONS: &[(&str, &str, &str)] = &[];
