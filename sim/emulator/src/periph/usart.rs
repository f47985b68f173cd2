//! Universal (synchronous) asynchronous receiver transmitter (RM0090 section 30), and the line at
//! its two pins.
//!
//! The outside uses 8N1 at a bit rate of its own. The model covers a serial port: start bit, eight
//! data bits, stop bits, one data register and one shift register each way, their flags and
//! interrupts. Parity, nine bits, idle and break detection, flow control, LIN, IrDA, smart cards,
//! the synchronous mode and DMA are reported when a program uses them.

use std::collections::VecDeque;

use crate::clock::picos_of;
use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::time::{Span, Time};

/// The place of a USART in the chip.
#[derive(Debug, PartialEq, Eq)]
pub struct Instance {
    /// Name as in the reference manual.
    pub name: &'static str,
    /// Its interrupt line (RM0090, table 61).
    pub line: u16,
    /// Whether it is clocked from APB2; from APB1 otherwise.
    pub apb2: bool,
    /// Pins that can be its transmitter.
    pub tx: Pins,
    /// Pins that can be its receiver.
    pub rx: Pins,
}

/// Port, number, alternate function (datasheets, alternate function mapping).
type Pins = &'static [(char, u8, u8)];

const fn instance(name: &'static str, line: u16, apb2: bool, tx: Pins, rx: Pins) -> Instance {
    Instance { name, line, apb2, tx, rx }
}

/// The USARTs that every known chip has, with the pins that the chips have in common.
pub static INSTANCES: [Instance; 6] = [
    instance("USART1", 37, true, &[('A', 9, 7), ('B', 6, 7)], &[('A', 10, 7), ('B', 7, 7)]),
    instance("USART2", 38, false, &[('A', 2, 7), ('D', 5, 7)], &[('A', 3, 7), ('D', 6, 7)]),
    instance(
        "USART3",
        39,
        false,
        &[('B', 10, 7), ('C', 10, 7), ('D', 8, 7)],
        &[('B', 11, 7), ('C', 11, 7), ('D', 9, 7)],
    ),
    instance("UART4", 52, false, &[('A', 0, 8), ('C', 10, 8)], &[('A', 1, 8), ('C', 11, 8)]),
    instance("UART5", 53, false, &[('C', 12, 8)], &[('D', 2, 8)]),
    instance("USART6", 71, true, &[('C', 6, 8), ('G', 14, 8)], &[('C', 7, 8), ('G', 9, 8)]),
];

/// `USART_SR`.
mod sr {
    pub const FE: u32 = 1 << 1;
    pub const ORE: u32 = 1 << 3;
    pub const RXNE: u32 = 1 << 5;
    pub const TC: u32 = 1 << 6;
    pub const TXE: u32 = 1 << 7;
    pub const AFTER_RESET: u32 = TXE | TC;
    /// Go with a read of SR and then of DR.
    pub const ERRORS: u32 = FE | ORE;
}

/// `USART_CR1`.
mod cr1 {
    pub const SBK: u32 = 1 << 0;
    pub const RWU: u32 = 1 << 1;
    pub const RE: u32 = 1 << 2;
    pub const TE: u32 = 1 << 3;
    pub const IDLEIE: u32 = 1 << 4;
    pub const RXNEIE: u32 = 1 << 5;
    pub const TCIE: u32 = 1 << 6;
    pub const TXEIE: u32 = 1 << 7;
    pub const PCE: u32 = 1 << 10;
    pub const M: u32 = 1 << 12;
    pub const UE: u32 = 1 << 13;
    pub const OVER8: u32 = 1 << 15;
    pub const ALL: u32 = 0xBFFF;
}

/// `USART_CR2`: what is modelled of it.
const CR2_STOP: u32 = 3 << 12;
const CR2_ALL: u32 = 0x7F6F;
/// `USART_CR3`: what is modelled of it, which is what does nothing without DMA and changes nothing
/// here.
const CR3_EIE: u32 = 1 << 0;
const CR3_ONEBIT: u32 = 1 << 11;
const CR3_ALL: u32 = 0x0FFF;

/// Start bit, data and one stop bit.
const OUTSIDE_BITS: u64 = 10;
/// A receiver whose bit rate is further off than this many parts in a thousand cannot read the
/// character (section 30.3.5, tolerance with eight bits and the fraction in use, rounded).
const TOLERANCE: u64 = 38;
/// The most characters that wait for [`Usart::take_sent`].
const MOST_HEARD: usize = 64 * 1024;
/// Characters that wait outside to be sent to the chip.
const MOST_WAITING: usize = 64 * 1024;

