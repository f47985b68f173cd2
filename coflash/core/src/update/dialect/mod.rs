//! Dialects: the update procedures of different bootloaders with the same objects, one file for
//! each.
//!
//! | dialect | the program goes as | before | afterwards |
//! |---|---|---|---|
//! | [`Block`](Dialect::Block) | block file, an SDO download for each block | CLEAR | trial, release for autostart (83h), START |
//! | [`Raw`](Dialect::Raw) | image from the program's start, one download | CLEAR | START |
//! | [`Hex`](Dialect::Hex) | Intel HEX text, one download | CLEAR | START |
//! | [`EsAcademy`](Dialect::EsAcademy) | Intel HEX text, one download | password in 7F50h, which erases | it runs by itself |
//! | [`Lift`](Dialect::Lift) | image, one download, at node-ID 126 | password in 6005h, in application and bootloader | "reset program" |
//!
//! `raw` and `hex` are one procedure. The renewal of a bootloader is one more, in every
//! dialect. To add a dialect, add a row to [`Dialect`], and here a file that implements `Procedure` and
//! its lines in this file.
//! [`steps`](super::steps) has the steps that all dialects share.

use crate::device::Dialect;

mod block;
mod cia302;
mod esacademy;
mod lift;
mod procedure;
pub(super) mod renew;

pub use self::esacademy::PASSWORD as ESACADEMY_PASSWORD;
pub use self::lift::read_locked;
pub(super) use self::procedure::{Downloaded, Procedure};

/// Whether this program number is for data, which may be any bytes and are never started: all
/// programs of a lift device except its program 1 (CiA 814-1 clause 6.4).
#[must_use]
pub const fn is_data(dialect: Dialect, program: u8) -> bool {
    matches!(dialect, Dialect::Lift) && program != lift::LIFT_PROGRAM
}

/// The procedure of this dialect for a program.
pub(super) fn of(dialect: Dialect) -> &'static dyn Procedure {
    match dialect {
        Dialect::Block => &block::Block,
        Dialect::Raw => &cia302::Cia302(Dialect::Raw),
        Dialect::Hex => &cia302::Cia302(Dialect::Hex),
        Dialect::Lift => &lift::Lift,
        Dialect::EsAcademy => &esacademy::EsAcademy,
    }
}
