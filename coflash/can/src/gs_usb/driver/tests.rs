//! The driver against a USB stand-in, which behaves correctly or sends invalid data.

use std::collections::VecDeque;

use super::*;
use crate::health::Trouble;
use crate::tests::frame;

/// A device: the transfers that it sends, and those that it received.
#[derive(Default)]
struct Fake {
    config: Vec<u8>,
    constants: Vec<u8>,
    incoming: VecDeque<Vec<u8>>,
    controls: Vec<(u8, u16, Vec<u8>)>,
    written: Vec<Vec<u8>>,
    gone: bool,
}

/// Two channels, 48 MHz.
fn device() -> Fake {
    let words = [0, 48_000_000, 1, 16, 1, 8, 4, 1, 1024, 1_u32];
    Fake {
        config: vec![0, 0, 0, 1, 2, 0, 0, 0, 1, 0, 0, 0],
        constants: words.iter().flat_map(|word| word.to_le_bytes()).collect(),
        ..Fake::default()
    }
}

impl Usb for &mut Fake {
    fn read_control(&mut self, request: u8, _value: u16, _len: u16) -> Result<Vec<u8>, String> {
        Ok(if request == 4 { self.constants.clone() } else { self.config.clone() })
    }

    fn write_control(&mut self, request: u8, value: u16, data: &[u8]) -> Result<(), String> {
        self.controls.push((request, value, data.to_vec()));
        Ok(())
    }

    fn write(&mut self, data: &[u8]) -> Result<bool, String> {
        self.written.push(data.to_vec());
        Ok(true)
    }

    fn read(&mut self, _wait: Duration) -> Result<Option<Vec<u8>>, String> {
        match self.incoming.pop_front() {
            None if self.gone => Err("it was unplugged".to_string()),
            next => Ok(next),
        }
    }
}

fn echo(echo: u32, channel: u8) -> Vec<u8> {
    let mut bytes = vec![0; 20];
    bytes[..4].copy_from_slice(&echo.to_le_bytes());
    bytes[9] = channel;
    bytes
}

#[test]
fn a_channel_is_set_up_used_and_left() {
    let mut fake = device();
    let mut driver = GsUsb::start(&mut fake, 1, 500_000).unwrap();
    assert_eq!(driver.send(&frame(0x605, &[0x40])), Ok(Sent::Taken));
    driver.close();
    let timing = vec![6, 0, 0, 0, 7, 0, 0, 0, 2, 0, 0, 0, 1, 0, 0, 0, 6, 0, 0, 0];
    assert_eq!(
        fake.controls,
        [
            (0, 1, vec![0xEF, 0xBE, 0, 0]),
            (2, 1, vec![0; 8]),
            (1, 1, timing),
            (2, 1, vec![1, 0, 0, 0, 0, 0, 0, 0]),
            (2, 1, vec![0; 8]),
        ]
    );
    assert_eq!(fake.written, [[0, 0, 0, 0, 5, 6, 0, 0, 1, 1, 0, 0, 0x40, 0, 0, 0, 0, 0, 0, 0]]);
}

#[test]
fn a_device_takes_ten_frames_until_it_tells_that_one_was_sent() {
    let mut fake = device();
    // Three echoes: one of another channel, one that is not owed, and one that is owed.
    fake.incoming.extend([echo(3, 1), echo(77, 0), echo(3, 0)]);
    let mut driver = GsUsb::start(&mut fake, 0, 500_000).unwrap();
    let request = frame(0x605, &[]);
    for _ in 0..10 {
        assert_eq!(driver.send(&request), Ok(Sent::Taken));
    }
    for _ in 0..2 {
        assert_eq!(driver.send(&request), Ok(Sent::Full));
        assert_eq!(driver.receive(Duration::ZERO), Ok(None));
    }
    assert_eq!(driver.send(&request), Ok(Sent::Full));
    assert_eq!(driver.receive(Duration::ZERO), Ok(None));
    assert_eq!(driver.send(&request), Ok(Sent::Taken));
    assert_eq!(driver.usb.written.last().unwrap()[..4], [3, 0, 0, 0], "the echo that is free again");
}

#[test]
fn error_frames_tell_what_is_the_matter() {
    let mut fake = device();
    let mut error = vec![0xFF, 0xFF, 0xFF, 0xFF, 0x20, 0, 0, 0x20, 8, 0, 0, 0];
    error.extend([0, 0, 0, 0, 0, 0, 128, 0]);
    fake.incoming.push_back(error.clone());
    // GS_CAN_FLAG_OVERFLOW.
    error[10] = 1;
    fake.incoming.push_back(error);
    let mut driver = GsUsb::start(&mut fake, 0, 500_000).unwrap();
    for lost in [0, 1] {
        assert_eq!(driver.receive(Duration::ZERO), Ok(None));
        assert_eq!(driver.health().losses.lost, lost);
    }
    let health = driver.health();
    assert_eq!((health.trouble(), health.bit_rate), (Some(Trouble::Unacknowledged), Some(500_000)));
}

#[test]
fn a_device_that_lies_or_goes_is_named() {
    let started = |fake: &mut Fake, channel| GsUsb::start(fake, channel, 500_000).map(|_| ()).unwrap_err();
    assert_eq!(started(&mut device(), 2), "it has 2 channel(s), counted from 0");
    let lie = |change: fn(&mut Fake)| {
        let mut fake = device();
        change(&mut fake);
        fake
    };
    for (mut fake, words) in [
        (lie(|fake| fake.config.truncate(5)), "it does not report its number of channels"),
        (lie(|fake| fake.constants.truncate(39)), "it does not report its controller's timing"),
        (lie(|fake| fake.constants.fill(0)), "clock of 0 Hz cannot produce 500000 bit/s"),
        (lie(|fake| fake.constants.fill(0xFF)), "clock of 4294967295 Hz cannot produce"),
    ] {
        let error = started(&mut fake, 0);
        assert!(error.contains(words), "{error}");
    }
    for (transfer, words) in [
        (vec![0xFF; 20], "it sends a frame of 255 bytes"),
        (vec![0xFF; 3], "it sends a transfer of 3 bytes"),
        (vec![], "it sends a transfer of 0 bytes"),
    ] {
        let mut fake = device();
        // Channel 0, neither a CAN FD frame nor an error frame.
        let mut transfer = transfer;
        if transfer.len() > 10 {
            (transfer[7], transfer[9], transfer[10]) = (0, 0, 0);
        }
        fake.incoming.push_back(transfer);
        let mut driver = GsUsb::start(&mut fake, 0, 500_000).unwrap();
        assert_eq!(driver.receive(Duration::ZERO), Err(Fault::Nonsense(words.to_string())));
    }
    let mut fake = device();
    fake.gone = true;
    let mut driver = GsUsb::start(&mut fake, 0, 500_000).unwrap();
    assert_eq!(driver.receive(Duration::ZERO), Err(Fault::Lost("it was unplugged".to_string())));
}