/// A character as it was on the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Character {
    /// When its last stop bit ended.
    pub end: Time,
    /// Its data bits.
    pub byte: u8,
    /// The bit rate that it was sent with, in bit/s, rounded.
    pub bit_rate: u32,
}

/// The content of the transmitter's shift register; without a word it is the idle frame after TE.
#[derive(Clone, Copy, Debug)]
struct Shift {
    word: Option<u8>,
    end: Time,
}

/// A character that comes in.
#[derive(Clone, Copy, Debug)]
struct Incoming {
    byte: u8,
    end: Time,
    /// The receiver was on when its start bit came.
    heard: bool,
}

/// The outside end of the line.
#[derive(Clone, Debug)]
struct Outside {
    bit_rate: u32,
    waiting: VecDeque<u8>,
    incoming: Option<Incoming>,
    heard: VecDeque<Character>,
}

/// One USART.
#[derive(Clone, Debug)]
pub struct Usart {
    instance: &'static Instance,
    clock: u32,
    /// A pin of the chip is its transmitter, its receiver.
    wired: (bool, bool),
    accesses: u64,
    flags: u32,
    /// The flags as SR was last read, as far as nothing was done about them.
    seen: u32,
    received: u8,
    to_send: Option<u8>,
    shift: Option<Shift>,
    brr: u32,
    cr1: u32,
    cr2: u32,
    cr3: u32,
    gtpr: u32,
    outside: Outside,
}

impl Usart {
    /// As after a reset, without a clock.
    #[must_use]
    pub fn new(instance: &'static Instance) -> Self {
        Self {
            instance,
            clock: 0,
            wired: (false, false),
            accesses: 0,
            flags: sr::AFTER_RESET,
            seen: 0,
            received: 0,
            to_send: None,
            shift: None,
            brr: 0,
            cr1: 0,
            cr2: 0,
            cr3: 0,
            gtpr: 0,
            outside: Outside {
                bit_rate: 115_200,
                waiting: VecDeque::new(),
                incoming: None,
                heard: VecDeque::new(),
            },
        }
    }

