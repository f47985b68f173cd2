//! Reads, checks, converts and writes firmware files, without a device or a bus.

pub mod area;
pub mod block_file;
pub mod checksum;
pub use coboot_linker::board;
pub mod convert;
pub mod elf;
pub mod factory;
pub mod fault;
pub mod foreign;
pub mod ihex;
pub mod image;
pub mod inspect;
pub mod judge;
pub mod label;
pub mod limit;
pub mod nameplate;
mod note;
pub mod program;
pub mod ram_image;
mod range;
pub mod raw;
pub mod read;
pub mod sealed;
pub mod srec;
pub(crate) mod text;

pub use self::block_file::BlockFile;
pub use self::convert::{convert, program_of};
pub use self::fault::{Cause, FileError, Place, ReadError};
pub use self::image::Image;
pub use self::note::Note;
pub use self::program::{Program, Target};
pub use self::range::AddressRange;
pub use self::read::{load, read, Firmware, Format};
