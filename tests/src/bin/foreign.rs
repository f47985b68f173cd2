//! Runs firmware of others, unmodified, in the emulator, and plays a check with each: NAME=ELF, or
//! NAME=ELF,ELF for a bootloader and its program (docs/foreign.md).

use std::process::ExitCode;

use emulator::frame::Frame;
use emulator::machine::{Machine, Options};
use emulator::time::Span;
use emulator::world::{MachineId, PortId, World};
use shared_abi::geometry::{Geometry, STM32F405RG, STM32F407VG};

/// A board with the firmware, and a host on its bus.
struct Desk {
    world: World<Machine>,
    board: MachineId,
    host: PortId,
}

/// What is expected of a firmware.
struct Check {
    name: &'static str,
    chip: &'static Geometry,
    /// The controller that the transceiver is at: 0 is CAN1.
    can: usize,
    bit_rate: u32,
    play: fn(&mut Desk) -> Result<String, String>,
}

/// What most of them have.
const AT_CAN1: Check = Check { name: "", chip: &STM32F407VG, can: 0, bit_rate: 500_000, play: hal_can_send };

/// All of them, with a crystal of 8 MHz.
const CHECKS: [Check; 7] = [
    Check { name: "katapult", play: |desk| desk.unassigned(KATAPULT).map(uuid), ..AT_CAN1 },
    Check { name: "klipper", play: klipper, ..AT_CAN1 },
    Check { name: "klipper-katapult", play: klipper_is_called_back, ..AT_CAN1 },
    Check { name: "chibios", can: 1, play: chibios, ..AT_CAN1 },
    Check { name: "canopennode", can: 1, bit_rate: 125_000, play: canopennode, ..AT_CAN1 },
    Check { name: "openblt", chip: &STM32F405RG, play: openblt, ..AT_CAN1 },
    Check { name: "stm32f4xx-hal", play: hal_can_send, ..AT_CAN1 },
];

/// Klipper's protocol on CAN: the administrator asks, and a node without a number answers with its UUID and
/// what it is (docs/CANBUS_protocol.md there).
const ADMIN: u16 = 0x3F0;
const ADMIN_ANSWER: u32 = 0x3F1;
const KLIPPER: u8 = 0x01;
const KATAPULT: u8 = 0x11;

impl Desk {
    fn new(check: &Check, images: &[Vec<u8>]) -> Result<Self, String> {
        let options = Options { transceiver: check.can, ..Options::default() };
        let mut machine = Machine::new(check.chip, options).map_err(|error| error.to_string())?;
        for image in images {
            machine.load(image).map_err(|error| error.to_string())?;
        }
        let mut world = World::new();
        let board = world.add_machine(machine);
        let host = world.add_host_port(check.bit_rate);
        world.power_on(board);
        Ok(Self { world, board, host })
    }

    fn send(&mut self, id: u16, data: &[u8]) {
        self.world.send(self.host, Frame::standard(id, data).expect("11 bits, 8 bytes"));
    }

    /// The data of the next frame with this identifier, within so many milliseconds.
    fn expect(&mut self, id: u32, within_ms: u64) -> Result<Vec<u8>, String> {
        let deadline = self.world.now() + Span::from_millis(within_ms);
        loop {
            match self.world.run_until_frame_or(self.host, deadline) {
                Some((_, frame)) if frame.raw_id() == id => return Ok(frame.data().to_vec()),
                Some(_) => {}
                None => return Err(format!("no frame {id:X}h within {within_ms} ms")),
            }
        }
    }

    fn run_ms(&mut self, ms: u64) {
        self.world.run_for(Span::from_millis(ms));
    }

    /// A node without a number, which is a Klipper or a Katapult: its UUID.
    fn unassigned(&mut self, kind: u8) -> Result<[u8; 6], String> {
        self.run_ms(1_500);
        self.send(ADMIN, &[0]);
        let answer = self.expect(ADMIN_ANSWER, 200)?;
        match answer[..] {
            [0x20, a, b, c, d, e, f, of_kind] if of_kind == kind => Ok([a, b, c, d, e, f]),
            _ => Err(format!("the answer to the query is {answer:02X?}")),
        }
    }
}

fn uuid(bytes: [u8; 6]) -> String {
    format!("answers the query with UUID {bytes:02X?}")
}

