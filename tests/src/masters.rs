//! Masters that support CiA 302-3 and know nothing of coboot, with their sequence of requests and
//! its timing: Zephyr's `canopen_program.py` and the boot slave process of Lely's NMT master; and the order
//! of SYS TEC's tools.
//!
//! Each request is sent once unless the original repeats it, and its answer is the next frame of
//! the node's SDO server.

use std::time::Duration;

use canopen::{Address, Frame, NodeId};
use coboot_can::Adapter;
use coflash_core::device::{Doing, Session, Timing, Transfers};
use coflash_core::file::block_file::BlockFile;
use coflash_core::file::Program;
use embedded_can::{Frame as _, StandardId};

/// The values of 1F51h (CiA 302-3; 80h is Zephyr's).
const STOP: u8 = 0;
const START: u8 = 1;
const CLEAR: u8 = 3;
const CONFIRM: u8 = 0x80;
/// SYS TEC's.
const SET_SIGNATURE: u8 = 0x83;

/// An SDO client with this time-out, on any bus.
pub struct Master<'a> {
    /// The bus.
    pub bus: &'a mut dyn Adapter,
    node: u8,
    timeout: Duration,
}

impl<'a> Master<'a> {
    /// A client of a node with this time-out for each answer.
    pub fn new(bus: &'a mut dyn Adapter, node: u8, timeout: Duration) -> Self {
        Self { bus, node, timeout }
    }

    /// Sends a frame.
    ///
    /// # Panics
    /// If it is no frame, or the bus is gone.
    pub fn post(&mut self, id: u16, data: &[u8]) {
        let id = StandardId::new(id).expect("11 bits");
        self.bus.send(&Frame::new(id, data).expect("8 bytes at most")).expect("the bus is there");
    }

    /// Waits.
    ///
    /// # Panics
    /// If the bus is gone.
    pub fn pause(&mut self, time: Duration) {
        let until = self.bus.now() + time;
        while self.bus.now() < until {
            let left = until.saturating_sub(self.bus.now());
            let _ = self.bus.receive(left).expect("the bus is there");
        }
    }

    /// The next frame with this identifier, within this time.
    ///
    /// # Panics
    /// If the bus is gone.
    pub fn await_frame(&mut self, id: u16, time: Duration) -> Option<Vec<u8>> {
        let until = self.bus.now() + time;
        loop {
            let left = until.saturating_sub(self.bus.now());
            let frame = self.bus.receive(left).expect("the bus is there")?;
            if frame.cob_id().is_some_and(|of| of.get() == id) {
                return Some(frame.data().to_vec());
            }
        }
    }

    /// Sends one SDO request once; returns its answer, and the time until the answer.
    pub fn ask(&mut self, request: [u8; 8]) -> Option<(Vec<u8>, Duration)> {
        let from = self.bus.now();
        self.post(0x600 + u16::from(self.node), &request);
        let answer = self.await_frame(0x580 + u16::from(self.node), self.timeout)?;
        Some((answer, self.bus.now() - from))
    }

    /// Writes a command to 1F51h of a program: the answer is 60 51 1F nn.
    ///
    /// # Errors
    /// The frame in place of the answer.
    pub fn control(&mut self, program: u8, command: u8) -> Result<Duration, String> {
        match self.ask([0x2F, 0x51, 0x1F, program, command, 0, 0, 0]) {
            Some((answer, took)) if answer == [0x60, 0x51, 0x1F, program, 0, 0, 0, 0] => Ok(took),
            other => Err(format!("1F51h/{program} = {command:02X}h: {other:02X?}")),
        }
    }

