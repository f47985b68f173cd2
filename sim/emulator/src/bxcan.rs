//! The bxCAN controllers CAN1 and CAN2 (RM0090 rev 19, section 32 "Controller area network
//! (bxCAN)"), registers and behaviour taken from the manual.
//!
//! CAN1 is the master: it has the filter registers of both, and manages the memory that both have
//! their mailboxes, FIFOs and filters in. Without the clock of CAN1, CAN2 receives nothing, and its
//! mailboxes cannot be accessed.
//!
//! The controller does not decide which frame is on the wire. It offers frames and counters to the
//! [`Bus`](crate::bus::Bus) through [`BusNode`], and the bus reports the events and their times.
//! Before a bus has called it, the controller behaves as if its transceiver saw a recessive line:
//! it can be set up and leaves initialisation, and its frames wait, except in loop-back mode, which needs
//! no bus.
//!
//! Time-triggered mode has the time stamps of both directions, and no transmission of them (TGT), which is
//! reported when asked for. MSR.SAMP and MSR.RX always read recessive.

pub mod filters;
mod mailboxes;
pub mod pins;
mod registers;
#[cfg(test)]
mod tests;

use crate::bus::confinement::{Confinement, ErrorState};
use crate::bus::node::{BusEvent, BusNode, ErrorKind, Line, Pins, Wait};
use crate::frame::{Frame, INTERMISSION_BITS};
use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::silicon::{self, Silicon};
use crate::time::{Span, Time};
use filters::{Filters, Share};
use mailboxes::{Fifo, Mailbox, MailboxState, RxMailbox};
use registers::{btr, esr, ier, ir, mcr, msr, tsr};

/// Interrupt lines of a controller (RM0090, table 61).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lines {
    /// A transmit request has been performed.
    pub tx: u16,
    /// FIFO 0.
    pub rx0: u16,
    /// FIFO 1.
    pub rx1: u16,
    /// Status change and error.
    pub sce: u16,
}

/// Those of CAN1.
pub const CAN1_LINES: Lines = Lines { tx: 19, rx0: 20, rx1: 21, sce: 22 };
/// Those of CAN2.
pub const CAN2_LINES: Lines = Lines { tx: 63, rx0: 64, rx1: 65, sce: 66 };

/// CAN_TDTxR.TGT.
const TGT: u32 = 1 << 8;
/// Recessive sequences on the way out of bus-off.
const RECOVERY_SEQUENCES: u32 = 128;
/// Bits of one such sequence.
const SEQUENCE_BITS: u64 = 11;
const PICOS: u64 = 1_000_000_000_000;

/// The two modes off the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Rest {
    /// INAK is set.
    Initialisation,
    /// SLAK is set.
    Sleep,
}

/// Operating mode (RM0090, 32.4).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    /// Off the bus.
    Resting(Rest),
    /// On its way to normal mode: INAK or SLAK goes out once 11 recessive bits have been seen.
    Synchronising { from: Rest, since: Time },
    /// On the bus.
    Normal,
}

/// The way out of bus-off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Recovery {
    /// Not bus-off.
    None,
    /// Bus-off; with ABOM clear the software has to go through initialisation mode first.
    NeedsInit,
    /// Counts recessive sequences.
    Counting { since: Time, left: u32 },
}

/// The activity of the protocol engine: MSR.TXM and MSR.RXM.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Activity {
    Idle,
    Transmitting,
    Receiving,
}

/// A controller: CAN1 or CAN2.
#[derive(Clone, Debug)]
pub struct BxCan {
    share: Share,
    /// Whether CAN1, which manages the memory, has a clock. Only CAN2 checks it.
    master_clocked: bool,
    clock_hz: u32,
    on_bus: bool,
    pins: Pins,
    attention: Option<Time>,
    epoch: u32,
    mode: Mode,
    /// The mode to enter when the controller leaves normal mode, and since when it waits for that.
    leaving: Option<(Time, Rest)>,
    /// Aborts that were requested while the registers stood still: they show as requested until a reset.
    frozen_aborts: u32,
    /// It will not leave before MCR.RESET.
    is_stuck: bool,
    silicon: Silicon,
    recovery: Recovery,
    activity: Activity,
    /// The start of the frame on the wire.
    frame_start: Time,
    /// Without a bus: when the frame that it sends to itself is over, with the intermission.
    alone: Option<Time>,
    confinement: Confinement,
    mcr: u32,
    /// ERRI, WKUI, SLAKI.
    msr_flags: u32,
    ier: u32,
    btr: u32,
    last_error: u32,
    mailboxes: [Mailbox; 3],
    requests: u64,
    fifos: [Fifo; 2],
    filters: Filters,
}

