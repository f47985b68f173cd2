//! The debugger interface of a device on the bench: memory, breakpoints and steps through 1025h. A
//! product does not have this object.
//!
//! `docs/debugger.md` of coboot describes the device's side; the breakpoints are those of a
//! Cortex-M4 (ARM DDI 0403E section C1).

use std::time::Duration;

use canopen::debugger::{Command, Kind, Stop, COMMAND, DATA, USER_SOFTWARE};
use canopen::emcy::Emergency;
use canopen::{CobId, Frame};
use embedded_can::Frame as _;

use super::doing::Doing;
use super::error::Error;
use super::session::Session;

/// The most bytes that one command reads or writes.
const CHUNK: u32 = 4096;
/// The pause between two status requests while no emergency reports a stop.
const STATUS_PERIOD: Duration = Duration::from_millis(200);

const FP_CTRL: u32 = 0xE000_2000;
const FP_CTRL_ON: u32 = 0b11;
const FP_COMP: u32 = 0xE000_2008;
/// The number of code comparators of a Cortex-M4.
pub const BREAKPOINTS: u32 = 6;
const ENABLE: u32 = 1 << 0;
/// The end of the addresses at which code comparators can stop.
const CODE_END: u32 = 0x2000_0000;

const DCRDR: u32 = 0xE000_EDF8;
const DEMCR: u32 = 0xE000_EDFC;
const DEMCR_ON: u32 = 0x0101_0000;
const DEMCR_PEND: u32 = 1 << 17;
const DEMCR_STEP: u32 = 1 << 18;
const DEMCR_STOPPED: u32 = 1 << 19;
const DEMCR_ENABLED: u32 = 1 << 16;

/// The names of the registers, in the order of [`Registers`].
pub const NAMES: [&str; 17] = [
    "r0", "r1", "r2", "r3", "r4", "r5", "r6", "r7", "r8", "r9", "r10", "r11", "r12", "sp", "lr", "pc", "xpsr",
];

/// The registers of a stopped program: R0 to R12, SP, LR, PC, xPSR.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Registers(pub [u32; 17]);

impl Registers {
    /// The address of the next instruction.
    #[must_use]
    pub const fn pc(&self) -> u32 {
        self.0[15]
    }

    /// Combines the two parts that the device has saved: the handler's ten words, and the core's
    /// eight words at the address in the handler's first word.
    fn of(handler: &[u32; 10], core: &[u32; 8]) -> Self {
        let [frame, r4, r5, r6, r7, r8, r9, r10, r11, exc_return] = *handler;
        let [r0, r1, r2, r3, r12, lr, pc, xpsr] = *core;
        // With the FPU registers the frame has 26 words; bit 9 of xPSR marks an alignment word (DDI
        // 0403E section B1.5).
        let words = if exc_return & 0x10 == 0 { 26 } else { 8 } + (xpsr >> 9 & 1);
        let sp = frame.wrapping_add(4 * words);
        Self([r0, r1, r2, r3, r4, r5, r6, r7, r8, r9, r10, r11, r12, sp, lr, pc, xpsr & !(1 << 9)])
    }
}

/// A program that stopped, or that could not be stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stopped {
    /// The reason.
    pub stop: Stop,
    /// The address of the next instruction.
    pub address: u32,
}

/// The reasons why a breakpoint cannot be set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NoBreakpoint {
    /// The address is odd, or not in flash.
    Address,
    /// All comparators are in use.
    Full,
    /// The program does not stop: it is a bootloader, or an application without breakpoints.
    Disabled,
}

/// A session that accesses the device's memory.
pub struct Debugger<'s, 'a> {
    session: &'s mut Session<'a>,
}

impl<'s, 'a> Debugger<'s, 'a> {
    /// A debugger on this session.
    pub fn new(session: &'s mut Session<'a>) -> Self {
        Self { session }
    }