    /// Reads a number of 8 or 32 bits.
    ///
    /// # Errors
    /// The frame in place of the answer.
    pub fn number(&mut self, index: u16, sub: u8) -> Result<u32, String> {
        let [low, high] = index.to_le_bytes();
        match self.ask([0x40, low, high, sub, 0, 0, 0, 0]) {
            Some((answer, _)) if matches!(answer[0], 0x43 | 0x4F) && answer[1..4] == [low, high, sub] => {
                Ok(u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]))
            }
            other => Err(format!("{index:04X}h/{sub}: {other:02X?}")),
        }
    }

    /// Writes a program to 1F50h.
    ///
    /// # Errors
    /// The result of the transfer.
    pub fn download(&mut self, program: u8, image: &[u8], transfers: Transfers) -> Result<(), String> {
        let timing = Timing::default().sdo(self.timeout).attempts(1);
        let node = NodeId::new(self.node).ok_or("a node-ID")?;
        let mut session = Session::new(&mut *self.bus, node, timing);
        session.transfer_by(transfers);
        let at = Address::new(0x1F50, program);
        session.write(at, image, Doing::Program, &mut |_| {}).map_err(|error| error.to_string())
    }
}

/// The procedure of Zephyr's runner (`scripts/west_commands/runners/canopen_program.py`), with the
/// default options: an SDO time-out of 1 s, one attempt, 10 s for a status and for the boot-up
/// message, and the confirmation at the end.
pub struct Zephyr {
    /// The times until STOP and CLEAR were answered.
    pub answers: [Duration; 2],
}

/// The time between an answer and the next request of the runner, from a trace of it.
pub const ZEPHYR_PAUSE: Duration = Duration::from_micros(1400);

/// Runs Zephyr's procedure for this program number (`--program-number`, 1 by default).
///
/// # Errors
/// The first step that fails; the runner gives up there.
pub fn zephyr(bus: &mut dyn Adapter, node: u8, program: u8, image: &[u8]) -> Result<Zephyr, String> {
    let limit = Duration::from_secs(10);
    let mut master = Master::new(bus, node, Duration::from_secs(1));
    let status_ok = |master: &mut Master<'_>| {
        let until = master.bus.now() + limit;
        loop {
            let status = master.number(0x1F57, program)?;
            if status == 0 || master.bus.now() > until {
                return Ok::<u32, String>(status);
            }
        }
    };
    if status_ok(&mut master)? == 0 {
        master.number(0x1F56, program)?;
    }
    master.post(0x000, &[0x80, node]);
    master.pause(ZEPHYR_PAUSE);
    let stop = master.control(program, STOP)?;
    master.pause(ZEPHYR_PAUSE);
    let clear = master.control(program, CLEAR)?;
    master.pause(ZEPHYR_PAUSE);
    status_ok(&mut master)?;
    master.download(program, image, Transfers::Segments)?;
    let status = status_ok(&mut master)?;
    if status != 0 {
        return Err(format!("1F57h reads {status:08X}h"));
    }
    master.number(0x1F56, program)?;
    master.control(program, START)?;
    let boot_up = 0x700 + u16::from(node);
    loop {
        let state = master.await_frame(boot_up, limit).ok_or("no boot-up")?;
        if state == [0] {
            break;
        }
    }
    master.number(0x1F56, program)?;
    master.post(0x000, &[0x80, node]);
    master.pause(ZEPHYR_PAUSE);
    master.control(program, CONFIRM)?;
    Ok(Zephyr { answers: [stop, clear] })
}

/// Waits until 1F57h is not busy; its value.
///
/// # Errors
/// The frame in place of the answer.
fn idle(master: &mut Master<'_>, program: u8) -> Result<(), String> {
    loop {
        match master.number(0x1F57, program)? {
            0 => return Ok(()),
            busy if busy & 1 != 0 => master.pause(Duration::from_millis(10)),
            error => return Err(format!("1F57h reads {error:08X}h")),
        }
    }
}

/// The order of SYS TEC's DotNetFlashtool: CLEAR, block by block, SET_SIGNATURE, START (L-1112d_10, the
/// sequence after figure 3 without its steps 10 to 13). It ends with the next boot-up message.
///
/// # Errors
/// The first step that fails.
pub fn systec(bus: &mut dyn Adapter, node: u8, program: u8, file: &Program) -> Result<(), String> {
    let mut master = Master::new(bus, node, Duration::from_millis(500));
    master.control(program, CLEAR)?;
    idle(&mut master, program)?;
    for block in BlockFile::of(file).blocks() {
        master.download(program, &block.emit(), Transfers::Segments)?;
        idle(&mut master, program)?;
    }
    master.control(program, SET_SIGNATURE)?;
    idle(&mut master, program)?;
    master.control(program, START)?;
    let boot_up = master.await_frame(0x700 + u16::from(node), Duration::from_secs(10));
    boot_up.map(drop).ok_or("no boot-up".to_string())
}