impl Default for BxCan {
    fn default() -> Self {
        Self::new()
    }
}

impl BxCan {
    /// CAN1 after a reset, without a clock, its pins connected.
    #[must_use]
    pub fn new() -> Self {
        Self {
            share: Share::Can1,
            master_clocked: true,
            clock_hz: 0,
            on_bus: false,
            pins: Pins::BOTH,
            attention: None,
            epoch: 0,
            mode: Mode::Resting(Rest::Sleep),
            leaving: None,
            frozen_aborts: 0,
            is_stuck: false,
            silicon: silicon::TYPICAL,
            recovery: Recovery::None,
            activity: Activity::Idle,
            frame_start: Time(0),
            alone: None,
            confinement: Confinement::default(),
            mcr: mcr::AFTER_RESET,
            msr_flags: 0,
            ier: 0,
            btr: btr::AFTER_RESET,
            last_error: 0,
            mailboxes: [Mailbox::default(); 3],
            requests: 0,
            fifos: [Fifo::default(), Fifo::default()],
            filters: Filters::default(),
        }
    }

    /// CAN2 after a reset, without a clock, and with a master that has none.
    #[must_use]
    pub fn slave() -> Self {
        Self { share: Share::Can2, master_clocked: false, ..Self::new() }
    }

    /// The same on this chip.
    #[must_use]
    pub fn on(self, silicon: Silicon) -> Self {
        Self { silicon, ..self }
    }

    /// CAN2 takes over the state of CAN1: its filters, and whether it has a clock.
    pub fn follow(&mut self, master: &Self, clocked: bool) {
        self.filters.clone_from(&master.filters);
        self.master_clocked = clocked;
    }

    /// Which of the two it is.
    #[must_use]
    pub fn share(&self) -> Share {
        self.share
    }

    /// The program connects pins to the controller, or takes them away.
    pub fn connect(&mut self, pins: Pins, now: Time) {
        if pins != self.pins {
            self.pins = pins;
            self.attend(now);
        }
    }

    /// Its interrupt lines.
    #[must_use]
    pub fn lines(&self) -> Lines {
        match self.share {
            Share::Can1 => CAN1_LINES,
            Share::Can2 => CAN2_LINES,
        }
    }

    /// Checks that this controller has a register at `offset`.
    fn check(&self, offset: u32) -> Result<(), Unmodelled> {
        match (self.share, offset) {
            (Share::Can2, 0x200..) => unmodelled(format!(
                "CAN2 has no filter registers (offset {offset:#x}): its banks are set in CAN1's"
            )),
            (Share::Can2, 0x180..=0x1CC) if !self.master_clocked => unmodelled(format!(
                "CAN1 has no clock (RCC enables it): CAN2 does not reach its mailboxes (offset {offset:#x})"
            )),
            _ => Ok(()),
        }
    }

    /// The APB1 clock, in Hz; 0 while the controller has none. The bit rate follows.
    pub fn set_clock(&mut self, hz: u32) {
        self.clock_hz = hz;
    }

    /// Whether the bus must process a change before the CPU may go on: a transmission is requested,
    /// or the mode changes.
    #[must_use]
    pub fn wants_attention(&self) -> bool {
        self.on_bus && self.attention.is_some()
    }

    /// The nominal bit time that BTR and the clock make (RM0090, 32.7.7): (1 + TS1 + 1 + TS2 + 1)
    /// time quanta of BRP + 1 clock cycles. `None` without a clock.
    #[must_use]
    pub fn bit_time(&self) -> Option<Span> {
        self.quanta(1 + self.segment_1() + self.segment_2())
    }

    /// The bit rate in bit/s, rounded down; 0 without a clock.
    #[must_use]
    pub fn bit_rate(&self) -> u32 {
        let cycles = self.cycles(1 + self.segment_1() + self.segment_2());
        // Not above the clock, which fits.
        (u64::from(self.clock_hz) / cycles) as u32
    }

    /// The sample point in tenths of a per cent of the bit time, rounded down.
    #[must_use]
    pub fn sample_point_permille(&self) -> u32 {
        let before = 1 + self.segment_1();
        (before * 1000 / (before + self.segment_2())) as u32
    }