    /// Where it is in the chip.
    #[must_use]
    pub fn instance(&self) -> &'static Instance {
        self.instance
    }

    /// How often the program has read or written one of its registers since the machine was made.
    #[must_use]
    pub fn accesses(&self) -> u64 {
        self.accesses
    }

    /// The frequency that it runs with; 0 without a clock.
    pub fn set_clock(&mut self, hz: u32) {
        self.clock = hz;
    }

    /// Which of its pins (transmitter, receiver) the program has chosen.
    pub fn set_wired(&mut self, tx: bool, rx: bool) {
        self.wired = (tx, rx);
    }

    /// Sets the bit rate of the outside, in bit/s; 115 200 before the first call.
    ///
    /// # Panics
    /// For 0.
    pub fn set_outside_bit_rate(&mut self, bit_rate: u32) {
        assert!(bit_rate > 0, "a line without a bit rate");
        self.outside.bit_rate = bit_rate;
    }

    /// The outside sends bytes, one after the other, from `now` on. Returns how many it takes; the
    /// caller has to pass the rest again.
    pub fn receive(&mut self, bytes: &[u8], now: Time) -> usize {
        let room = MOST_WAITING - self.outside.waiting.len();
        let taken = bytes.len().min(room);
        self.outside.waiting.extend(&bytes[..taken]);
        if self.outside.incoming.is_none() {
            self.next_incoming(now);
        }
        taken
    }

    /// Bytes that the outside has not sent yet.
    #[must_use]
    pub fn waiting(&self) -> usize {
        self.outside.waiting.len() + usize::from(self.outside.incoming.is_some())
    }

    /// The characters that the chip has sent since the last call. The oldest are lost if there was
    /// no call for long.
    pub fn take_sent(&mut self) -> Vec<Character> {
        self.outside.heard.drain(..).collect()
    }

    /// The power goes off: the characters on the line are lost.
    pub fn lose_power(&mut self) {
        self.outside.waiting.clear();
        self.outside.incoming = None;
        self.reset();
    }

    /// Cycles of the clock for one bit (section 30.3.4), if there can be one.
    fn divider(&self) -> Option<u64> {
        let divider = if self.cr1 & cr1::OVER8 == 0 {
            self.brr & 0xFFFF
        } else {
            (self.brr >> 4 & 0xFFF) * 8 + (self.brr & 7)
        };
        // USARTDIV has to be 1 at least.
        let least = if self.cr1 & cr1::OVER8 == 0 { 16 } else { 8 };
        (self.clock > 0 && divider >= least).then_some(divider.into())
    }

    /// The bit rate that is set up, rounded; 0 where there is none.
    fn bit_rate(&self) -> u32 {
        self.divider()
            .map_or(0, |divider| u32::try_from((u64::from(self.clock) + divider / 2) / divider).unwrap_or(0))
    }

    /// How long a character takes that it sends; CR2 says with how many stop bits.
    fn span(&self) -> Option<Span> {
        let stop_halves = match (self.cr2 & CR2_STOP) >> 12 {
            0 => 2,
            1 => 1,
            2 => 4,
            _ => 3,
        };
        let cycles = self.divider()? * (18 + stop_halves);
        Some(Span(picos_of(cycles, 2 * u64::from(self.clock))))
    }

    fn is_on(&self, direction: u32) -> bool {
        self.cr1 & (cr1::UE | direction) == cr1::UE | direction
    }

    /// Puts a character (or the idle frame) into the shift register.
    fn begin(&mut self, word: Option<u8>, at: Time) {
        self.shift = self.span().map(|span| Shift { word, end: at + span });
    }

    fn next_incoming(&mut self, at: Time) {
        let span = Span(picos_of(OUTSIDE_BITS, self.outside.bit_rate.into()));
        let heard = self.is_on(cr1::RE) && self.wired.1 && self.divider().is_some();
        let next = self.outside.waiting.pop_front();
        self.outside.incoming = next.map(|byte| Incoming { byte, end: at + span, heard });
    }

    fn arrive(&mut self, incoming: Incoming) {
        if !incoming.heard || !self.is_on(cr1::RE) {
            return;
        }
        let (ours, theirs) = (u64::from(self.bit_rate()), u64::from(self.outside.bit_rate));
        let readable = ours.abs_diff(theirs) * 1000 <= theirs * TOLERANCE;
        if self.flags & sr::RXNE != 0 {
            // The register keeps its character, this one is lost (section 30.3.3).
            self.flags |= sr::ORE;
            return;
        }
        self.flags |= sr::RXNE;
        // Bits sampled at the wrong places: the next best thing to what silicon would make of them.
        self.received = if readable { incoming.byte } else { incoming.byte ^ 0xA5 };
        if !readable {
            self.flags |= sr::FE;
        }
    }

    fn write_cr1(&mut self, value: u32, now: Time) -> Result<(), Unmodelled> {
        let before = self.cr1;
        self.cr1 = value & cr1::ALL;
        let on = cr1::UE | cr1::TE;
        if self.cr1 & on == on && before & on != on {
            if self.divider().is_none() {
                return unmodelled(
                    "the transmitter is switched on without a bit rate (USART_BRR: 16 cycles a bit at least, 8 with \
                     OVER8)",
                );
            }
            // Section 30.3.2: an idle frame goes first.
            self.begin(None, now);
        }
        if self.cr1 & cr1::UE == 0 {
            self.shift = None;
            self.to_send = None;
            self.flags = sr::AFTER_RESET;
        }
        match self.cr1 & (cr1::SBK | cr1::RWU | cr1::IDLEIE | cr1::PCE | cr1::M) {
            0 => Ok(()),
            bits => unmodelled(format!(
                "of USART_CR1, {bits:04X}h is not modelled: break, mute mode, idle interrupt, parity, nine bits"
            )),
        }
    }

    fn write_dr(&mut self, byte: u8, now: Time) -> Result<(), Unmodelled> {
        if !self.is_on(cr1::TE) {
            return unmodelled("a character is written while the transmitter is off: it is lost");
        }
        if self.seen & sr::TC != 0 {
            self.seen &= !sr::TC;
            self.flags &= !sr::TC;
        }
        let lost = self.to_send.is_some();
        if self.shift.is_none() {
            self.begin(Some(byte), now);
        } else {
            self.to_send = Some(byte);
            self.flags &= !sr::TXE;
        }
        if !self.wired.0 {
            let Instance { name, tx, .. } = self.instance;
            let pins: Vec<_> = tx.iter().map(|(port, pin, _)| format!("P{port}{pin}")).collect();
            return unmodelled(format!(
                "a character is sent, but no pin is the transmitter of {name} (GPIO: alternate function of {})",
                pins.join(", ")
            ));
        }
        if lost {
            return unmodelled("a character is written although TXE is clear: the one before is lost");
        }
        Ok(())
    }
}