/// What a master adds to its sequence to renew a bootloader: SET_SIGNATURE on trial, and the wait for the
/// installation (docs/masters.md).
///
/// # Errors
/// The first step that fails.
pub fn confirm(bus: &mut dyn Adapter, node: u8, program: u8) -> Result<(), String> {
    let mut master = Master::new(bus, node, Duration::from_millis(500));
    master.control(program, SET_SIGNATURE)?;
    idle(&mut master, program)
}

/// STOP if a program runs, CLEAR or not, one download and START, each request once: the order of docs/masters.md,
/// as `sdo.c` of CANopenTerm sends it with its time-out of 100 ms; and that of the public scripts without CLEAR.
///
/// # Errors
/// The first step that fails.
pub fn simple(
    bus: &mut dyn Adapter,
    node: u8,
    (timeout, clears): (Duration, bool),
    image: &[u8],
    transfers: Transfers,
) -> Result<(), String> {
    let mut master = Master::new(bus, node, timeout);
    if master.number(0x1F51, 1)? == 1 {
        master.control(1, STOP)?;
    }
    if clears {
        master.control(1, CLEAR)?;
    }
    master.download(1, image, transfers)?;
    idle(&mut master, 1)?;
    master.control(1, START)?;
    master.pause(Duration::from_millis(300));
    match master.number(0x1F51, 1)? {
        1 => Ok(()),
        state => Err(format!("1F51h reads {state}")),
    }
}

/// How many times Lely's master repeats a request that may meet a restarting device.
const LELY_RETRY: u32 = 3;
/// Its pause before it reads 1F57h and 1F51h.
const LELY_CHECK: Duration = Duration::from_millis(100);

/// How many times Lely's master repeated a request.
pub struct Lely {
    /// The total number of repetitions.
    pub repeated: u32,
    /// Whether STOP was answered: the master also continues without an answer.
    pub stop_answered: bool,
}

/// Runs the step "check and update software version" of Lely's boot slave process
/// (`src/co/nmt_boot.c`), with its SDO time-out of 100 ms. `image` is the value of 1F58h for the
/// slave.
///
/// # Errors
/// The first step that fails; the process ends there.
pub fn lely(bus: &mut dyn Adapter, node: u8, image: &[u8], identification: u32) -> Result<Lely, String> {
    let mut master = Master::new(bus, node, Duration::from_millis(100));
    let mut repeated = 0;
    let mut retry = |step: &mut dyn FnMut() -> Result<u32, String>| {
        let mut attempt = 0;
        loop {
            match step() {
                // A time-out is repeated, an abort is not.
                Err(error) if error.ends_with("None") && attempt < LELY_RETRY => {
                    attempt += 1;
                    repeated += 1;
                }
                result => return result,
            }
        }
    };
    retry(&mut || master.number(0x1F56, 1))?;
    let mut stop_answered = true;
    if master.number(0x1F51, 1) != Ok(0) {
        // "The download SDO request may be unconfirmed on some devices."
        match master.control(1, STOP) {
            Err(error) if error.ends_with("None") => stop_answered = false,
            result => drop(result?),
        }
    }
    retry(&mut || master.control(1, CLEAR).map(|_| 0))?;
    master.download(1, image, Transfers::Blocks)?;
    loop {
        master.pause(LELY_CHECK);
        let status = master.number(0x1F57, 1)?;
        match status {
            0 => break,
            busy if busy & 1 != 0 => {}
            error => return Err(format!("1F57h reads {error:08X}h")),
        }
    }
    let found = master.number(0x1F56, 1)?;
    if found != identification {
        return Err(format!("1F56h reads {found:08X}h, not {identification:08X}h"));
    }
    match master.control(1, START) {
        Err(error) if !error.ends_with("None") => return Err(error),
        _ => {}
    }
    loop {
        master.pause(LELY_CHECK);
        if retry(&mut || master.number(0x1F51, 1))? == 1 {
            return Ok(Lely { repeated, stop_answered });
        }
    }
}