    /// By how much the clocks of two nodes may differ, in millionths (ISO 11898-1): in ten bits without an
    /// edge by no more than the jump width, and in the 13 bits until an error flag is sampled by no more than
    /// the shorter segment. Both nodes share it.
    fn tolerance_ppm(&self) -> u32 {
        let jump = u64::from(self.btr >> 24 & 3) + 1;
        let bit = 1 + self.segment_1() + self.segment_2();
        let by_jump = 1_000_000 * jump / (10 * bit);
        let shorter = self.segment_1().min(self.segment_2());
        let by_segment = 1_000_000 * shorter / (13 * bit - self.segment_2());
        // Below a million: a jump is shorter than a bit.
        by_jump.min(by_segment) as u32
    }

    /// Error counters.
    #[must_use]
    pub fn error_counters(&self) -> Confinement {
        self.confinement
    }

    fn segment_1(&self) -> u64 {
        u64::from(self.btr >> 16 & 15) + 1
    }

    fn segment_2(&self) -> u64 {
        u64::from(self.btr >> 20 & 7) + 1
    }

    /// Clock cycles of so many time quanta.
    fn cycles(&self, quanta: u64) -> u64 {
        quanta * (u64::from(self.btr & 0x3FF) + 1)
    }

    /// So many time quanta. At most 25 × 1024 cycles, so the product stays below 2^55.
    fn quanta(&self, count: u64) -> Option<Span> {
        (self.cycles(count) * PICOS).checked_div(u64::from(self.clock_hz)).map(Span)
    }

    fn bus_off(&self) -> bool {
        self.recovery != Recovery::None
    }

    // --- modes
    // -----------------------------------------------------------------------------------------------------

    /// Enters the mode that INRQ and SLEEP select, at once where the bus is not involved.
    fn follow_mode_bits(&mut self, now: Time) {
        let target = match (self.mcr & mcr::INRQ != 0, self.mcr & mcr::SLEEP != 0) {
            // With SLEEP, too: no arrow of the mode diagram (RM0090, figure "bxCAN operating modes")
            // takes both, but ST's HAL sets INRQ first and waits for INAK before it clears SLEEP, and
            // that runs on boards in the field.
            (true, _) => Some(Rest::Initialisation),
            (false, true) => Some(Rest::Sleep),
            (false, false) => None,
        };
        match (self.mode, target) {
            (Mode::Resting(_) | Mode::Synchronising { .. }, Some(rest)) => self.rest(rest),
            (Mode::Resting(from), None) => {
                self.mode = Mode::Synchronising { from, since: now };
                self.attend(now);
            }
            (Mode::Synchronising { .. }, None) => {}
            (Mode::Normal, Some(rest)) => {
                self.is_stuck |= self.silicon.can_sticks && self.activity != Activity::Idle;
                if !self.is_stuck && self.leaving.is_none_or(|(_, other)| other != rest) {
                    self.leaving = Some((now + Span::from_micros(self.silicon.can_mode_us.into()), rest));
                    self.attend(now);
                }
            }
            (Mode::Normal, None) => self.leaving = None,
        }
    }

    fn rest(&mut self, rest: Rest) {
        if rest == Rest::Sleep && self.mode != Mode::Resting(Rest::Sleep) && self.ier & ier::SLKIE != 0 {
            self.msr_flags |= msr::SLAKI;
        }
        self.mode = Mode::Resting(rest);
        self.leaving = None;
        if self.bus_off() {
            self.recovery = Recovery::NeedsInit;
        }
    }

    fn attend(&mut self, now: Time) {
        self.attention.get_or_insert(now);
    }

    /// MCR.RESET: back to sleep, FIFOs and requests gone, the configuration stays.
    fn master_reset(&mut self, now: Time) {
        self.reset_state();
        self.mcr = mcr::AFTER_RESET;
        self.attend(now);
    }

    fn reset_state(&mut self) {
        self.epoch = self.epoch.wrapping_add(1);
        self.mode = Mode::Resting(Rest::Sleep);
        self.leaving = None;
        self.is_stuck = false;
        self.frozen_aborts = 0;
        self.recovery = Recovery::None;
        self.activity = Activity::Idle;
        self.alone = None;
        self.confinement = Confinement::default();
        self.msr_flags = 0;
        self.last_error = 0;
        for mailbox in &mut self.mailboxes {
            mailbox.state = MailboxState::Empty;
            mailbox.flags = 0;
        }
        self.fifos = [Fifo::default(), Fifo::default()];
    }

    /// Without a bus the line stays recessive.
    fn hear_nothing(&mut self, now: Time) {
        if let Some((wait, due)) = self.wait_until() {
            if due <= now {
                self.event(BusEvent::Recessive { sequences: wait.sequences }, now);
            }
        }
        self.play_alone(now);
        if let Some((_, rest)) = self.leaving.filter(|_| self.alone.is_none()) {
            self.rest(rest);
        }
    }