    /// Reads memory. Addresses do not wrap.
    ///
    /// # Errors
    /// The device's refusal: 06090030h for memory that may not be read, 08000022h for a secured
    /// device.
    pub fn read(&mut self, address: u32, len: u32, progress: &mut dyn FnMut(u32)) -> Result<Vec<u8>, Error> {
        let mut bytes = Vec::new();
        for (at, len) in chunks(address, len) {
            self.command(Kind::Read, at, len)?;
            let piece = self.session.upload(DATA, &mut |done| progress(at - address + done))?;
            if piece.len() != usize::from(len) {
                return Err(Error::Protocol { doing: Doing::Read(DATA), code: canopen::AbortCode::LENGTH });
            }
            bytes.extend(piece);
        }
        Ok(bytes)
    }

    /// Writes memory.
    ///
    /// # Errors
    /// The errors of [`read`](Self::read). Bytes before the refused address may have been written.
    pub fn write(&mut self, address: u32, bytes: &[u8], progress: &mut dyn FnMut(u32)) -> Result<(), Error> {
        let len = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
        let mut rest = bytes;
        for (at, len) in chunks(address, len) {
            let (piece, after) = rest.split_at(usize::from(len));
            rest = after;
            self.command(Kind::Write, at, len)?;
            self.session.write(DATA, piece, Doing::Write(DATA), &mut |done| progress(at - address + done))?;
        }
        Ok(())
    }

    fn command(&mut self, kind: Kind, address: u32, len: u16) -> Result<(), Error> {
        let command = Command { kind, address, len };
        self.session.write(COMMAND, &command.emit(), Doing::Write(COMMAND), &mut |_| {})
    }

    fn words<const N: usize>(&mut self, address: u32) -> Result<[u32; N], Error> {
        let bytes = self.read(address, 4 * N as u32, &mut |_| {})?;
        let mut words =
            bytes.chunks_exact(4).map(|word| u32::from_le_bytes([word[0], word[1], word[2], word[3]]));
        Ok(std::array::from_fn(|_| words.next().unwrap_or(0)))
    }

    fn word(&mut self, address: u32) -> Result<u32, Error> {
        self.words(address).map(|[word]| word)
    }

    fn set_word(&mut self, address: u32, value: u32) -> Result<(), Error> {
        self.write(address, &value.to_le_bytes(), &mut |_| {})
    }

