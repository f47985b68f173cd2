//! The callgate with an entry point of this test, which is what the bootloader has on the chip.

use core::ffi::c_void;

use shared_abi::layout::stm32f407g_disc1::LAYOUT;

use super::*;

const GOOD: Table =
    Table { magic: MAGIC, abi_version: 1, length: 16, bootloader_version: 0x0001_0000, entry: 0x0800_0211 };

/// The services as a bootloader offers them, with one answer for each.
///
/// # Safety
/// `args` must be the structure that the selector takes.
unsafe extern "C" fn services(selector: u32, args: *mut c_void) -> i32 {
    // SAFETY: the caller passes this structure; the same for those below.
    let crc = || unsafe { &mut *args.cast::<Crc32Args>() };
    // SAFETY: as above.
    let node = || unsafe { &mut *args.cast::<NodeArgs>() };
    // SAFETY: as above.
    let program = || unsafe { &mut *args.cast::<ProgramArgs>() };
    match selector {
        1 => match *crc() {
            Crc32Args { address: 0x0801_0000, len: 9, crc: 0 } => {
                // The check value of CRC-32/ISO-HDLC.
                crc().crc = 0xCBF4_3926;
                0
            }
            _ => -3,
        },
        2 => {
            *node() = NodeArgs { node_id: 42, bit_rate: 250_000 };
            0
        }
        3 => match *node() {
            NodeArgs { node_id: 7, bit_rate: 500_000 } => 0,
            _ => -6,
        },
        4 => match *program() {
            ProgramArgs { number: 2, size: 0, crc: 0, version: 0, flags: 0 } => {
                *program() = ProgramArgs { number: 2, size: 4096, crc: 5, version: 6, flags: 3 };
                0
            }
            _ => -6,
        },
        // Confirm knows program 1 alone, invalidate program 2 alone.
        5 if program().number == 1 => 0,
        6 if program().number == 2 => 0,
        5 | 6 => -7,
        _ => -1,
    }
}

impl Enter for Entry {
    fn enter(self, selector: Selector, args: *mut c_void) -> Option<i32> {
        // SAFETY: `services` is the only entry here; `Callgate` passes what it takes.
        Some(unsafe { self(selector as u32, args) })
    }
}

fn gate() -> Callgate<Entry> {
    Callgate::check(Table {
        magic: MAGIC,
        abi_version: 1,
        length: 16,
        bootloader_version: 0x0001_0000,
        entry: services as Entry,
    })
    .unwrap()
}

#[test]
fn each_service_passes_its_arguments_and_returns_its_results() {
    let gate = gate();
    assert_eq!(gate.crc32(0x0801_0000, 9), Ok(0xCBF4_3926));
    assert_eq!(gate.read_node(), Ok(NodeArgs { node_id: 42, bit_rate: 250_000 }));
    assert_eq!(gate.store_node(NodeArgs { node_id: 7, bit_rate: 500_000 }), Ok(()));
    let record = ProgramArgs { number: 2, size: 4096, crc: 5, version: 6, flags: 3 };
    assert_eq!(gate.program_info(2), Ok(record));
    assert_eq!(gate.confirm(1), Ok(()));
    assert_eq!(gate.invalidate(2), Ok(()));
}

#[test]
fn a_refusal_is_told_with_its_code() {
    let gate = gate();
    let refused = |status: Status| CallgateError::Refused(status as i32);
    assert_eq!(gate.crc32(0x2000_0000, 9), Err(refused(Status::BadRange)));
    assert_eq!(
        gate.store_node(NodeArgs { node_id: 0, bit_rate: 500_000 }),
        Err(refused(Status::BadArgument))
    );
    assert_eq!(gate.program_info(3), Err(refused(Status::BadArgument)));
    assert_eq!(gate.confirm(2), Err(refused(Status::NoProgram)));
    assert_eq!(gate.invalidate(1), Err(refused(Status::NoProgram)));
}

#[test]
fn a_program_of_the_host_has_no_callgate() {
    assert_eq!(Callgate::find(&LAYOUT).unwrap_err(), CallgateError::Absent);
    assert_eq!(Callgate::check(GOOD).unwrap().read_node(), Err(CallgateError::Absent));
}