    /// What it waits for without a bus, and when it has it.
    fn wait_until(&self) -> Option<(Wait, Time)> {
        let wait = self.wait()?;
        Some((wait, wait.since + Span(wait.bit.0 * SEQUENCE_BITS * u64::from(wait.sequences))))
    }

    /// Sends frames to itself, without a bus.
    fn play_alone(&mut self, now: Time) {
        let mut free_at = now;
        while let Some(due) = self.next_alone().filter(|&due| due <= now) {
            if self.alone.take().is_some() {
                let is_sent = |mailbox: &&Mailbox| matches!(mailbox.state, MailboxState::Transmit { .. });
                if let Some(frame) = self.mailboxes.iter().find(is_sent).map(Mailbox::frame) {
                    self.event(BusEvent::Received(frame), due);
                    self.event(BusEvent::Transmitted, due);
                }
                self.event(BusEvent::Ended, due);
                free_at = due;
                continue;
            }
            // It may have waited for the controller to be ready.
            let start = free_at.max(due);
            let (Some(bit), Some(frame)) = (self.bit_time(), self.request(start)) else { return };
            self.event(BusEvent::Started { own: true }, start);
            self.alone = Some(start + Span(bit.0 * u64::from(frame.wire_len() + INTERMISSION_BITS)));
        }
    }

    /// When the next frame to itself begins or ends, without a bus.
    fn next_alone(&self) -> Option<Time> {
        let plays = self.line().is_some_and(|line| line.loopback) && self.leaving.is_none();
        let request = self.mailboxes.iter().filter_map(|mailbox| match mailbox.state {
            MailboxState::Pending { since, .. } if plays => Some(since),
            _ => None,
        });
        self.alone.or(request.min())
    }

    // --- transmission
    // ----------------------------------------------------------------------------------------------

    /// The pending mailbox that goes first (RM0090, 32.7.1): in the order of the requests with
    /// TXFP, else by identifier, then by mailbox number.
    fn next_mailbox(&self, now: Time) -> Option<usize> {
        let pending = self.mailboxes.iter().enumerate().filter_map(|(n, mailbox)| match mailbox.state {
            MailboxState::Pending { since, order } if since <= now => Some((n, mailbox, order)),
            _ => None,
        });
        if self.mcr & mcr::TXFP != 0 {
            pending.min_by_key(|&(.., order)| order).map(|(n, ..)| n)
        } else {
            pending.min_by_key(|&(n, mailbox, _)| (mailbox.frame().arbitration_key(), n)).map(|(n, ..)| n)
        }
    }

    /// The mailbox that would be sent last, if any waits.
    fn last_mailbox(&self) -> Option<usize> {
        let waiting = (0..3).filter_map(|n| self.mailboxes[n].order().map(|order| (n, order)));
        if self.mcr & mcr::TXFP != 0 {
            waiting.max_by_key(|&(_, order)| order).map(|(n, _)| n)
        } else {
            waiting.max_by_key(|&(n, _)| (self.mailboxes[n].frame().arbitration_key(), n)).map(|(n, _)| n)
        }
    }

    fn read_tsr(&self) -> u32 {
        let mut value = if self.is_frozen() { self.frozen_aborts } else { 0 };
        for (n, mailbox) in self.mailboxes.iter().enumerate() {
            value |= mailbox.flags << (8 * n);
            match mailbox.state {
                MailboxState::Empty => value |= 1 << (26 + n),
                MailboxState::Transmit { abort: true, .. } => value |= tsr::ABRQ << (8 * n),
                _ => {}
            }
        }
        let waiting = self.mailboxes.iter().filter(|mailbox| mailbox.state != MailboxState::Empty).count();
        let last = self.last_mailbox();
        if waiting > 1 {
            value |= last.map_or(0, |n| 1 << (29 + n));
        }
        let free = self.mailboxes.iter().position(|mailbox| mailbox.state == MailboxState::Empty);
        // At most 2: the next free mailbox, or with none free the one that goes last.
        value | (free.or(last).unwrap_or(0) as u32) << 24
    }

    /// Whether the registers stand still.
    fn is_frozen(&self) -> bool {
        self.silicon.can_sleeps_deeply && self.mode == Mode::Resting(Rest::Sleep)
    }