    /// Reads the addresses of the breakpoints.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn breakpoints(&mut self) -> Result<Vec<u32>, Error> {
        if self.word(FP_CTRL)? & ENABLE == 0 {
            return Ok(Vec::new());
        }
        let comparators: [u32; BREAKPOINTS as usize] = self.words(FP_COMP)?;
        Ok(comparators.into_iter().flat_map(addresses).collect())
    }

    /// Sets a breakpoint at an instruction with a free comparator.
    ///
    /// # Errors
    /// The errors of [`read`](Self::read). The inner result says why the breakpoint cannot be set.
    pub fn break_at(&mut self, address: u32) -> Result<Result<(), NoBreakpoint>, Error> {
        if !address.is_multiple_of(2) || address >= CODE_END {
            return Ok(Err(NoBreakpoint::Address));
        }
        if self.word(DEMCR)? & DEMCR_ENABLED == 0 {
            return Ok(Err(NoBreakpoint::Disabled));
        }
        let on = self.word(FP_CTRL)? & ENABLE != 0;
        let comparators: [u32; BREAKPOINTS as usize] = self.words(FP_COMP)?;
        // Comparators set before the unit was disabled must not become active with it.
        if !on {
            self.write(FP_COMP, &[0; 4 * BREAKPOINTS as usize], &mut |_| {})?;
        }
        let mut taken = comparators.into_iter().map(|comparator| addresses(comparator).filter(|_| on));
        if taken.clone().flatten().any(|at| at == address) {
            return Ok(Ok(()));
        }
        let Some(free) = taken.position(|mut taken| taken.next().is_none()) else {
            return Ok(Err(NoBreakpoint::Full));
        };
        self.set_word(FP_COMP + 4 * free as u32, comparator(address))?;
        self.set_word(FP_CTRL, FP_CTRL_ON)?;
        Ok(Ok(()))
    }

    /// Removes a breakpoint; returns whether it existed.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn clear(&mut self, address: u32) -> Result<bool, Error> {
        let comparators: [u32; BREAKPOINTS as usize] = self.words(FP_COMP)?;
        let mut found = false;
        for (n, value) in (0..).zip(comparators) {
            if addresses(value).any(|at| at == address) {
                self.set_word(FP_COMP + 4 * n, 0)?;
                found = true;
            }
        }
        Ok(found)
    }

    /// Removes all breakpoints.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn clear_all(&mut self) -> Result<(), Error> {
        self.write(FP_COMP, &[0; 4 * BREAKPOINTS as usize], &mut |_| {})
    }

    /// Whether the program is stopped.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn is_stopped(&mut self) -> Result<bool, Error> {
        Ok(self.word(DEMCR)? & DEMCR_STOPPED != 0)
    }

    /// Lets a stopped program continue.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn resume(&mut self) -> Result<(), Error> {
        self.set_word(DEMCR, DEMCR_ON)
    }

    /// Lets a stopped program execute one instruction.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn step(&mut self) -> Result<(), Error> {
        self.set_word(DEMCR, DEMCR_ON | DEMCR_STEP)
    }

    /// Stops the program, wherever it is.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn stop(&mut self) -> Result<(), Error> {
        self.set_word(DEMCR, DEMCR_ON | DEMCR_PEND)
    }

    /// The registers of a stopped program.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn registers(&mut self) -> Result<Option<Registers>, Error> {
        if !self.is_stopped()? {
            return Ok(None);
        }
        let saved = self.word(DCRDR)?;
        let handler = self.words(saved)?;
        let core = self.words(handler[0])?;
        Ok(Some(Registers::of(&handler, &core)))
    }

    /// Waits until the program stops, or has passed a breakpoint that cannot stop it; `None` if
    /// neither happens within `time`.
    ///
    /// An emergency may come before the answer to the command that caused the stop, and be lost.
    /// The method therefore also reads the program's state.
    ///
    /// # Errors
    /// The errors of [`read`](Self::read), and those of the adapter.
    pub fn await_stop(&mut self, time: Duration) -> Result<Option<Stopped>, Error> {
        let (began, node) = (self.session.now(), self.session.node());
        loop {
            if let Some(registers) = self.registers()? {
                let address = registers.pc();
                let at_breakpoint = self.breakpoints()?.contains(&address);
                let stop = if at_breakpoint { Stop::Breakpoint } else { Stop::Step };
                return Ok(Some(Stopped { stop, address }));
            }
            let left = time.saturating_sub(self.session.now().saturating_sub(began));
            if left.is_zero() {
                return Ok(None);
            }
            // The device could not stop here: it has disabled the unit and left the comparators
            // unchanged.
            if self.word(FP_CTRL)? & ENABLE == 0 {
                let comparators: [u32; BREAKPOINTS as usize] = self.words(FP_COMP)?;
                if let Some(address) = comparators.into_iter().flat_map(addresses).next() {
                    return Ok(Some(Stopped { stop: Stop::OutOfReach, address }));
                }
            }
            let mut heard = None;
            self.session.observe_until(left.min(STATUS_PERIOD), &mut |frame| {
                heard = stop_of(frame, CobId::emcy(node));
                heard.is_some()
            })?;
            if heard.is_some() {
                return Ok(heard);
            }
        }
    }
}

/// The stop that an emergency reports.
fn stop_of(frame: &Frame, id: CobId) -> Option<Stopped> {
    if frame.cob_id() != Some(id) {
        return None;
    }
    let Emergency { code, detail: [kind, a, b, c, d], .. } = Emergency::parse(frame.data().try_into().ok()?);
    let stop = Stop::from_number(kind).filter(|_| code == USER_SOFTWARE)?;
    Some(Stopped { stop, address: u32::from_le_bytes([a, b, c, d]) })
}

