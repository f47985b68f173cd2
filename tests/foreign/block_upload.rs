//! Block upload of the standard device, bootloader and application: with the frames of a client
//! that uses a protocol switch threshold, like CANopenNode, and by python-canopen, which uses none.
//! Frames from CiA 301 section 7.2.4.3.13 ff.

use canopen::Address;
use coboot_tests::bench::{Bench, NODE, REQUEST, RESPONSE};
use coboot_tests::endpoint::Endpoint;
use coboot_tests::{firmware, tools};

fn bootloader() -> Bench {
    let mut bench = Bench::new().switched_on();
    bench.run_ms(20);
    bench
}

fn application() -> Bench {
    let mut bench = bootloader();
    bench.install(firmware::APP_V1);
    bench
}

/// A request, and the device's answers.
fn ask(bench: &mut Bench, bytes: [u8; 8]) -> Vec<u8> {
    bench.ask(REQUEST, &bytes, RESPONSE).unwrap_or_else(|| panic!("no answer to {bytes:02X?}"))
}

/// Initiate block upload, client with CRC, 127 segments, threshold 21 (15h).
fn initiate(at: Address, threshold: u8) -> [u8; 8] {
    let [low, high] = at.index.to_le_bytes();
    [0xA4, low, high, at.sub, 0x7F, threshold, 0, 0]
}

#[test]
fn small_objects_come_as_an_ordinary_upload_where_the_client_has_a_threshold() {
    for (mut bench, device_type) in [(bootloader(), true), (application(), false)] {
        // Four bytes, expedited.
        let answer = ask(&mut bench, initiate(Address::new(0x1000, 0), 21));
        assert_eq!(answer[..4], [0x43, 0x00, 0x10, 0x00]);
        assert_eq!(answer[4..] == [0x00, 0x00, 0x00, 0x10], device_type);
        // One byte.
        let status = ask(&mut bench, initiate(Address::new(0x1F51, 1), 21));
        assert_eq!(status[..4], [0x4F, 0x51, 0x1F, 0x01]);
        // As many bytes as the threshold: a segmented upload.
        let name = bsp::IDENTITY.device_name.as_bytes();
        let len = name.len() as u8;
        for threshold in [len, len + 1, 255] {
            let answer = ask(&mut bench, initiate(Address::new(0x1008, 0), threshold));
            assert_eq!(answer, [0x41, 0x08, 0x10, 0x00, len, 0, 0, 0], "threshold {threshold}");
            let mut read: Vec<u8> = Vec::new();
            for toggle in (0..).map(|n| n % 2 * 0x10) {
                let segment = ask(&mut bench, [0x60 | toggle, 0, 0, 0, 0, 0, 0, 0]);
                assert_eq!(segment[0] & 0xF0, toggle);
                read.extend(&segment[1..8 - usize::from(segment[0] >> 1 & 7)]);
                if segment[0] & 1 == 1 {
                    break;
                }
            }
            assert_eq!(read, name);
        }
        // One byte more than the threshold, or no threshold: blocks, of the size, with a CRC.
        for threshold in [len - 1, 0] {
            let answer = ask(&mut bench, initiate(Address::new(0x1008, 0), threshold));
            assert_eq!(answer, [0xC6, 0x08, 0x10, 0x00, len, 0, 0, 0], "threshold {threshold}");
        }
        assert_eq!(ask(&mut bench, initiate(Address::new(0x1000, 0), 3))[..4], [0xC6, 0x00, 0x10, 0x00]);
        // An object without read access is refused in both ways.
        let absent = [0x80, 0x34, 0x12, 0x00, 0x00, 0x00, 0x02, 0x06];
        assert_eq!(ask(&mut bench, initiate(Address::new(0x1234, 0), 21)), absent);
        bench.assert_nothing_unmodelled();
    }
}

/// python-canopen, unmodified.
#[test]
fn python_canopen_reads_objects_by_block_upload() {
    for bench in [bootloader(), application()] {
        let mut endpoint = Endpoint::new(bench);
        let mut client = tools::script("block_upload_client.py");
        let said = endpoint.succeed(client.arg(endpoint.address()).arg(NODE.to_string()));
        let name: String = bsp::IDENTITY.device_name.bytes().map(|byte| format!("{byte:02x}")).collect();
        assert!(said.contains(&format!("1008h/0: {name}\n")), "{said}");
        endpoint.bench.assert_nothing_unmodelled();
    }
}