    fn write_tsr(&mut self, value: u32) {
        if self.is_frozen() {
            self.frozen_aborts |= value & (tsr::ABRQ | tsr::ABRQ << 8 | tsr::ABRQ << 16);
            return;
        }
        for (n, mailbox) in self.mailboxes.iter_mut().enumerate() {
            let bits = value >> (8 * n);
            if bits & tsr::RQCP != 0 {
                mailbox.flags = 0;
            }
            mailbox.flags &= !(bits & (tsr::TXOK | tsr::ALST | tsr::TERR));
            if bits & tsr::ABRQ != 0 {
                match &mut mailbox.state {
                    MailboxState::Empty => {}
                    MailboxState::Pending { .. } => {
                        mailbox.flags &= !tsr::TXOK;
                        mailbox.complete();
                    }
                    MailboxState::Transmit { abort, .. } => *abort = true,
                }
            }
        }
    }

    fn write_mailbox(&mut self, n: usize, register: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        let order = self.requests;
        let mailbox = &mut self.mailboxes[n];
        if mailbox.state != MailboxState::Empty {
            return unmodelled(format!(
                "transmit mailbox {n} is written while it is not empty (TME{n} = 0): the write has no effect"
            ));
        }
        match register {
            0x0 => {
                mailbox.tir = value & !ir::TXRQ;
                if value & ir::TXRQ != 0 {
                    if self.silicon.can_forgets_requests && self.mode != Mode::Normal {
                        return unmodelled(
                            "TXRQ before INAK and SLAK are cleared: the controller may never send the frame",
                        );
                    }
                    mailbox.flags = 0;
                    mailbox.state = MailboxState::Pending { since: now, order };
                    self.requests += 1;
                    self.attend(now);
                    self.check_pins()?;
                }
            }
            0x4 => {
                mailbox.tdtr = value & 0xF;
                if value & TGT != 0 {
                    return unmodelled(format!("TDT{n}R.TGT: transmit global time is not modelled"));
                }
            }
            0x8 => mailbox.tdlr = value,
            _ => mailbox.tdhr = value,
        }
        Ok(())
    }

    /// Checks that what is to be sent comes to a transceiver.
    fn check_pins(&self) -> Result<(), Unmodelled> {
        let needed = self.btr & (btr::LBKM | btr::SILM) == 0;
        let missing = match self.pins {
            Pins { rx: false, tx: false } => "RX and TX",
            Pins { rx: false, .. } => "RX",
            Pins { tx: false, .. } => "TX",
            Pins { .. } => return Ok(()),
        };
        if needed {
            let name = self.name();
            return unmodelled(format!(
                "{name} sends, and no pin of this package has its {missing} (GPIO: MODER 10b and the alternate \
                 function): set up a pin that the package has, nothing is received or heard until then"
            ));
        }
        Ok(())
    }

    /// The frame on the wire ended without success for one of the reasons `flag` (ALST, TERR).
    fn transmission_failed(&mut self, flag: u32) {
        let no_retry = self.mcr & mcr::NART != 0;
        for mailbox in &mut self.mailboxes {
            if let MailboxState::Transmit { since, order, abort } = mailbox.state {
                mailbox.flags = mailbox.flags & !(tsr::TXOK | tsr::ALST | tsr::TERR) | flag;
                if no_retry || abort {
                    mailbox.complete();
                } else {
                    mailbox.state = MailboxState::Pending { since, order };
                }
            }
        }
    }

    // --- reception and errors
    // --------------------------------------------------------------------------------------

    fn store(&mut self, frame: &Frame) {
        if !self.master_clocked {
            return;
        }
        if let Some(found) = self.filters.accept(self.share, frame) {
            let locked = self.mcr & mcr::RFLM != 0;
            let stamp = self.time_stamp();
            let fifo = &mut self.fifos[found.fifo];
            let before = fifo.frames.back().unwrap_or(&fifo.stale);
            let received = RxMailbox::new(frame, found.index, stamp, before);
            fifo.store(received, locked);
        }
    }

    /// TIME of RDTxR and TDTxR: the counter of bit times at the start of the frame, in time-triggered mode
    /// (RM0090 section 32.7.2).
    fn time_stamp(&self) -> u32 {
        match self.bit_time() {
            Some(bit) if self.mcr & mcr::TTCM != 0 => ((self.frame_start.0 / bit.0.max(1)) as u32) << 16,
            _ => 0,
        }
    }

    fn no_register(&self, offset: u32) -> Unmodelled {
        Unmodelled(format!("{} has no register at offset {offset:#x}", self.name()))
    }