/// The pieces of a range; the range ends at the end of the address space.
fn chunks(address: u32, len: u32) -> impl Iterator<Item = (u32, u16)> {
    (0..len).step_by(CHUNK as usize).map_while(move |offset| {
        let at = address.checked_add(offset)?;
        Some((at, (len - offset).min(CHUNK) as u16))
    })
}

/// The comparator value for an address.
const fn comparator(address: u32) -> u32 {
    let half = if address & 2 == 0 { 1 << 30 } else { 1 << 31 };
    half | address & !3 | ENABLE
}

/// The addresses at which a comparator stops.
fn addresses(comparator: u32) -> impl Iterator<Item = u32> + Clone {
    let word = comparator & 0x1FFF_FFFC;
    let on = comparator & ENABLE != 0;
    [(1 << 30, word), (1 << 31, word | 2)]
        .into_iter()
        .filter(move |(half, _)| on && comparator & half != 0)
        .map(|(_, address)| address)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// DDI 0403E section C1.11: REPLACE 01b selects the lower halfword, 10b the upper one.
    #[test]
    fn comparators_name_a_halfword() {
        for (address, value) in [(0x0801_2344, 0x4801_2345), (0x0801_2346, 0x8801_2345)] {
            assert_eq!(comparator(address), value);
            assert_eq!(addresses(value).collect::<Vec<_>>(), [address]);
        }
        assert_eq!(addresses(0xC801_2345).collect::<Vec<_>>(), [0x0801_2344, 0x0801_2346]);
        assert_eq!(addresses(0x4801_2344).count(), 0, "off");
    }

    #[test]
    fn a_range_is_cut_into_pieces_and_ends_with_the_addresses() {
        assert_eq!(chunks(0x2000_0000, 0).count(), 0);
        assert_eq!(chunks(0x2000_0001, 4097).collect::<Vec<_>>(), [(0x2000_0001, 4096), (0x2000_1001, 1)]);
        assert_eq!(chunks(u32::MAX, 5000).collect::<Vec<_>>(), [(u32::MAX, 4096)]);
    }

    /// The frame begins after ten words; SP points after it and after its alignment word.
    #[test]
    fn registers_are_put_together_from_both_parts() {
        let handler = [0x2000_0128, 4, 5, 6, 7, 8, 9, 10, 11, 0xFFFF_FFF9];
        let core = [0, 1, 2, 3, 12, 14, 0x0801_2344, 0x2100_0000];
        let Registers(all) = Registers::of(&handler, &core);
        assert_eq!(all[..13], [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
        assert_eq!(all[13..], [0x2000_0148, 14, 0x0801_2344, 0x2100_0000]);
        let aligned = Registers::of(&handler, &[0, 1, 2, 3, 12, 14, 0x0801_2344, 0x2100_0200]);
        assert_eq!((aligned.0[13], aligned.0[16]), (0x2000_014C, 0x2100_0000));
        let mut floating = handler;
        floating[9] = 0xFFFF_FFE9;
        assert_eq!(Registers::of(&floating, &core).0[13], 0x2000_0128 + 104);
    }

    #[test]
    fn a_stop_is_an_emergency_of_this_node() {
        let id = CobId::new(0x81).unwrap();
        let frame = |id: u16, data: &[u8]| Frame::of(CobId::new(id).unwrap(), data);
        let reported = stop_of(&frame(0x81, &[0, 0x62, 0, 1, 0x44, 0x23, 1, 8]), id);
        assert_eq!(reported, Some(Stopped { stop: Stop::Breakpoint, address: 0x0801_2344 }));
        for (id_of, data) in [
            (0x82, &[0, 0x62, 0, 1, 0x44, 0x23, 1, 8][..]),
            (0x81, &[0, 0x63, 0, 1, 0x44, 0x23, 1, 8]),
            (0x81, &[0, 0x62, 0, 2, 0x44, 0x23, 1, 8]),
            (0x81, &[0, 0x62, 0, 1]),
        ] {
            assert_eq!(stop_of(&frame(id_of, data), id), None, "{data:02X?}");
        }
    }
}
