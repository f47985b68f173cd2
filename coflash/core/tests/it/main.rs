//! The tests of the library from outside. Its modules have the names of its parts.

/// The content of a file in `tests/data`.
macro_rules! data {
    ($name:literal) => {
        include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/", $name)).as_slice()
    };
}

mod device;
mod file;
mod machine;
mod pages;
mod tap;
mod update;
