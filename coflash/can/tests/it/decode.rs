//! Frames in words. The frames are written by hand from CiA 301 and CiA 305.

use canopen::Frame;
use coboot_can::candump::Line;
use coboot_can::decode::Decoder;
use proptest::prelude::*;

fn frame(text: &str) -> Frame {
    Line::parse(&format!("(0.0) can0 {text}")).unwrap().unwrap().frame
}

/// Frames in their order, each with its description.
#[track_caller]
fn says(dialogue: &[(&str, &str)]) {
    let mut decoder = Decoder::new();
    for (text, words) in dialogue {
        assert_eq!(decoder.decode(&frame(text)), *words, "{text}");
    }
}

#[test]
fn network_management() {
    says(&[
        ("000#8105", "NMT to node 5: reset node"),
        ("000#8200", "NMT to all nodes: reset communication"),
        ("000#0105", "NMT to node 5: start"),
        ("000#FF05", "NMT to node 5: unknown command FFh"),
        ("000#81", "NMT of 1 bytes, not 2"),
        ("705#00", "node 5: boot-up"),
        ("705#7F", "node 5: heartbeat, pre-operational"),
        ("705#33", "node 5: heartbeat with unknown state 33h"),
        ("705#", "node 5: heartbeat of 0 bytes, not 1"),
        ("080#", "SYNC"),
        ("100#", "TIME"),
        (
            "085#1081110000100000",
            "node 5: EMCY 8110h (CAN overrun, frames were lost), error register 11h, detail 00 00 10 00 00",
        ),
        (
            "085#0000000000000000",
            "node 5: EMCY 0000h (no error any more), error register 00h, detail 00 00 00 00 00",
        ),
        ("185#", "node 5: TPDO1"),
        ("205#", "node 5: RPDO1"),
        ("4FF#", "node 127: TPDO4"),
        ("57F#", "node 127: RPDO4"),
        ("780#", "unknown identifier"),
        ("00000601#", "29-bit identifier: not CANopen"),
        ("705#R1", "remote frame of 1 bytes"),
    ]);
}

#[test]
fn sdo_expedited_and_in_segments() {
    says(&[
        ("605#4000100000000000", "to node 5: read 1000h/0 (device type)"),
        ("585#4300100000000010", "node 5: 1000h/0 (device type) is 10000000h (bootloader)"),
        ("605#2F511F0103000000", "to node 5: write 1F51h/1 (program control) = 03h (clear)"),
        ("585#60511F0100000000", "node 5: 1F51h/1 (program control) is taken"),
        ("605#40571F0100000000", "to node 5: read 1F57h/1 (flash status)"),
        ("585#43571F0101000000", "node 5: 1F57h/1 (flash status) is 00000001h (busy)"),
        (
            "585#43571F010C000000",
            "node 5: 1F57h/1 (flash status) is 0000000Ch (an address lies outside the program's flash)",
        ),
        (
            "585#8000200000000206",
            "node 5: abort 2000h/0: 06020000h (object does not exist in the object dictionary)",
        ),
        ("605#4008100000000000", "to node 5: read 1008h/0 (device name)"),
        ("585#410810000A000000", "node 5: 1008h/0 (device name) has 10 bytes in segments"),
        ("605#6000000000000000", "to node 5: read on of 1008h/0 (device name)"),
        ("585#0041424344454647", "node 5: read segment of 1008h/0 (device name): 41 42 43 44 45 46 47"),
        ("585#1948494A00000000", "node 5: read segment of 1008h/0 (device name), the last one: 48 49 4A"),
        ("605#21501F010A000000", "to node 5: write 1F50h/1 (program data), 10 bytes in segments"),
        ("605#0001020304050607", "to node 5: write segment of 1F50h/1 (program data): 01 02 03 04 05 06 07"),
        ("585#2000000000000000", "node 5: segment of 1F50h/1 (program data) is taken"),
        ("606#0001020304050607", "to node 6: write segment of an unknown object: 01 02 03 04 05 06 07"),
        ("605#E000000000000000", "to node 5: SDO request with unknown command E0h"),
        ("605#40", "to node 5: SDO request of 1 bytes, not 8"),
    ]);
}