impl Peripheral for Usart {
    fn name(&self) -> &'static str {
        self.instance.name
    }

    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        self.accesses += 1;
        self.advance(now);
        Ok(match offset {
            0x00 => {
                self.seen = self.flags;
                self.flags
            }
            0x04 => {
                self.flags &= !(sr::RXNE | self.seen & sr::ERRORS);
                self.seen &= !sr::ERRORS;
                self.received.into()
            }
            0x08 => self.brr,
            0x0C => self.cr1,
            0x10 => self.cr2,
            0x14 => self.cr3,
            0x18 => self.gtpr,
            _ => return unmodelled("a USART has no such register"),
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        self.accesses += 1;
        self.advance(now);
        match offset {
            // Section 30.6.1: these two go when 0 is written.
            0x00 => self.flags &= value | !(sr::RXNE | sr::TC),
            // With eight bits the ninth says nothing.
            0x04 => return self.write_dr((value & 0xFF) as u8, now),
            0x08 => self.brr = value & 0xFFFF,
            0x0C => return self.write_cr1(value, now),
            0x10 => {
                self.cr2 = value & CR2_ALL;
                if self.cr2 & !CR2_STOP != 0 {
                    return unmodelled("of USART_CR2, only the stop bits are modelled");
                }
            }
            0x14 => {
                self.cr3 = value & CR3_ALL;
                if self.cr3 & !(CR3_EIE | CR3_ONEBIT) != 0 {
                    return unmodelled(
                        "of USART_CR3, DMA, flow control, smart cards, IrDA and half duplex are not modelled",
                    );
                }
            }
            0x18 => self.gtpr = value & 0xFFFF,
            _ => return unmodelled("a USART has no such register"),
        }
        Ok(())
    }

    fn advance(&mut self, now: Time) {
        while let Some(shift) = self.shift.filter(|shift| shift.end <= now) {
            self.shift = None;
            if let (Some(byte), true) = (shift.word, self.wired.0) {
                if self.outside.heard.len() == MOST_HEARD {
                    self.outside.heard.pop_front();
                }
                let bit_rate = self.bit_rate();
                self.outside.heard.push_back(Character { end: shift.end, byte, bit_rate });
            }
            match self.to_send.take() {
                Some(byte) if self.is_on(cr1::TE) => {
                    self.flags |= sr::TXE;
                    self.begin(Some(byte), shift.end);
                }
                _ if shift.word.is_some() => self.flags |= sr::TC | sr::TXE,
                _ => {}
            }
        }
        while let Some(incoming) = self.outside.incoming.filter(|incoming| incoming.end <= now) {
            self.arrive(incoming);
            self.next_incoming(incoming.end);
        }
    }

    fn next_event(&self) -> Option<Time> {
        let out = self.shift.map(|shift| shift.end);
        let come_in = self.outside.incoming.map(|incoming| incoming.end);
        out.into_iter().chain(come_in).min()
    }

    /// Section 30.4. An overrun interrupts by itself with DMA alone, and with RXNEIE.
    fn interrupts(&self, active: &mut Vec<u16>) {
        let asked = [(cr1::TXEIE, sr::TXE), (cr1::TCIE, sr::TC), (cr1::RXNEIE, sr::RXNE | sr::ORE)];
        if asked.iter().any(|&(enable, flags)| self.cr1 & enable != 0 && self.flags & flags != 0) {
            active.push(self.instance.line);
        }
    }

    fn reset(&mut self) {
        let outside = std::mem::replace(&mut self.outside, Self::new(self.instance).outside);
        *self = Self {
            clock: self.clock,
            wired: self.wired,
            accesses: self.accesses,
            outside,
            ..Self::new(self.instance)
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SR: u32 = 0x00;
    const DR: u32 = 0x04;
    const BRR: u32 = 0x08;
    const CR1: u32 = 0x0C;
    const MICRO: u64 = 1_000_000;

    /// On, both ways, at 42 MHz and 22.8125 × 16 cycles a bit: 115 068 bit/s, 0.11 % from 115 200
    /// (section 30.3.4).
    fn on(enable: u32) -> Usart {
        let mut usart = Usart::new(&INSTANCES[1]);
        usart.set_clock(42_000_000);
        usart.set_wired(true, true);
        usart.write(BRR, 22 << 4 | 13, Time(0)).unwrap();
        usart.write(CR1, 1 << 13 | 1 << 3 | 1 << 2 | enable, Time(0)).unwrap();
        // The idle frame after TE.
        usart.advance(Time(100 * MICRO));
        usart
    }

    fn text(usart: &mut Usart) -> Vec<u8> {
        usart.take_sent().iter().map(|character| character.byte).collect()
    }

    /// The two examples of section 30.3.4: 27.75 is 1BCh with 16 samples a bit, and 1B6h with 8.
    #[test]
    fn the_divider_is_read_as_in_the_manual() {
        let mut usart = Usart::new(&INSTANCES[0]);
        usart.set_clock(27_750_000 * 16);
        usart.write(BRR, 0x1BC, Time(0)).unwrap();
        assert_eq!(usart.bit_rate(), 1_000_000);
        usart.write(CR1, 1 << 15, Time(0)).unwrap();
        usart.write(BRR, 0x1B6, Time(0)).unwrap();
        assert_eq!(usart.bit_rate(), 2_000_000);
        usart.write(CR1, 0, Time(0)).unwrap();
        usart.write(BRR, 0xF, Time(0)).unwrap();
        assert!(usart.write(CR1, 1 << 13 | 1 << 3, Time(0)).is_err(), "less than 16 cycles a bit");
    }

    #[test]
    fn registers_after_a_reset() {
        let mut usart = on(0);
        usart.reset();
        let values: Vec<u32> = (0..7).map(|n| usart.read(4 * n, Time(0)).unwrap()).collect();
        assert_eq!(values, [0xC0, 0, 0, 0, 0, 0, 0]);
        assert!(usart.read(0x1C, Time(0)).is_err());
    }

    #[test]
    fn two_characters_fit_and_each_takes_ten_bits() {
        let mut usart = on(0);
        let start = Time(1000 * MICRO);
        assert_eq!(usart.read(SR, start), Ok(0xC0));
        usart.write(DR, b'a'.into(), start).unwrap();
        // Into the shift register at once; TC went with the read of SR and the write of DR.
        assert_eq!(usart.read(SR, start), Ok(0x80));
        usart.write(DR, b'b'.into(), start).unwrap();
        assert_eq!(usart.read(SR, start), Ok(0x00));
        assert!(usart.write(DR, b'c'.into(), start).is_err(), "TXE is clear");
        // 3650 cycles at 42 MHz: 86.904 µs.
        assert_eq!(usart.next_event(), Some(start + Span(86_904_762)));
        usart.advance(Time(1087 * MICRO));
        assert_eq!(usart.read(SR, Time(1087 * MICRO)), Ok(0x80));
        usart.advance(Time(2000 * MICRO));
        assert_eq!(usart.read(SR, Time(2000 * MICRO)), Ok(0xC0));
        let heard = usart.take_sent();
        assert_eq!(heard.iter().map(|c| c.byte).collect::<Vec<_>>(), *b"ac");
        assert_eq!((heard[0].bit_rate, heard[1].end), (115_068, start + Span(2 * 86_904_762)));
    }

    /// The idle frame goes first, and two stop bits make a character longer.
    #[test]
    fn the_line_is_idle_for_a_character_first() {
        let mut usart = Usart::new(&INSTANCES[5]);
        usart.set_clock(16_000_000);
        usart.set_wired(true, false);
        usart.write(0x10, 2 << 12, Time(0)).unwrap();
        usart.write(BRR, 16, Time(0)).unwrap();
        usart.write(CR1, 1 << 13 | 1 << 3, Time(0)).unwrap();
        usart.write(DR, 0x55, Time(0)).unwrap();
        usart.advance(Time(100 * MICRO));
        let heard = usart.take_sent();
        assert_eq!(heard, [Character { end: Time(22 * MICRO), byte: 0x55, bit_rate: 1_000_000 }]);
    }

    #[test]
    fn interrupts_follow_flags_that_are_asked_for() {
        let mut usart = on(0);
        assert!(usart.active().is_empty());
        for (enable, active) in [(1 << 7, true), (1 << 6, true), (1 << 5, false), (0, false)] {
            usart.write(CR1, 1 << 13 | 1 << 3 | 1 << 2 | enable, Time(0)).unwrap();
            // RM0090, table 61.
            assert_eq!(usart.active(), if active { vec![38] } else { vec![] }, "{enable:x}");
        }
        usart.write(CR1, 1 << 13 | 1 << 3 | 1 << 2 | 1 << 5, Time(0)).unwrap();
        usart.receive(b"x", Time(200 * MICRO));
        usart.advance(Time(400 * MICRO));
        assert_eq!(usart.active(), [38]);
        assert_eq!(usart.read(DR, Time(400 * MICRO)), Ok(b'x'.into()));
        assert!(usart.active().is_empty());
    }

    /// Section 30.3.3, overrun: the data register keeps its character, the new character is lost,
    /// and a read of SR and then of DR clears ORE.
    #[test]
    fn a_character_that_nobody_took_stays_and_the_next_is_lost() {
        let mut usart = on(1 << 5);
        assert_eq!(usart.receive(b"abc", Time(100 * MICRO)), 3);
        let late = Time(1000 * MICRO);
        usart.advance(late);
        assert_eq!(usart.waiting(), 0);
        assert_eq!(usart.read(DR, late), Ok(b'a'.into()));
        assert_eq!(usart.active(), [38], "ORE interrupts as RXNE does");
        assert_eq!(usart.read(SR, late).unwrap() & 0x28, 0x08);
        assert_eq!(usart.read(DR, late), Ok(b'a'.into()));
        assert_eq!(usart.read(SR, late), Ok(0xC0));
        usart.receive(b"d", late);
        usart.advance(Time(2000 * MICRO));
        assert_eq!(usart.read(DR, late), Ok(b'd'.into()));
    }

    #[test]
    fn another_bit_rate_is_no_text() {
        for (rate, readable) in
            [(115_200, true), (111_111, true), (119_000, true), (125_000, false), (9_600, false)]
        {
            let mut usart = on(0);
            usart.set_outside_bit_rate(rate);
            usart.receive(b"U", Time(0));
            usart.advance(Time(2000 * MICRO));
            assert_eq!(usart.read(SR, Time(0)).unwrap() & 2 == 0, readable, "{rate}");
            assert_eq!(usart.read(DR, Time(0)) == Ok(b'U'.into()), readable, "{rate}");
            assert_eq!(usart.read(SR, Time(0)).unwrap() & 2, 0, "{rate}");
        }
    }

    #[test]
    fn nothing_comes_or_goes_without_pins_or_switches() {
        let mut usart = on(0);
        usart.set_wired(false, false);
        usart.receive(b"a", Time(100 * MICRO));
        assert!(usart.write(DR, b'b'.into(), Time(100 * MICRO)).unwrap_err().0.contains("PA2, PD5"));
        usart.advance(Time(1000 * MICRO));
        assert!(text(&mut usart).is_empty());
        assert_eq!(usart.read(SR, Time(1000 * MICRO)).unwrap() & 0x20, 0);
        usart.set_wired(true, true);
        usart.write(CR1, 0, Time(1000 * MICRO)).unwrap();
        usart.receive(b"a", Time(1000 * MICRO));
        assert!(usart.write(DR, b'b'.into(), Time(1000 * MICRO)).is_err());
        usart.advance(Time(2000 * MICRO));
        assert!(text(&mut usart).is_empty());
        assert_eq!(usart.read(SR, Time(2000 * MICRO)), Ok(0xC0));
    }

    #[test]
    fn what_is_not_modelled_is_said() {
        for (offset, value) in [
            (CR1, 1 << 13 | 1),
            (CR1, 1 << 10),
            (CR1, 1 << 12),
            (CR1, 1 << 4),
            (0x10, 1 << 14),
            (0x14, 1 << 7),
            (0x14, 1 << 3),
        ] {
            assert!(on(0).write(offset, value, Time(200 * MICRO)).is_err(), "{offset:x} {value:x}");
        }
    }

    /// Characters from outside go on over the line while the chip resets; without power nothing is
    /// sent.
    #[test]
    fn the_outside_knows_of_no_reset() {
        let mut usart = on(0);
        usart.receive(b"ab", Time(100 * MICRO));
        usart.reset();
        assert_eq!(usart.waiting(), 2);
        usart.advance(Time(1000 * MICRO));
        assert_eq!(usart.waiting(), 0);
        assert_eq!(usart.read(SR, Time(1000 * MICRO)), Ok(0xC0));
        usart.receive(b"ab", Time(1000 * MICRO));
        usart.lose_power();
        assert_eq!((usart.waiting(), usart.next_event()), (0, None));
    }
}