/// It takes a number, and answers the request for its identification: 40 bytes from the start.
fn klipper(desk: &mut Desk) -> Result<String, String> {
    let uuid = desk.unassigned(KLIPPER)?;
    let number = [&[0x01][..], &uuid, &[4]].concat();
    desk.send(ADMIN, &number);
    desk.run_ms(10);
    // Length, sequence, identify(0, 40), CRC-16 (CCITT), 7Eh: docs/Protocol.md there.
    desk.send(0x108, &[0x08, 0x10, 0x01, 0x00, 0x28, 0x5E, 0x9F, 0x7E]);
    let answer = desk.expect(0x109, 200)?;
    Ok(format!("takes a number and answers on it: {answer:02X?}"))
}

/// Katapult starts Klipper; the request for the bootloader leads back.
fn klipper_is_called_back(desk: &mut Desk) -> Result<String, String> {
    let uuid = desk.unassigned(KLIPPER)?;
    desk.send(ADMIN, &[&[0x02][..], &uuid].concat());
    match desk.unassigned(KATAPULT)? {
        same if same == uuid => Ok(format!("is started by Katapult and called back, UUID {uuid:02X?}")),
        other => Err(format!("another UUID answers: {other:02X?}")),
    }
}

/// The test of the HAL sends on both controllers in loop-back mode, every half a second, and toggles a LED
/// of the Discovery board for each frame that comes back: PD14 for CAN1, PD13 for CAN2.
fn chibios(desk: &mut Desk) -> Result<String, String> {
    let mut levels = [[false; 2]; 4];
    for level in &mut levels {
        let machine = desk.world.machine(desk.board);
        *level = [machine.pin('D', 14), machine.pin('D', 13)];
        desk.run_ms(500);
    }
    for (n, name) in ["CAN1", "CAN2"].into_iter().enumerate() {
        let changes = levels.windows(2).filter(|pair| pair[0][n] != pair[1][n]).count();
        if changes < 2 {
            return Err(format!("{name} receives {changes} of its frames in 1.5 s"));
        }
    }
    Ok("sends on CAN1 and CAN2, and both receive it".into())
}

/// CiA 301: a boot-up message.
fn canopennode(desk: &mut Desk) -> Result<String, String> {
    let deadline = desk.world.now() + Span::from_millis(2_000);
    while let Some((at, frame)) = desk.world.run_until_frame_or(desk.host, deadline) {
        if (0x701..=0x77F).contains(&frame.raw_id()) && frame.data() == [0] {
            return Ok(format!("boots up as node {} at {at}", frame.raw_id() & 0x7F));
        }
    }
    Err("no boot-up within 2 s".into())
}

/// XCP: CONNECT is answered by a positive response (667h and 7E1h are the demo's identifiers).
fn openblt(desk: &mut Desk) -> Result<String, String> {
    desk.run_ms(50);
    desk.send(0x667, &[0xFF, 0x00]);
    let answer = desk.expect(0x7E1, 100)?;
    if answer.first() != Some(&0xFF) {
        return Err(format!("CONNECT is answered by {answer:02X?}"));
    }
    Ok(format!("answers CONNECT: {answer:02X?}"))
}

/// The example sends a counter and 1 to 7, without a pause.
fn hal_can_send(desk: &mut Desk) -> Result<String, String> {
    for count in 0..5 {
        let data = desk.expect(0x500, 100)?;
        if data != [count, 1, 2, 3, 4, 5, 6, 7] {
            return Err(format!("frame {count} is {data:02X?}"));
        }
    }
    Ok("sends its frames in order".into())
}

fn run(check: &Check, files: &str) -> Result<String, String> {
    let read = |file: &str| std::fs::read(file).map_err(|error| format!("{file}: {error}"));
    let images = files.split(',').map(read).collect::<Result<Vec<_>, _>>()?;
    let mut desk = Desk::new(check, &images)?;
    let outcome = (check.play)(&mut desk);
    let machine = desk.world.machine(desk.board);
    for report in machine.reports() {
        println!("  {}: {report}", check.name);
    }
    outcome.map(|what| format!("{what} ({} s after power-on)", desk.world.now()))
}

fn main() -> ExitCode {
    // Without a firmware nothing was shown.
    let mut failed = std::env::args().len() < 2;
    let mut left: Vec<&str> = CHECKS.iter().map(|check| check.name).collect();
    for word in std::env::args().skip(1) {
        let (name, files) = word.split_once('=').unwrap_or((&word, ""));
        left.retain(|other| *other != name);
        let result = match CHECKS.iter().find(|check| check.name == name) {
            Some(check) => run(check, files),
            None => Err("there is no such check; docs/foreign.md has the names".into()),
        };
        failed |= result.is_err();
        match result {
            Ok(what) => println!("{name}: ok, {what}"),
            Err(why) => println!("{name}: FAILED, {why}"),
        }
    }
    for name in left {
        println!("{name}: NOT RUN, it was not given");
    }
    if failed {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    }
}