/// Segments of a block have no command: one with number 40h looks like "initiate upload".
#[test]
fn sdo_blocks() {
    says(&[
        ("605#C6501F010F000000", "to node 5: write 1F50h/1 (program data), 15 bytes as blocks"),
        ("585#A4501F0102000000", "node 5: 1F50h/1 (program data) may come, 2 segments at a time"),
        ("605#0140100000000000", "to node 5: block segment 1: 40 10 00 00 00 00 00"),
        ("605#0241100000000000", "to node 5: block segment 2: 41 10 00 00 00 00 00"),
        ("585#A201020000000000", "node 5: segments up to 1 have arrived, 2 may follow"),
        ("605#0141100000000000", "to node 5: block segment 1: 41 10 00 00 00 00 00"),
        ("605#8242000000000000", "to node 5: block segment 2, the last one: 42 00 00 00 00 00 00"),
        ("585#A202020000000000", "node 5: segments up to 2 have arrived, 2 may follow"),
        ("605#D934120000000000", "to node 5: end of blocks of 1F50h/1 (program data), CRC 1234h"),
        ("585#A100000000000000", "node 5: blocks of 1F50h/1 (program data) are taken"),
        ("605#40571F0100000000", "to node 5: read 1F57h/1 (flash status)"),
        // An upload, which the server ends in the middle of the segments.
        ("605#A4501F0103150000", "to node 5: read 1F50h/1 (program data) as blocks of 3 segments"),
        ("585#C6501F0100010000", "node 5: 1F50h/1 (program data) has 256 bytes as blocks"),
        ("605#A300000000000000", "to node 5: start of blocks"),
        ("585#0140100000000000", "node 5: block segment 1: 40 10 00 00 00 00 00"),
        (
            "585#80501F0120000008",
            "node 5: abort 1F50h/1 (program data): 08000020h (data cannot be transferred or stored)",
        ),
        ("585#4300100000000010", "node 5: 1000h/0 (device type) is 10000000h (bootloader)"),
    ]);
}

#[test]
fn layer_setting_services() {
    says(&[
        ("7E5#0401000000000000", "LSS master: all devices to configuration"),
        ("7E5#1105000000000000", "LSS master: take node-ID 5"),
        ("7E4#1100000000000000", "LSS slave: node-ID is taken"),
        ("7E5#1300040000000000", "LSS master: take bit rate 4 of table 0"),
        ("7E4#1301000000000000", "LSS slave: bit rate is refused, error 1"),
        ("7E5#15F4010000000000", "LSS master: change over to the bit rate after 500 ms"),
        ("7E5#403F000000000000", "LSS master: select vendor-ID 0000003Fh"),
        ("7E5#51EFBEADDE1F0303", "LSS master: fastscan: serial number DEADBEEFh down to bit 31, then part 3"),
        ("7E5#5100000000800000", "LSS master: fastscan: who has no node-ID?"),
        ("7E4#4F00000000000000", "LSS slave: here"),
        ("7E4#5EFF000000000000", "LSS slave: no node-ID"),
        ("7E5#5100000000000900", "LSS master: fastscan: unknown part 00000000h down to bit 0, then part 0"),
        ("7E4#11", "LSS of 1 bytes, not 8"),
    ]);
}

proptest! {
    #[test]
    fn any_frames_have_words(
        frames in prop::collection::vec(
            (prop::sample::select(vec![0u16, 0x80, 0x85, 0x585, 0x605, 0x705, 0x7E4, 0x7E5, 0x7FF]),
             prop_oneof![prop::collection::vec(any::<u8>(), 0..9),
                 (prop::sample::select(vec![0xC6u8, 0xA4, 0xA2, 0xA3, 0xC1, 0xA1]), any::<[u8; 7]>())
                     .prop_map(|(first, rest)| [&[first][..], &rest].concat())]),
            0..40,
        ),
    ) {
        let mut decoder = Decoder::new();
        for (id, data) in frames {
            let frame = Frame::of(canopen::CobId::new(id).unwrap(), &data);
            prop_assert!(!decoder.decode(&frame).is_empty());
        }
    }
}