    fn esr_flags(&self) -> u32 {
        let passive = self.confinement.state() != ErrorState::Active;
        let flags =
            [(self.confinement.warning(), esr::EWGF), (passive, esr::EPVF), (self.bus_off(), esr::BOFF)];
        flags.into_iter().filter(|(set, _)| *set).map(|(_, flag)| flag).sum()
    }

    /// Counts an error (or a success, `kind` = `None`), and raises ERRI for what is new and
    /// enabled.
    fn count(&mut self, kind: Option<ErrorKind>, now: Time, count: impl FnOnce(&mut Confinement)) {
        let before = self.esr_flags();
        count(&mut self.confinement);
        if self.confinement.state() == ErrorState::BusOff && !self.bus_off() {
            self.recovery = if self.mcr & mcr::ABOM != 0 {
                Recovery::Counting { since: now, left: RECOVERY_SEQUENCES }
            } else {
                Recovery::NeedsInit
            };
        }
        let new = self.esr_flags() & !before;
        self.last_error = match kind {
            None => 0,
            Some(ErrorKind::Stuff) => 1,
            Some(ErrorKind::Form) => 2,
            Some(ErrorKind::Acknowledge) => 3,
            Some(ErrorKind::BitRecessive) => 4,
            Some(ErrorKind::BitDominant) => 5,
            Some(ErrorKind::Crc) => 6,
        };
        let enabled = [(esr::EWGF, ier::EWGIE), (esr::EPVF, ier::EPVIE), (esr::BOFF, ier::BOFIE)];
        let flagged = enabled.into_iter().any(|(flag, enable)| new & flag != 0 && self.ier & enable != 0);
        if flagged || kind.is_some() && self.ier & ier::LECIE != 0 {
            self.msr_flags |= msr::ERRI;
        }
    }

    fn read_esr(&self) -> u32 {
        let tec = u32::from(self.confinement.tec().min(255));
        self.esr_flags()
            | self.last_error << esr::LEC_SHIFT
            | tec << 16
            | u32::from(self.confinement.rec()) << 24
    }

    fn read_msr(&self) -> u32 {
        let mode = match self.mode {
            Mode::Resting(Rest::Initialisation) | Mode::Synchronising { from: Rest::Initialisation, .. } => {
                msr::INAK
            }
            Mode::Resting(Rest::Sleep) | Mode::Synchronising { from: Rest::Sleep, .. } => msr::SLAK,
            Mode::Normal => 0,
        };
        let activity = match self.activity {
            Activity::Idle => 0,
            Activity::Transmitting => msr::TXM,
            Activity::Receiving => msr::RXM,
        };
        mode | activity | self.msr_flags | msr::SAMP | msr::RX
    }
}

/// The transmit mailbox and the register in it, or the receive FIFO and the register in it.
enum Mail {
    Transmit(usize, u32),
    Receive(usize, u32),
}

fn mail(offset: u32) -> Option<Mail> {
    let at = |base: u32| (((offset - base) / 0x10) as usize, offset & 0xC);
    match offset {
        0x180..=0x1AC => {
            let (n, register) = at(0x180);
            Some(Mail::Transmit(n, register))
        }
        0x1B0..=0x1CC => {
            let (n, register) = at(0x1B0);
            Some(Mail::Receive(n, register))
        }
        _ => None,
    }
}

