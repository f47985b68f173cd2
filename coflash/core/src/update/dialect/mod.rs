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
//! dialect. To add a dialect, add a row to [`Dialect`], and here
//! a file that implements `Procedure` and a line in `each.rs`.
//! [`steps`](super::steps) has the steps that all dialects share.

use super::payload::Payload;
use crate::device::Dialect;

mod block;
mod cia302;
mod each;
mod esacademy;
mod lift;
mod procedure;
mod renew;
mod restart;
mod whole;

pub(super) use self::each::of;
pub use self::esacademy::PASSWORD as ESACADEMY_PASSWORD;
pub use self::lift::read_locked;
pub(super) use self::procedure::{Downloaded, Procedure};

/// Whether this program number is for data, which may be any bytes and are never started: all
/// programs of a lift device except its program 1 (CiA 814-1 clause 6.4).
#[must_use]
pub const fn is_data(dialect: Dialect, program: u8) -> bool {
    matches!(dialect, Dialect::Lift) && program != lift::LIFT_PROGRAM
}

/// The procedure for this payload in this dialect.
pub(super) fn procedure(file: &Payload, dialect: Dialect) -> &'static dyn Procedure {
    if file.is_bootloader() {
        &renew::Renew
    } else {
        of(dialect)
    }
}
