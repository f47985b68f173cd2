//! Sessions between a master and the emulated device, as candump logs in `tests/expected/`.
//!
//! The frames of the master (000, 600h + node-ID, 7E5h) are sent, and each frame of the device must
//! be the next one that the device sends; heartbeats between them are ignored. There are also these
//! lines:
//!
//! | line | what happens |
//! |---|---|
//! | `; words` | nothing |
//! | `@raw IMAGE` | the master writes the image to 1F50h/1 in one segmented SDO download |
//! | `@hex IMAGE` | the same as Intel HEX |
//! | `@hex IMAGE PROGRAM` | the same to 1F50h/PROGRAM |
//! | `@part BYTES IMAGE` | the same, but the master aborts after this many acknowledged bytes |
//! | `@wait MS` | time passes |
//! | `@idle` | the master reads 1F57h/1 until it is not busy |
//! | `@power` | off and on |
//!
//! In the data of the device's frames, `..` is any byte: a value that differs between boards. A
//! letter after F and a digit, for example `s0`, is a named byte: any byte the first time, and the
//! same byte from then on, also in the master's frames. `p0` is the highest sub-index of
//! 1F50h: the number of programs of the board, and one more where the bootloader can be renewed.
//!
//! The frames are on the CAN bus, or are text on a board's UART: see [`Wire`].

use std::collections::HashMap;
use std::fs;
use std::path::Path;

use canopen::sdo::wire::Request;
use canopen::{AbortCode, Address};
use coflash_core::device::{Doing, Session, Transfers};
use emulator::time::{Span, Time};
use shared_abi::layout::Layout;
use shared_abi::renewal;

use crate::bench::Bench;
use crate::firmware;
use kit::ihex::intel_hex;

const DATA: Address = Address::new(0x1F50, 1);
/// The longest time for an answer of the device.
const PATIENCE_MS: u64 = 3000;

/// The connection between the master of a session and the device.
pub trait Wire {
    /// The bench of the device.
    fn bench(&mut self) -> &mut Bench;
    /// Switches the device off and on.
    fn power_cycle(&mut self) {
        self.bench().power_cycle();
    }
    /// Runs for this time.
    fn run_ms(&mut self, ms: u64);
    /// Sends a frame of the master, and does not wait.
    fn send(&mut self, id: u16, data: &[u8]);
    /// The frames that began at or after this time, as end, identifier and data.
    fn frames_since(&self, from: Time) -> Vec<(Time, u32, Vec<u8>)>;
    /// A host's session with a node.
    fn session_with(&mut self, node: u8) -> Session<'_>;
}

impl Wire for Bench {
    fn bench(&mut self) -> &mut Bench {
        self
    }

    fn run_ms(&mut self, ms: u64) {
        self.run_ms(ms);
    }

    fn send(&mut self, id: u16, data: &[u8]) {
        self.post(id, data);
    }

    fn frames_since(&self, from: Time) -> Vec<(Time, u32, Vec<u8>)> {
        self.frames_since(from)
    }

    fn session_with(&mut self, node: u8) -> Session<'_> {
        // Frames that arrived were checked on the bus; a session must not take them for its
        // answers.
        self.forget_received();
        self.session_with(node)
    }
}

/// Runs a script of `tests/expected`.
///
/// # Panics
/// If the device behaves differently; the message contains the line.
pub fn play(bench: &mut Bench, script: &str) {
    play_on(bench, script, firmware::board(), &|image| image.to_owned());
}

/// The same on any wire, with a board of any layout. `image` returns the file for the name of an
/// image in the script.
///
/// # Panics
/// As [`play`].
pub fn play_on(wire: &mut dyn Wire, script: &str, board: &Layout, image: &dyn Fn(&str) -> String) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("expected").join(script);
    let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let programs = board.programs.len() as u8;
    let highest = board.staging.map_or(programs, |_| renewal::number(programs, None));
    let named = HashMap::from([("p0".to_owned(), highest)]);
    let mut player = Player { seen: wire.bench().time(), node: 1, wire, board, image, named };
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
    wire: &'b mut dyn Wire,
    board: &'b Layout,
    image: &'b dyn Fn(&str) -> String,
    /// The frames up to here were checked.
    seen: Time,
    /// The last addressed node.
    node: u8,
    /// The named bytes.
    named: HashMap<String, u8>,
}

/// A byte in the data of a frame.
enum Byte {
    Is(u8),
    Any,
    Named(String),
}

impl Byte {
    fn parse(text: &str) -> Self {
        match text.as_bytes() {
            b".." => Self::Any,
            [b'g'..=b'z', b'0'..=b'9'] => Self::Named(text.to_owned()),
            _ => Self::Is(u8::from_str_radix(text, 16).expect("hexadecimal digits")),
        }
    }
}

