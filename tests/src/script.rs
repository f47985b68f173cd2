//! Sessions between a master and the emulated device, as candump logs in `tests/expected/`.
//!
//! The frames of the master (000, 600h + node-ID, 7E5h) are sent, and each frame of the device has
//! to be the next one that the device sends; heartbeats between them are passed over. Beside the
//! log's lines there are
//!
//! | line | what happens |
//! |---|---|
//! | `; words` | nothing |
//! | `@raw IMAGE` | the master writes the image to 1F50h/1 in one segmented SDO download |
//! | `@hex IMAGE` | the same as Intel HEX |
//! | `@part BYTES IMAGE` | the same, but the master aborts when so many bytes were acknowledged |
//! | `@wait MS` | time passes |
//! | `@idle` | the master reads 1F57h/1 until it is not busy |
//! | `@power` | off and on |
//!
//! In the data of the device's frames `..` is any byte: what differs from board to board.

use std::fs;
use std::path::Path;
use std::time::Duration;

use canopen::sdo::wire::Request;
use canopen::{AbortCode, Address};
use coflash::adapter::Adapter;
use coflash::session::{Doing, Transfers};
use emulator::time::{Span, Time};

use crate::bench::Bench;
use crate::firmware;
use crate::ihex::intel_hex;

const DATA: Address = Address::new(0x1F50, 1);
/// The longest that the device may take to answer.
const PATIENCE_MS: u64 = 3000;

/// Plays a script of `tests/expected`.
///
/// # Panics
/// Where the device does something else; the message names the line.
pub fn play(bench: &mut Bench, script: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("expected").join(script);
    let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let mut player = Player { seen: bench.time(), node: 1, bench };
    for (number, line) in (1..).zip(text.lines()) {
        let place = format!("{script}, line {number}: {line}");
        match line.trim() {
            "" => {}
            comment if comment.starts_with(';') => {}
            directive if directive.starts_with('@') => player.carry_out(directive, &place),
            frame => player.frame(frame, &place),
        }
    }
}

struct Player<'b> {
    bench: &'b mut Bench,
    /// Frames up to here were looked at.
    seen: Time,
    /// The node that was asked last.
    node: u8,
}

impl Player<'_> {
    fn frame(&mut self, line: &str, place: &str) {
        let frame = line.split_whitespace().nth(2).and_then(|frame| frame.split_once('#'));
        let (id, data) = frame.unwrap_or_else(|| panic!("{place}: this is no line of a candump log"));
        let id = u16::from_str_radix(id, 16).unwrap_or_else(|_| panic!("{place}: no identifier"));
        let bytes: Vec<Option<u8>> = (0..data.len() / 2)
            .map(|i| &data[2 * i..2 * i + 2])
            .map(|byte| (byte != "..").then(|| u8::from_str_radix(byte, 16).expect("hexadecimal digits")))
            .collect();
        if matches!(id, 0 | 0x601..=0x67F | 0x7E5) {
            if id > 0x600 && id < 0x680 {
                self.node = (id - 0x600) as u8;
            }
            self.seen = self.bench.time();
            let data: Vec<u8> =
                bytes.into_iter().map(|byte| byte.expect("the master knows what it sends")).collect();
            self.bench.post(id, &data);
        } else {
            self.expect(id.into(), &bytes, place);
        }
    }

    /// The next frame of the device; heartbeats are passed over unless one is expected.
    fn expect(&mut self, id: u32, bytes: &[Option<u8>], place: &str) {
        let deadline = self.bench.time() + Span::from_millis(PATIENCE_MS);
        loop {
            let frames = self.bench.frames_since(self.seen);
            let of_device = |(_, id, _): &&(Time, u32, Vec<u8>)| !matches!(id, 0 | 0x601..=0x67F | 0x7E5);
            for (at, found, data) in frames.iter().filter(of_device) {
                self.seen = *at;
                let matches = data.len() == bytes.len()
                    && data.iter().zip(bytes).all(|(found, byte)| byte.is_none_or(|byte| byte == *found));
                if *found == id && matches {
                    return;
                }
                let heartbeat = (0x701..=0x77F).contains(found) && data[..] != [0];
                assert!(heartbeat, "{place}: the device sent {found:03X}#{data:02X?}");
            }
            assert!(self.bench.time() < deadline, "{place}: the device is silent");
            self.bench.run_ms(1);
        }
    }

    fn carry_out(&mut self, directive: &str, place: &str) {
        let words: Vec<&str> = directive.split_whitespace().collect();
        let number = |word: &str| word.parse().unwrap_or_else(|_| panic!("{place}: no number"));
        match words[..] {
            ["@raw", image] => self.download(&firmware::raw(image)),
            ["@hex", image] => {
                let base = firmware::board().programs[0].base;
                self.download(intel_hex(base, &firmware::raw(image)).as_bytes());
            }
            ["@part", bytes, image] => self.part(&firmware::raw(image)[..number(bytes) as usize]),
            ["@wait", ms] => self.bench.run_ms(number(ms)),
            ["@idle"] => {
                let status = self.bench.session_with(self.node).await_idle(1, Doing::Read(DATA));
                assert!(status.is_ok(), "{place}: {status:?}");
            }
            ["@power"] => {
                self.bench.power_off();
                self.bench.run_ms(100);
                self.seen = self.bench.time();
                self.bench.power_on();
            }
            _ => panic!("{place}: nobody knows what that is"),
        }
        // What came meanwhile was looked at.
        if words[0] != "@power" {
            self.seen = self.bench.time();
        }
    }

    fn download(&mut self, data: &[u8]) {
        let mut session = self.bench.session_with(self.node);
        session.transfer_by(Transfers::Segments);
        session.write(DATA, data, Doing::Block(0), &mut |_| {}).expect("the device takes the program");
    }

    /// The beginning of a download, with an abort behind it.
    fn part(&mut self, data: &[u8]) {
        let (request, response) = (0x600 + u16::from(self.node), 0x580 + u32::from(self.node));
        let mut ask = |bytes: &[u8; 8], answer: [u8; 8]| {
            self.seen = self.bench.time();
            self.bench.post(request, bytes);
            self.expect(response, &answer.map(Some), "@part");
        };
        ask(&[0x20, 0x50, 0x1F, 1, 0, 0, 0, 0], [0x60, 0x50, 0x1F, 1, 0, 0, 0, 0]);
        for (i, segment) in data.chunks_exact(7).enumerate() {
            let toggle = ((i % 2) as u8) << 4;
            let mut bytes = [toggle, 0, 0, 0, 0, 0, 0, 0];
            bytes[1..].copy_from_slice(segment);
            ask(&bytes, [0x20 | toggle, 0, 0, 0, 0, 0, 0, 0]);
        }
        self.bench.post(request, &Request::Abort(DATA, AbortCode::GENERAL).emit());
        self.bench.run_ms(5);
        // The answers were looked at on the bus; no session shall take them for its own.
        while self.bench.receive(Duration::ZERO).is_ok_and(|frame| frame.is_some()) {}
    }
}
