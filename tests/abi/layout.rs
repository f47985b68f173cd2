//! The ABI between bootloader, application and tools, byte for byte.

use std::mem::{align_of, offset_of, size_of};

use shared_abi::callgate::{self, Crc32Args};
use shared_abi::geometry::{Region, OTP};
use shared_abi::handoff::{BootInfo, Handoff, ResetCause, SdoBases};
use shared_abi::nameplate::{self, Nameplate};
use shared_abi::warm_start::{BootRequest, Owed, WarmStart};

/// The bytes of a structure in RAM. (The host is little-endian, like the chip.)
fn bytes<T: Copy>(value: &T) -> Vec<u8> {
    const { assert!(cfg!(target_endian = "little")) };
    // SAFETY: `T` is one of the ABI's `repr(C)` structures without padding (the sizes are checked
    // in these tests).
    unsafe { std::slice::from_raw_parts(std::ptr::from_ref(value).cast(), size_of::<T>()) }.to_vec()
}

/// The check words below come from an implementation of the fold in another language.
#[test]
fn warm_start_cell_byte_for_byte() {
    assert_eq!((size_of::<WarmStart>(), align_of::<WarmStart>()), (16, 4));
    assert_eq!(offset_of!(WarmStart, magic), 0);
    assert_eq!(offset_of!(WarmStart, request), 4);
    assert_eq!(offset_of!(WarmStart, argument), 8);
    assert_eq!(offset_of!(WarmStart, check), 12);
    #[rustfmt::skip]
    let cells: [(BootRequest, [u8; 16]); 6] = [
        (BootRequest::Stay, [b'C', b'B', b'W', b'1', 1, 0, 0, 0, 0, 0, 0, 0, 0xF0, 0xB7, 0x28, 0xD9]),
        (BootRequest::Trial(1), [b'C', b'B', b'W', b'1', 2, 0, 0, 0, 1, 0, 0, 0, 0xCD, 0x59, 0x20, 0xE5]),
        (BootRequest::Start(1), [b'C', b'B', b'W', b'1', 3, 0, 0, 0, 1, 0, 0, 0, 0xF9, 0x81, 0xE0, 0x52]),
        (BootRequest::Fresh(1), [b'C', b'B', b'W', b'1', 9, 0, 0, 0, 1, 0, 0, 0, 0x5F, 0xD5, 0xAC, 0xE8]),
        // STOP of program 1, sent to node 5; CLEAR of program 2, sent to node 127.
        (BootRequest::Owed(Owed { program: 1, value: 0, node_id: 5 }),
         [b'C', b'B', b'W', b'1', 7, 0, 0, 0, 1, 0, 5, 0, 0x56, 0xAA, 0x9D, 0xE8]),
        (BootRequest::Owed(Owed { program: 2, value: 3, node_id: 127 }),
         [b'C', b'B', b'W', b'1', 7, 0, 0, 0, 2, 3, 127, 0, 0xA5, 0x7F, 0x86, 0xCC]),
    ];
    for (request, expected) in cells {
        assert_eq!(bytes(&WarmStart::new(request)), expected);
    }
}

#[test]
fn handoff_byte_for_byte() {
    assert_eq!((size_of::<Handoff>(), align_of::<Handoff>()), (48, 4));
    let offsets = [
        (offset_of!(Handoff, magic), 0),
        (offset_of!(Handoff, version), 4),
        (offset_of!(Handoff, length), 6),
        (offset_of!(Handoff, node_id), 8),
        (offset_of!(Handoff, program), 9),
        (offset_of!(Handoff, reset_cause), 10),
        (offset_of!(Handoff, trial), 11),
        (offset_of!(Handoff, bit_rate), 12),
        (offset_of!(Handoff, bootloader_version), 16),
        (offset_of!(Handoff, serial_number), 20),
        (offset_of!(Handoff, flags), 24),
        (offset_of!(Handoff, bootloader_number), 28),
        (offset_of!(Handoff, sdo_request_base), 32),
        (offset_of!(Handoff, sdo_response_base), 34),
        (offset_of!(Handoff, program_date), 36),
        (offset_of!(Handoff, reserved), 40),
        (offset_of!(Handoff, check), 44),
    ];
    for (actual, expected) in offsets {
        assert_eq!(actual, expected);
    }
    let handoff = Handoff::new(&BootInfo {
        node_id: 5,
        bit_rate: 125_000,
        program: 1,
        reset_cause: ResetCause::Software,
        trial: true,
        fresh: true,
        bootloader_version: 0x0001_0002,
        serial_number: 0xDEAD_BEEF,
        bootloader_number: Some(2),
        sdo: SdoBases { request: 0x680, response: 0x480 },
        program_date: 1_795_804_215,
        nameplate: true,
    });
    #[rustfmt::skip]
    let expected = [
        b'C', b'B', b'H', b'O', 5, 0, 48, 0,
        5, 1, 3, 1, 0x48, 0xE8, 0x01, 0x00,
        0x02, 0x00, 0x01, 0x00, 0xEF, 0xBE, 0xAD, 0xDE,
        3, 0, 0, 0, 2, 0, 0, 0, 0x80, 6, 0x80, 4, 0x37, 0xCC, 0x09, 0x6B, 0, 0, 0, 0,
        0xD4, 0x71, 0x22, 0x61,
    ];
    assert_eq!(bytes(&handoff), expected);
}