impl Player<'_> {
    fn frame(&mut self, line: &str, place: &str) {
        let frame = line.split_whitespace().nth(2).and_then(|frame| frame.split_once('#'));
        let (id, data) = frame.unwrap_or_else(|| panic!("{place}: this is no line of a candump log"));
        let id = u16::from_str_radix(id, 16).unwrap_or_else(|_| panic!("{place}: no identifier"));
        let bytes: Vec<Byte> = (0..data.len() / 2).map(|i| Byte::parse(&data[2 * i..2 * i + 2])).collect();
        if matches!(id, 0 | 0x601..=0x67F | 0x7E5) {
            if id > 0x600 && id < 0x680 {
                self.node = (id - 0x600) as u8;
            }
            self.seen = self.wire.bench().time();
            let known =
                |byte: &Byte| self.value(byte).unwrap_or_else(|| panic!("{place}: the master knows it not"));
            let data: Vec<u8> = bytes.iter().map(known).collect();
            self.wire.send(id, &data);
        } else {
            self.expect(id.into(), &bytes, place);
        }
    }

    /// The expected value of a byte; `None` for any value.
    fn value(&self, byte: &Byte) -> Option<u8> {
        match byte {
            Byte::Is(byte) => Some(*byte),
            Byte::Any => None,
            Byte::Named(name) => self.named.get(name).copied(),
        }
    }

    /// The next frame of the device; heartbeats are skipped unless one is expected.
    fn expect(&mut self, id: u32, bytes: &[Byte], place: &str) {
        let deadline = self.wire.bench().time() + Span::from_millis(PATIENCE_MS);
        loop {
            let frames = self.wire.frames_since(self.seen);
            let of_device = |(_, id, _): &&(Time, u32, Vec<u8>)| !matches!(id, 0 | 0x601..=0x67F | 0x7E5);
            for (at, found, data) in frames.iter().filter(of_device) {
                self.seen = *at;
                let fits = |(found, byte): (&u8, &Byte)| self.value(byte).is_none_or(|byte| byte == *found);
                if *found == id && data.len() == bytes.len() && data.iter().zip(bytes).all(fits) {
                    for (found, byte) in data.iter().zip(bytes) {
                        if let Byte::Named(name) = byte {
                            self.named.insert(name.clone(), *found);
                        }
                    }
                    return;
                }
                let heartbeat = (0x701..=0x77F).contains(found) && data[..] != [0];
                assert!(heartbeat, "{place}: the device sent {found:03X}#{data:02X?}");
            }
            assert!(self.wire.bench().time() < deadline, "{place}: the device is silent");
            self.wire.run_ms(1);
        }
    }

    /// The bytes of an image, and the address of the first.
    fn program(&self, number: u8, image: &str) -> (u32, Vec<u8>) {
        let base = self.board.program(number).expect("a program of the board").base;
        (base, firmware::raw_from(base, &(self.image)(image)))
    }

    fn carry_out(&mut self, directive: &str, place: &str) {
        let words: Vec<&str> = directive.split_whitespace().collect();
        let number = |word: &str| word.parse().unwrap_or_else(|_| panic!("{place}: no number"));
        match words[..] {
            ["@raw", image] => self.download(1, &self.program(1, image).1),
            ["@hex", image] => self.hex(1, image),
            ["@hex", image, program] => self.hex(number(program) as u8, image),
            ["@part", bytes, image] => self.part(&self.program(1, image).1[..number(bytes) as usize]),
            ["@wait", ms] => self.wire.run_ms(number(ms)),
            ["@idle"] => {
                let status = self.wire.session_with(self.node).await_idle(1, Doing::Read(DATA));
                assert!(status.is_ok(), "{place}: {status:?}");
            }
            ["@power"] => {
                self.wire.power_cycle();
                self.seen = self.wire.bench().time();
            }
            _ => panic!("{place}: nobody knows what that is"),
        }
        // Frames that arrived meanwhile were checked.
        if words[0] != "@power" {
            self.seen = self.wire.bench().time();
        }
    }

    fn hex(&mut self, number: u8, image: &str) {
        let (base, bytes) = self.program(number, image);
        self.download(number, intel_hex(base, &bytes).as_bytes());
    }

    fn download(&mut self, number: u8, data: &[u8]) {
        let mut session = self.wire.session_with(self.node);
        session.transfer_by(Transfers::Segments);
        let at = Address::new(0x1F50, number);
        session.write(at, data, Doing::Block(0), &mut |_| {}).expect("the device takes the program");
    }

    /// The beginning of a download, followed by an abort.
    fn part(&mut self, data: &[u8]) {
        let (request, response) = (0x600 + u16::from(self.node), 0x580 + u32::from(self.node));
        let mut ask = |bytes: &[u8; 8], answer: [u8; 8]| {
            self.seen = self.wire.bench().time();
            self.wire.send(request, bytes);
            self.expect(response, &answer.map(Byte::Is), "@part");
        };
        ask(&[0x20, 0x50, 0x1F, 1, 0, 0, 0, 0], [0x60, 0x50, 0x1F, 1, 0, 0, 0, 0]);
        for (i, segment) in data.chunks_exact(7).enumerate() {
            let toggle = ((i % 2) as u8) << 4;
            let mut bytes = [toggle, 0, 0, 0, 0, 0, 0, 0];
            bytes[1..].copy_from_slice(segment);
            ask(&bytes, [0x20 | toggle, 0, 0, 0, 0, 0, 0, 0]);
        }
        self.wire.send(request, &Request::Abort(DATA, AbortCode::GENERAL).emit());
        self.wire.run_ms(5);
    }
}