impl Peripheral for BxCan {
    fn name(&self) -> &'static str {
        match self.share {
            Share::Can1 => "CAN1",
            Share::Can2 => "CAN2",
        }
    }

    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        self.advance(now);
        self.check(offset)?;
        Ok(match offset {
            0x00 => self.mcr,
            0x04 => self.read_msr(),
            0x08 => self.read_tsr(),
            0x0C => self.fifos[0].read_status(),
            0x10 => self.fifos[1].read_status(),
            0x14 => self.ier,
            0x18 => self.read_esr(),
            0x1C => self.btr,
            0x200.. => self.filters.read(offset)?,
            _ => match mail(offset) {
                Some(Mail::Transmit(n, register)) => {
                    let mailbox = &self.mailboxes[n];
                    match register {
                        0x0 if mailbox.state == MailboxState::Empty => mailbox.tir,
                        0x0 => mailbox.tir | ir::TXRQ,
                        0x4 => mailbox.tdtr,
                        0x8 => mailbox.tdlr,
                        _ => mailbox.tdhr,
                    }
                }
                Some(Mail::Receive(n, register)) => {
                    let output = self.fifos[n].output();
                    match register {
                        0x0 => output.rir,
                        0x4 => output.rdtr,
                        0x8 => output.rdlr,
                        _ => output.rdhr,
                    }
                }
                None => return Err(self.no_register(offset)),
            },
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        self.advance(now);
        self.check(offset)?;
        match offset {
            0x00 => {
                if value & mcr::RESET != 0 {
                    self.master_reset(now);
                    return Ok(());
                }
                self.mcr = value & mcr::KEPT;
                if self.mcr & mcr::ABOM != 0
                    && self.mode == Mode::Normal
                    && self.recovery == Recovery::NeedsInit
                {
                    self.recovery = Recovery::Counting { since: now, left: RECOVERY_SEQUENCES };
                }
                self.follow_mode_bits(now);
                if value & !(mcr::KEPT | mcr::RESET) != 0 {
                    return unmodelled(format!("MCR: reserved bits set in {value:#010x}"));
                }
            }
            0x04 => self.msr_flags &= !(value & (msr::ERRI | msr::WKUI | msr::SLAKI)),
            0x08 => self.write_tsr(value),
            0x0C => self.fifos[0].write_status(value),
            0x10 => self.fifos[1].write_status(value),
            0x14 => {
                self.ier = value & ier::ALL;
                if value & !ier::ALL != 0 {
                    return unmodelled(format!("IER: reserved bits set in {value:#010x}"));
                }
            }
            0x18 if self.is_frozen() => {}
            0x18 => self.last_error = value >> esr::LEC_SHIFT & 7,
            0x1C => {
                if !matches!(
                    self.mode,
                    Mode::Resting(Rest::Initialisation)
                        | Mode::Synchronising { from: Rest::Initialisation, .. }
                ) {
                    return unmodelled("BTR is written outside initialisation mode: the write has no effect");
                }
                self.btr = value & btr::ALL;
            }
            0x200.. => self.filters.write(offset, value)?,
            _ => match mail(offset) {
                Some(Mail::Transmit(n, register)) => self.write_mailbox(n, register, value, now)?,
                Some(Mail::Receive(n, _)) => {
                    return unmodelled(format!("receive mailbox {n} is written: its registers are read-only"))
                }
                None => return Err(self.no_register(offset)),
            },
        }
        Ok(())
    }

    fn advance(&mut self, now: Time) {
        if !self.on_bus {
            self.hear_nothing(now);
        }
    }

    fn next_event(&self) -> Option<Time> {
        if self.on_bus {
            return None; // the bus knows
        }
        self.wait_until().map(|(_, due)| due).into_iter().chain(self.next_alone()).min()
    }

    fn interrupts(&self, active: &mut Vec<u16>) {
        let transmitted = self.mailboxes.iter().any(|mailbox| mailbox.flags & tsr::RQCP != 0);
        let status = [(ier::ERRIE, msr::ERRI), (ier::WKUIE, msr::WKUI), (ier::SLKIE, msr::SLAKI)]
            .into_iter()
            .any(|(enable, flag)| self.ier & enable != 0 && self.msr_flags & flag != 0);
        let Lines { tx, rx0, rx1, sce } = self.lines();
        let lines = [
            (self.ier & ier::TMEIE != 0 && transmitted, tx),
            (self.fifos[0].interrupt(self.ier), rx0),
            (self.fifos[1].interrupt(self.ier >> 3), rx1),
            (status, sce),
        ];
        active.extend(lines.into_iter().filter(|(set, _)| *set).map(|(_, line)| line));
    }

    fn reset(&mut self) {
        self.reset_state();
        // Only a reset of CAN1 resets the filters.
        let filters = match self.share {
            Share::Can1 => Filters::default(),
            Share::Can2 => self.filters.clone(),
        };
        *self = Self {
            share: self.share,
            master_clocked: self.master_clocked,
            clock_hz: self.clock_hz,
            on_bus: self.on_bus,
            pins: self.pins,
            epoch: self.epoch,
            silicon: self.silicon,
            filters,
            ..Self::new()
        };
    }
}

impl BusNode for BxCan {
    fn line(&self) -> Option<Line> {
        if self.mode != Mode::Normal || self.bus_off() {
            return None;
        }
        Some(Line {
            bit: self.bit_time()?,
            sample: self.quanta(1 + self.segment_1())?,
            tolerance_ppm: self.tolerance_ppm(),
            silent: self.btr & btr::SILM != 0,
            loopback: self.btr & btr::LBKM != 0,
            pins: self.pins,
        })
    }

    fn epoch(&self) -> u32 {
        self.epoch
    }