/// The check words come from the same implementation in another language.
#[test]
fn nameplate_byte_for_byte() {
    assert_eq!((size_of::<Nameplate>(), align_of::<Nameplate>()), (32, 4));
    assert_eq!(offset_of!(Nameplate, magic), 0);
    assert_eq!(offset_of!(Nameplate, vendor_id), 4);
    assert_eq!(offset_of!(Nameplate, product_code), 8);
    assert_eq!(offset_of!(Nameplate, revision), 12);
    assert_eq!(offset_of!(Nameplate, serial_number), 16);
    assert_eq!(offset_of!(Nameplate, reserved), 20);
    assert_eq!(offset_of!(Nameplate, check), 28);
    // RM0090 table 19: blocks of 32 bytes from 1FFF_7800h on, the last at 1FFF_79E0h.
    assert_eq!((OTP.base, OTP.end(), nameplate::BLOCKS), (0x1FFF_7800, 0x1FFF_7A00, 16));
    let [mut with, mut without] = [[0; 32]; 2];
    for (made, plate) in [(&mut with, 123_456), (&mut without, 0)] {
        let words = Nameplate::new(0x123, 0x5EA1_0007, 0x0002_0003, plate).words();
        made.copy_from_slice(words.map(u32::to_le_bytes).as_flattened());
    }
    #[rustfmt::skip]
    assert_eq!(with, [
        b'C', b'B', b'N', b'P', 0x23, 0x01, 0, 0, 0x07, 0, 0xA1, 0x5E, 3, 0, 2, 0,
        0x40, 0xE2, 0x01, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xFE, 0x3F, 0x2A, 0x54,
    ]);
    #[rustfmt::skip]
    assert_eq!(without, [
        b'C', b'B', b'N', b'P', 0x23, 0x01, 0, 0, 0x07, 0, 0xA1, 0x5E, 3, 0, 2, 0,
        0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xEC, 0x22, 0x54, 0x33,
    ]);
}

#[test]
fn callgate_byte_for_byte() {
    type Table = callgate::Table<u32>;
    assert_eq!(size_of::<Table>(), callgate::TABLE_SIZE as usize);
    assert_eq!(offset_of!(Table, magic), 0);
    assert_eq!(offset_of!(Table, abi_version), 4);
    assert_eq!(offset_of!(Table, length), 6);
    assert_eq!(offset_of!(Table, bootloader_version), 8);
    assert_eq!(offset_of!(Table, entry), 12);
    assert_eq!(size_of::<Crc32Args>(), 12);
    assert_eq!(offset_of!(Crc32Args, address), 0);
    assert_eq!(offset_of!(Crc32Args, len), 4);
    assert_eq!(offset_of!(Crc32Args, crc), 8);
    assert_eq!(callgate::Selector::Crc32 as u32, 1);
}

/// The memory map of the design, typed again: the only second copy of these numbers.
#[test]
fn the_layout_of_the_stm32f407_is_the_documented_one() {
    let layout = &shared_abi::layout::stm32f407g_disc1::LAYOUT;
    assert_eq!(layout.bootloader, Region::new(0x0800_0000, 0x4000));
    assert_eq!(layout.home, Some(Region::new(0x0801_0000, 0x1_0000)));
    assert_eq!(layout.data, Some(Region::new(0x0800_C000, 0x4000)));
    assert_eq!(layout.staging, Some(Region::new(0x080E_0000, 0x2_0000)));
    assert_eq!(layout.callgate(), 0x0800_0040);
    assert_eq!(layout.parameters, [Region::new(0x0800_4000, 0x4000), Region::new(0x0800_8000, 0x4000)]);
    assert_eq!(layout.programs, [Region::new(0x0802_0000, 896 * 1024)]);
    assert_eq!(layout.ram, Region::new(0x2000_0000, 128 * 1024 - 64));
    assert_eq!(layout.handoff, Region::new(0x2001_FFC0, 48));
    assert_eq!(layout.warm_start, Region::new(0x2001_FFF0, 16));
}
