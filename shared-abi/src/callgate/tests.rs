//! The numbers of the ABI.

use super::*;

/// The bytes of the magic in flash, and the numbers that a program in C uses (coboot.h).
#[test]
fn numbers_are_those_of_the_header() {
    assert_eq!((MAGIC, TABLE_SIZE as usize), (0x4743_4243, size_of::<Table>()));
    assert_eq!((PROGRAM_INSTALLED, PROGRAM_SIGNED), (1, 2));
    let statuses = [
        Status::Ok,
        Status::UnknownSelector,
        Status::BadPointer,
        Status::BadRange,
        Status::Busy,
        Status::Failed,
        Status::BadArgument,
        Status::NoProgram,
        Status::Locked,
        Status::Full,
    ];
    for (number, status) in statuses.into_iter().enumerate() {
        assert_eq!(status as i32, -(number as i32), "{status:?}");
    }
    let selectors = [
        Selector::Crc32,
        Selector::ReadNode,
        Selector::StoreNode,
        Selector::ProgramInfo,
        Selector::Confirm,
        Selector::Invalidate,
        Selector::Unconfirm,
    ];
    for (number, selector) in (1..).zip(selectors) {
        assert_eq!(Selector::from_number(number), Some(selector));
        assert_eq!(selector as u32, number);
    }
    assert_eq!((Selector::from_number(0), Selector::from_number(8)), (None, None));
}
