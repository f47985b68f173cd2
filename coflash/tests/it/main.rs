//! The tests of the host tool from outside: as a library, and as a program. Its modules have the
//! names of its parts.

/// The content of a file in `tests/data`.
macro_rules! data {
    ($name:literal) => {
        include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/", $name)).as_slice()
    };
}

mod agent;
mod can;
mod cli;
mod device;
mod fake;
mod file;
mod machine;
mod tool;
mod ui;
mod update;