    fn confinement(&self) -> Confinement {
        self.confinement
    }

    fn request(&self, now: Time) -> Option<Frame> {
        self.next_mailbox(now).map(|n| self.mailboxes[n].frame())
    }

    fn next_request(&self, now: Time) -> Option<Time> {
        let later = self.mailboxes.iter().filter_map(|mailbox| match mailbox.state {
            MailboxState::Pending { since, .. } if since > now => Some(since),
            _ => None,
        });
        later.min()
    }

    fn wait(&self) -> Option<Wait> {
        let (since, sequences) = match (self.mode, self.recovery) {
            (Mode::Synchronising { since, .. }, _) => (since, 1),
            (Mode::Normal, Recovery::Counting { since, left }) => (since, left),
            _ => return None,
        };
        let hears = self.pins.rx && self.btr & btr::LBKM == 0;
        Some(Wait { since, sequences, bit: self.bit_time()?, hears })
    }

    fn leaving(&self) -> Option<Time> {
        self.leaving.map(|(since, _)| since)
    }

    fn event(&mut self, event: BusEvent, now: Time) {
        match event {
            BusEvent::Started { own: false } if !self.pins.rx => {}
            BusEvent::Started { own } => {
                self.frame_start = now;
                if self.mode == Mode::Resting(Rest::Sleep) {
                    self.msr_flags |= msr::WKUI;
                    if self.mcr & mcr::AWUM != 0 {
                        self.mcr &= !mcr::SLEEP;
                        self.follow_mode_bits(now);
                    }
                } else if self.mode == Mode::Normal && !self.bus_off() {
                    self.activity = if own { Activity::Transmitting } else { Activity::Receiving };
                }
                if own {
                    if let Some(n) = self.next_mailbox(now) {
                        if let MailboxState::Pending { since, order } = self.mailboxes[n].state {
                            self.mailboxes[n].state = MailboxState::Transmit { since, order, abort: false };
                        }
                    }
                }
            }
            BusEvent::ArbitrationLost => {
                self.activity = Activity::Receiving;
                self.transmission_failed(tsr::ALST);
            }
            BusEvent::Transmitted => {
                let stamp = self.time_stamp();
                for mailbox in &mut self.mailboxes {
                    if matches!(mailbox.state, MailboxState::Transmit { .. }) {
                        mailbox.flags = tsr::TXOK;
                        mailbox.tdtr = mailbox.tdtr & 0xFFFF | stamp;
                        mailbox.complete();
                    }
                }
                self.count(None, now, Confinement::transmitted);
            }
            BusEvent::TransmitFailed { kind, exempt } => {
                self.transmission_failed(tsr::TERR);
                self.count(Some(kind), now, |counters| counters.transmit_failed(exempt));
            }
            BusEvent::Received(frame) => {
                self.store(&frame);
                if self.btr & btr::LBKM == 0 {
                    self.count(None, now, Confinement::received);
                }
            }
            BusEvent::Missed => self.count(None, now, Confinement::received),
            BusEvent::ReceiveFailed { kind, first } => {
                self.count(Some(kind), now, |counters| counters.receive_failed(first));
            }
            BusEvent::StaysDominant { own } => {
                // The manual has no last error code for it: the one of the error frame stays.
                let kind = self.last_error;
                self.count(Some(ErrorKind::Form), now, |counters| counters.stays_dominant(own));
                self.last_error = kind;
            }
            BusEvent::Recessive { sequences } => self.heard_recessive(sequences, now),
            BusEvent::Released => {
                if let Some((_, rest)) = self.leaving {
                    self.rest(rest);
                }
            }
            BusEvent::Ended => self.activity = Activity::Idle,
        }
    }

    fn resolved(&mut self, now: Time) {
        self.on_bus = true;
        if self.attention.is_some_and(|since| since <= now) {
            self.attention = None;
        }
    }
}

impl BxCan {
    fn heard_recessive(&mut self, sequences: u32, now: Time) {
        if let Mode::Synchronising { .. } = self.mode {
            if sequences == 0 {
                return;
            }
            self.mode = Mode::Normal;
            if self.recovery == Recovery::NeedsInit {
                self.recovery = Recovery::Counting { since: now, left: RECOVERY_SEQUENCES - 1 };
            }
            return;
        }
        if let Recovery::Counting { left, .. } = self.recovery {
            match left.saturating_sub(sequences) {
                0 => {
                    self.recovery = Recovery::None;
                    self.confinement.recovered();
                }
                left => self.recovery = Recovery::Counting { since: now, left },
            }
        }
    }
}
