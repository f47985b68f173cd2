//! The procedure of each dialect for a program.

use super::procedure::Procedure;
use super::{block, cia302, esacademy, lift};
use crate::device::Dialect;

/// The procedure of this dialect for a program.
pub(in crate::update) fn of(dialect: Dialect) -> &'static dyn Procedure {
    match dialect {
        Dialect::Block => &block::Block,
        Dialect::Raw => &cia302::Cia302(Dialect::Raw),
        Dialect::Hex => &cia302::Cia302(Dialect::Hex),
        Dialect::Lift => &lift::Lift,
        Dialect::EsAcademy => &esacademy::EsAcademy,
    }
}
