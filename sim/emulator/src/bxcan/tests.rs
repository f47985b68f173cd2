//! Register behaviour of the controller, driven register by register as RM0090 section 32 requires
//! of a driver, with the bus played by hand. Offsets and bits are the manual's numbers.

use super::*;
use crate::frame::{Id, StandardId};

const MCR: u32 = 0x00;
const MSR: u32 = 0x04;
const TSR: u32 = 0x08;
const RF0R: u32 = 0x0C;
const RF1R: u32 = 0x10;
const IER: u32 = 0x14;
const ESR: u32 = 0x18;
const BTR: u32 = 0x1C;
const TI0R: u32 = 0x180;
const RI0R: u32 = 0x1B0;
const RI1R: u32 = 0x1C0;
const FMR: u32 = 0x200;
const FS1R: u32 = 0x20C;
const FFA1R: u32 = 0x214;
const FA1R: u32 = 0x21C;

impl BxCan {
    /// Set up for 1 Mbit/s by a clock of 42 MHz, all frames into FIFO 0, with these bits of MCR and BTR.
    pub(crate) fn set_up(&mut self, mcr: u32, btr: u32) {
        self.set_clock(42_000_000);
        for (offset, value) in [
            (0x00, 0x1_0001),
            (0x1C, 0x001A_0002 | btr), // 3 x 14 cycles of 42 MHz
            (0x20C, 1),
            (0x21C, 1),
            (0x200, 0x2A1C_0E00),
            (0x00, 0x1_0000 | mcr),
        ] {
            self.write(offset, value, Time(0)).unwrap();
        }
    }
}

struct Bench {
    can: BxCan,
    now: Time,
}

impl Bench {
    /// A controller on a bus, 42 MHz, still asleep.
    fn new() -> Self {
        let mut can = BxCan::new();
        can.set_clock(42_000_000);
        can.resolved(Time(0));
        Self { can, now: Time(0) }
    }

    /// In normal mode at 125 kbit/s, all frames into FIFO 0.
    fn running(mcr: u32) -> Self {
        let mut bench = Self::new();
        bench.write(MCR, 0x1_0001); // INRQ
        bench.write(BTR, 0x001C_0014); // BRP 21, TS1 13, TS2 2
        bench.write(FS1R, 1);
        bench.write(FA1R, 1);
        bench.write(FMR, 0x2A1C_0E00);
        bench.write(MCR, mcr);
        bench.event(BusEvent::Recessive { sequences: 1 });
        assert_eq!(bench.read(MSR) & 3, 0, "neither INAK nor SLAK");
        bench
    }

    fn read(&mut self, offset: u32) -> u32 {
        self.can.read(offset, self.now).unwrap()
    }

    fn write(&mut self, offset: u32, value: u32) {
        self.can.write(offset, value, self.now).unwrap();
    }

    fn event(&mut self, event: BusEvent) {
        self.can.event(event, self.now);
    }

    fn receive(&mut self, id: u16) {
        self.event(BusEvent::Received(Frame::standard(id, &[id as u8]).unwrap()));
    }

    /// Requests the transmission of a standard frame without data.
    fn transmit(&mut self, mailbox: u32, id: u32) {
        self.now.0 += 1;
        self.write(TI0R + 0x10 * mailbox + 4, 0);
        self.write(TI0R + 0x10 * mailbox, id << 21 | 1);
    }

    /// The frame at the head of the queue goes onto the wire; its identifier.
    fn start(&mut self) -> u32 {
        let id = self.can.request(self.now).unwrap().raw_id();
        self.event(BusEvent::Started { own: true });
        id
    }
}

/// In sleep the registers stand still: an abort does not end, and a last error code is not taken.
#[test]
fn what_a_deep_sleeper_is_told_is_lost() {
    let mut bench = Bench::new();
    bench.can = bench.can.on(silicon::WORST);
    bench.write(TSR, 1 << 7);
    bench.write(ESR, 7 << 4);
    assert_eq!((bench.read(TSR) & 1 << 7, bench.read(ESR) & 7 << 4), (1 << 7, 0));
    bench.write(MCR, 0x1_0001);
    bench.write(ESR, 7 << 4);
    assert_eq!((bench.read(TSR) & 1 << 7, bench.read(ESR) & 7 << 4), (0, 7 << 4));
}

/// Before INAK is cleared a request for transmission is kept, or lost and reported.
#[test]
fn a_request_before_the_controller_takes_part_is_lost_with_some_chips() {
    for (silicon, is_lost) in [(silicon::TYPICAL, false), (silicon::WORST, true)] {
        let mut bench = Bench::new();
        bench.can = bench.can.on(silicon);
        bench.write(MCR, 0x1_0001);
        let result = bench.can.write(0x180, 0x123 << 21 | 1, bench.now);
        assert_eq!((result.is_err(), bench.read(TSR) & 1 << 26 != 0), (is_lost, is_lost), "TME0");
    }
}

/// A controller that sticks leaves an idle bus, and a busy one by a master reset alone.
#[test]
fn a_controller_that_sticks_leaves_a_busy_bus_by_a_master_reset() {
    for is_busy in [false, true] {
        let mut bench = Bench::running(0x1_0000);
        bench.can = bench.can.on(silicon::WORST);
        if is_busy {
            bench.event(BusEvent::Started { own: false });
        }
        bench.write(MCR, 0x1_0001);
        // 30 µs after the request at the earliest.
        assert_eq!(bench.can.leaving(), (!is_busy).then_some(bench.now + Span::from_micros(30)));
        bench.write(MCR, 1 << 15);
        assert_eq!(bench.read(MSR) & 3, 2, "asleep");
        bench.write(MCR, 0x1_0001);
        assert_eq!(bench.read(MSR) & 3, 1, "in initialisation");
    }
}

#[test]
fn reset_values() {
    let mut bench = Bench::new();
    let expected = [
        (MCR, 0x0001_0002),
        (MSR, 0x0000_0C02),
        (TSR, 0x1C00_0000),
        (RF0R, 0),
        (RF1R, 0),
        (IER, 0),
        (ESR, 0),
        (BTR, 0x0123_0000),
        (FMR, 0x2A1C_0E01),
    ];
    for (offset, value) in expected {
        assert_eq!(bench.read(offset), value, "offset {offset:#x}");
    }
    bench.write(MCR, 0x1_0001);
    bench.write(BTR, 0xC000_0000);
    bench.write(IER, 0x7F);
    bench.can.reset();
    for (offset, value) in expected {
        assert_eq!(bench.read(offset), value, "offset {offset:#x} after a reset");
    }
}

#[test]
fn modes() {
    let mut bench = Bench::new();
    // Sleep to initialisation: no bus in it.
    bench.write(MCR, 0x1_0001);
    assert_eq!(bench.read(MSR) & 3, 1, "INAK");
    // To normal: 11 recessive bits first.
    bench.write(MCR, 0x1_0000);
    assert_eq!(bench.read(MSR) & 3, 1, "INAK stays");
    assert!(bench.can.wants_attention());
    assert_eq!(bench.can.line(), None);
    assert_eq!(bench.can.wait().unwrap().sequences, 1);
    bench.event(BusEvent::Recessive { sequences: 1 });
    assert_eq!(bench.read(MSR) & 3, 0);
    assert!(bench.can.line().is_some());
    // Back to initialisation: only when the bus says that nothing is under way.
    bench.write(MCR, 0x1_0001);
    assert_eq!(bench.read(MSR) & 3, 0);
    assert_eq!(bench.can.leaving(), Some(bench.now));
    bench.event(BusEvent::Released);
    assert_eq!(bench.read(MSR) & 3, 1);
    assert_eq!(bench.can.leaving(), None);
    // To sleep, with the interrupt of SLAKI.
    bench.write(IER, 1 << 17);
    bench.write(MCR, 0x1_0002);
    assert_eq!(bench.read(MSR) & 0x1F, 0x12, "SLAK and SLAKI");
    assert_eq!(bench.can.active(), [22]);
    bench.write(MSR, 0x10);
    assert!(bench.can.active().is_empty());
}

#[test]
fn wakes_up_by_a_frame() {
    for (awum, slak_waits) in [(0, false), (0x20, true)] {
        let mut bench = Bench::running(0x1_0000 | awum);
        bench.write(MCR, 0x1_0002 | awum);
        bench.event(BusEvent::Released);
        bench.write(IER, 1 << 16);
        bench.event(BusEvent::Started { own: false });
        assert_eq!(bench.read(MSR) & 8, 8, "WKUI");
        assert_eq!(bench.can.active(), [22]);
        assert_eq!(bench.read(MCR) & 2 == 0, slak_waits, "AWUM clears SLEEP");
        assert_eq!(bench.can.wait().is_some(), slak_waits);
    }
}

#[test]
fn bit_timing() {
    let mut bench = Bench::new();
    bench.write(MCR, 0x1_0001);
    // RM0090, 32.7.7: bit = (1 + (TS1 + 1) + (TS2 + 1)) quanta of (BRP + 1) clocks.
    for (btr, rate, sample) in [
        (0x001C_0014, 125_000, 875),   // 21 x (1 + 13 + 2)
        (0x001A_0002, 1_000_000, 857), // 3 x (1 + 11 + 2)
        (0x001C_0029, 62_500, 875),    // 42 x (1 + 13 + 2)
        (0x0123_0000, 5_250_000, 625), // as after reset: 1 x (1 + 4 + 3)
    ] {
        bench.write(BTR, btr);
        assert_eq!((bench.can.bit_rate(), bench.can.sample_point_permille()), (rate, sample), "{btr:#x}");
    }
    bench.write(BTR, 0x001C_0014);
    assert_eq!(bench.can.bit_time(), Some(Span(8_000_000)), "8 us to the picosecond");
    bench.can.set_clock(21_000_000);
    assert_eq!(bench.can.bit_rate(), 62_500);
    bench.can.set_clock(0);
    assert_eq!((bench.can.bit_rate(), bench.can.bit_time()), (0, None));
}

#[test]
fn bit_timing_is_locked_outside_initialisation() {
    let mut bench = Bench::running(0x1_0000);
    assert!(bench.can.write(BTR, 0, bench.now).is_err());
    assert_eq!(bench.read(BTR), 0x001C_0014);
}

#[test]
fn a_transmission_from_request_to_interrupt() {
    let mut bench = Bench::running(0x1_0000);
    bench.write(IER, 1);
    bench.can.resolved(bench.now);
    bench.write(TI0R + 4, 8);
    bench.write(TI0R + 8, 0x1000_0040);
    bench.write(TI0R + 12, 0x0403_0201);
    assert!(!bench.can.wants_attention());
    bench.write(TI0R, 0x601 << 21 | 1);
    assert!(bench.can.wants_attention());
    assert_eq!(bench.read(TSR), 0x1900_0000, "mailbox 0 is taken, 1 is the next free one");
    assert_eq!(bench.read(TI0R), 0x601 << 21 | 1);
    assert!(bench.can.write(TI0R + 8, 0, bench.now).is_err(), "protected while pending");
    let frame = bench.can.request(bench.now).unwrap();
    assert_eq!(frame.to_string(), "601#4000001001020304");
    bench.can.resolved(bench.now);
    assert!(!bench.can.wants_attention());
    bench.event(BusEvent::Started { own: true });
    assert_eq!(bench.read(MSR) & 0x300, 0x100, "TXM");
    assert_eq!(bench.can.request(bench.now), None, "it is on the wire");
    bench.event(BusEvent::Transmitted);
    bench.event(BusEvent::Ended);
    assert_eq!(bench.read(MSR) & 0x300, 0);
    assert_eq!(bench.read(TSR), 0x1C00_0003, "RQCP0, TXOK0, all empty");
    assert_eq!(bench.can.active(), [19]);
    bench.write(TSR, 1);
    assert_eq!(bench.read(TSR), 0x1C00_0000);
    assert!(bench.can.active().is_empty());
}

#[test]
fn extended_and_remote_frames_and_a_long_dlc() {
    let mut bench = Bench::running(0x1_0000);
    bench.write(TI0R + 4, 0xF);
    bench.write(TI0R + 8, 0x4433_2211);
    bench.write(TI0R + 12, 0x8877_6655);
    bench.write(TI0R, 0x1234_5678 << 3 | 4 | 1);
    let frame = bench.can.request(bench.now).unwrap();
    assert_eq!(frame.to_string(), "12345678#1122334455667788_F", "DLC 15 is sent, with eight bytes");
    bench.write(TI0R + 0x10 + 4, 2);
    bench.write(TI0R + 0x10, 0x701 << 21 | 2 | 1);
    // 12345678h begins with the 11 bits 48Dh: it is stronger than 701h.
    assert_eq!(bench.start(), 0x1234_5678);
    bench.event(BusEvent::Transmitted);
    assert_eq!(bench.can.request(bench.now).unwrap().to_string(), "701#R2");
}

#[test]
fn priority_by_identifier_or_by_request() {
    for (txfp, order) in [(0, [0x080, 0x181, 0x701]), (4, [0x701, 0x080, 0x181])] {
        let mut bench = Bench::running(0x1_0000 | txfp);
        bench.transmit(0, 0x701);
        assert_eq!(bench.read(TSR) >> 24, 0x19, "one pending: LOW is 0, CODE 1");
        bench.transmit(2, 0x080);
        bench.transmit(1, 0x181);
        let lowest: u32 = if txfp == 0 { 0 } else { 1 };
        assert_eq!(bench.read(TSR) >> 29, 1 << lowest, "LOW");
        assert_eq!(bench.read(TSR) >> 24 & 3, lowest, "CODE is the last one with none free");
        for id in order {
            assert_eq!(bench.start(), id);
            bench.event(BusEvent::Transmitted);
        }
        assert_eq!(bench.read(TSR), 0x1C03_0303, "all three");
    }
    // Equal identifiers: the lower mailbox.
    let mut bench = Bench::running(0x1_0000);
    bench.transmit(2, 0x100);
    bench.transmit(1, 0x100);
    bench.event(BusEvent::Started { own: true });
    bench.event(BusEvent::Transmitted);
    assert_eq!(bench.read(TSR) & 0x00FF_FFFF, 0x0300);
}

#[test]
fn failures_are_repeated_unless_nart() {
    for nart in [0, 0x10] {
        let mut bench = Bench::running(0x1_0000 | nart);
        bench.transmit(0, 0x181);
        bench.start();
        bench.event(BusEvent::ArbitrationLost);
        let over = u32::from(nart != 0);
        assert_eq!(bench.read(TSR) & 0xFF, 4 | over, "ALST, RQCP with NART");
        assert_eq!(bench.can.request(bench.now).is_some(), nart == 0);
        if nart == 0 {
            bench.start();
            bench.event(BusEvent::TransmitFailed { kind: ErrorKind::Acknowledge, exempt: false });
            assert_eq!(bench.read(TSR) & 0xFF, 8, "TERR");
            assert_eq!(bench.read(ESR), 8 << 16 | 3 << 4, "TEC 8, acknowledgment error");
            bench.start();
            bench.event(BusEvent::Transmitted);
            assert_eq!(bench.read(TSR) & 0xFF, 3);
            assert_eq!(bench.read(ESR), 7 << 16);
        }
    }
}

#[test]
fn abort() {
    let mut bench = Bench::running(0x1_0000);
    bench.transmit(0, 0x100);
    bench.write(TSR, 0x80);
    assert_eq!(bench.read(TSR), 0x1C00_0001, "empty at once, RQCP without TXOK");
    // On the wire: the outcome decides.
    bench.transmit(1, 0x100);
    bench.start();
    bench.write(TSR, 0x8000);
    assert_eq!(bench.read(TSR) & 0x8000, 0x8000, "ABRQ1 waits");
    bench.event(BusEvent::Transmitted);
    assert_eq!(bench.read(TSR) & 0xFF00, 0x0300);
    bench.transmit(1, 0x100);
    bench.start();
    bench.write(TSR, 0x8000);
    bench.event(BusEvent::TransmitFailed { kind: ErrorKind::BitRecessive, exempt: false });
    assert_eq!(bench.read(TSR) & 0xFF00, 0x0900, "RQCP1 and TERR1, not repeated");
    assert_eq!(bench.can.request(bench.now), None);
}

#[test]
fn fifo_fills_and_overruns_both_ways() {
    // RFLM = 0: the last frame is overwritten. RFLM = 1: the new one is lost.
    for (rflm, kept) in [(0, [1, 2, 5]), (8, [1, 2, 3])] {
        let mut bench = Bench::running(0x1_0000 | rflm);
        bench.receive(1);
        assert_eq!(bench.read(RF0R), 1);
        bench.receive(2);
        bench.receive(3);
        assert_eq!(bench.read(RF0R), 3 | 8, "FULL0");
        bench.receive(4);
        bench.receive(5);
        assert_eq!(bench.read(RF0R), 3 | 8 | 16, "FOVR0");
        for (n, id) in kept.into_iter().enumerate() {
            assert_eq!(bench.read(RI0R), id << 21);
            assert_eq!(bench.read(RI0R + 4), 1, "DLC 1, filter 0");
            assert_eq!(bench.read(RI0R + 8) & 0xFF, id);
            bench.write(RF0R, 0x20);
            assert_eq!(bench.read(RF0R) & 3, 2 - n as u32);
        }
        assert_eq!(bench.read(RF0R), 8 | 16, "both stay until they are cleared");
        bench.write(RF0R, 8);
        assert_eq!(bench.read(RF0R), 16);
        bench.write(RF0R, 16 | 0x20);
        assert_eq!(bench.read(RF0R), 0, "a release of the empty FIFO does nothing");
    }
}

#[test]
fn receive_registers() {
    let mut bench = Bench::running(0x1_0000);
    bench.event(BusEvent::Received(Frame::extended(0x1ABC_DEF0, &[1, 2, 3, 4, 5, 6]).unwrap()));
    assert_eq!(bench.read(RI0R), 0x1ABC_DEF0 << 3 | 4);
    assert_eq!(bench.read(RI0R + 4), 6);
    assert_eq!((bench.read(RI0R + 8), bench.read(RI0R + 12) & 0xFFFF), (0x0403_0201, 0x0605));
    bench.write(RF0R, 0x20);
    let id = Id::Standard(StandardId::new(0x7FF).unwrap());
    bench.event(BusEvent::Received(Frame::remote_frame(id, 3).unwrap()));
    assert_eq!((bench.read(RI0R), bench.read(RI0R + 4)), (0x7FF << 21 | 2, 3));
    assert_eq!(bench.read(RI0R + 8), 0x0403_0201, "a frame without data leaves what was there");
    for dlc in 8_u8..=15 {
        bench.write(RF0R, 0x20);
        let frame = Frame::standard(0x601, &[8, 7, 6, 5, 4, 3, 2, 1]).unwrap().with_dlc(dlc).unwrap();
        bench.event(BusEvent::Received(frame));
        assert_eq!(bench.read(RI0R + 4), u32::from(dlc), "RDTR has the DLC of the wire");
        assert_eq!((bench.read(RI0R + 8), bench.read(RI0R + 12)), (0x0506_0708, 0x0102_0304));
    }
}

#[test]
fn second_fifo_and_its_interrupts() {
    let mut bench = Bench::running(0x1_0000);
    bench.write(FMR, 0x2A1C_0E01);
    bench.write(FFA1R, 1);
    bench.write(FMR, 0x2A1C_0E00);
    bench.receive(0x55);
    assert_eq!((bench.read(RF0R), bench.read(RF1R), bench.read(RI1R)), (0, 1, 0x55 << 21));
    for (ier, frames, lines) in [
        (1 << 1, 1, &[][..]),
        (1 << 4, 1, &[21]),
        (1 << 5, 1, &[]),
        (1 << 5, 3, &[21]),
        (1 << 6, 3, &[]),
        (1 << 6, 4, &[21]),
    ] {
        bench.write(RF1R, 0x18);
        while bench.read(RF1R) & 3 > 0 {
            bench.write(RF1R, 0x20);
        }
        (0..frames).for_each(|n| bench.receive(n));
        bench.write(IER, ier);
        assert_eq!(bench.can.active(), lines, "IER {ier:#x}, {frames} frames");
    }
}

#[test]
fn interrupt_of_fifo_0_is_a_level() {
    let mut bench = Bench::running(0x1_0000);
    bench.write(IER, 1 << 1);
    bench.receive(1);
    bench.receive(2);
    assert_eq!(bench.can.active(), [20]);
    bench.write(RF0R, 0x20);
    assert_eq!(bench.can.active(), [20]);
    bench.write(RF0R, 0x20);
    assert!(bench.can.active().is_empty());
}

#[test]
fn error_flags_and_their_interrupt() {
    let mut bench = Bench::running(0x1_0000);
    bench.write(IER, 1 << 15 | 1 << 8 | 1 << 9 | 1 << 10);
    let fail = |bench: &mut Bench| {
        bench.event(BusEvent::TransmitFailed { kind: ErrorKind::BitDominant, exempt: false });
    };
    (0..11).for_each(|_| fail(&mut bench));
    assert_eq!(bench.read(ESR), 88 << 16 | 5 << 4);
    assert!(bench.can.active().is_empty());
    for (times, tec, flags) in [(1, 96, 1), (4, 128, 3), (16, 255, 7)] {
        (0..times).for_each(|_| fail(&mut bench));
        assert_eq!(bench.read(ESR), tec << 16 | 5 << 4 | flags);
        assert_eq!(bench.read(MSR) & 4, 4, "ERRI");
        assert_eq!(bench.can.active(), [22]);
        bench.write(MSR, 4);
        assert!(bench.can.active().is_empty());
    }
    // LEC: any error, if enabled; the software may write it.
    let mut bench = Bench::running(0x1_0000);
    bench.write(IER, 1 << 15 | 1 << 11);
    bench.write(ESR, 0x70);
    assert_eq!(bench.read(ESR), 0x70);
    bench.event(BusEvent::ReceiveFailed { kind: ErrorKind::Crc, first: true });
    assert_eq!(bench.read(ESR), 9 << 24 | 6 << 4);
    assert_eq!(bench.can.active(), [22]);
    bench.receive(1);
    assert_eq!(bench.read(ESR), 8 << 24, "a good frame clears LEC and counts down");
}

#[test]
fn bus_off_and_the_two_ways_back() {
    for abom in [0, 0x40] {
        let mut bench = Bench::running(0x1_0000 | abom);
        for _ in 0..32 {
            bench.event(BusEvent::TransmitFailed { kind: ErrorKind::BitRecessive, exempt: false });
        }
        assert_eq!(bench.read(ESR) & 7, 7);
        assert_eq!(bench.can.line(), None);
        if abom == 0 {
            assert_eq!(bench.can.wait(), None, "the software has to ask for it");
            bench.write(MCR, 0x1_0001);
            bench.event(BusEvent::Released);
            assert_eq!(bench.read(ESR) & 4, 4, "initialisation mode alone does not end it");
            bench.write(MCR, 0x1_0000);
            bench.event(BusEvent::Recessive { sequences: 1 });
            assert_eq!(bench.read(MSR) & 1, 0);
            assert_eq!(bench.can.wait().unwrap().sequences, 127);
        } else {
            assert_eq!(bench.can.wait().unwrap().sequences, 128);
            bench.event(BusEvent::Recessive { sequences: 1 });
        }
        bench.event(BusEvent::Recessive { sequences: 126 });
        assert_eq!(bench.read(ESR) & 4, 4);
        bench.event(BusEvent::Recessive { sequences: 1 });
        assert_eq!(bench.read(ESR) & 0xFFFF_0007, 0, "counters are 0, error active");
        assert!(bench.can.line().is_some());
    }
}

#[test]
fn master_reset_keeps_the_configuration() {
    let mut bench = Bench::running(0x1_0000);
    let epoch = bench.can.epoch();
    bench.receive(1);
    bench.transmit(0, 5);
    bench.write(MCR, 0x8000);
    assert_eq!(bench.read(MCR), 0x1_0002);
    assert_eq!(bench.read(MSR) & 3, 2, "asleep");
    assert_eq!((bench.read(RF0R), bench.read(TSR)), (0, 0x1C00_0000));
    assert_eq!(bench.read(BTR), 0x001C_0014);
    assert_eq!(bench.read(FA1R), 1);
    assert_ne!(bench.can.epoch(), epoch);
}

#[test]
fn without_a_bus_it_still_comes_out_of_initialisation() {
    let mut can = BxCan::new();
    can.set_clock(42_000_000);
    let start = Time(1_000_000);
    can.write(MCR, 0x1_0001, start).unwrap();
    can.write(BTR, 0x001C_0014, start).unwrap();
    can.write(MCR, 0x1_0000, start).unwrap();
    assert!(!can.wants_attention());
    // 11 bits of 8 us.
    let due = Time(1_000_000 + 88_000_000);
    assert_eq!(can.next_event(), Some(due));
    assert_eq!(can.read(MSR, Time(due.0 - 1)).unwrap() & 1, 1);
    assert_eq!(can.read(MSR, due).unwrap() & 1, 0);
    assert_eq!(can.next_event(), None);
    can.write(MCR, 0x1_0001, due).unwrap();
    assert_eq!(can.read(MSR, due).unwrap() & 1, 1);
}

/// RM0090 section 32.5.2: in loop-back mode the controller disregards CANRX and acknowledges itself, so it
/// needs neither a pin nor a transceiver.
#[test]
fn in_loop_back_mode_it_needs_neither_a_bus_nor_pins() {
    let mut can = BxCan::new();
    can.connect(Pins::NONE, Time(0));
    // LBKM.
    can.set_up(0, 1 << 30);
    // Both before it is synchronised.
    can.write(0x180, 0x080 << 21 | 1, Time(0)).unwrap();
    can.write(0x190, 0x080 << 21 | 1, Time(0)).unwrap();
    let us = |n: u64| Time(n * 1_000_000);
    let mut ends = Vec::new();
    while let Some(next) = can.next_event() {
        assert!(next <= us(200), "{next}");
        can.advance(next);
        ends.push(next);
    }
    // 11 bits, then 48 bits and the intermission of three, twice: 1 µs each.
    assert_eq!(ends, [us(11), us(11 + 51), us(11 + 51 + 51)]);
    assert_eq!(can.read(MSR, us(200)).unwrap() & 3, 0);
    assert_eq!(can.read(TSR, us(200)).unwrap() & 0x0303, 0x0303, "RQCP and TXOK");
    assert_eq!(can.read(RF0R, us(200)).unwrap() & 3, 2);
    assert_eq!(can.read(0x1B0, us(200)).unwrap() >> 21, 0x080);
}

/// RM0090 section 32.7.2 and 32.9.4: TIME is the counter of bit times at the start of the frame, of 16 bits.
#[test]
fn a_frame_has_the_time_stamp_of_its_start_in_time_triggered_mode() {
    for (mcr, stamp) in [(0x1_0000, 0), (0x1_0080, 0x0005)] {
        let mut bench = Bench::running(mcr);
        assert_eq!(bench.read(MCR) & 0x80, mcr & 0x80);
        // 8 µs each.
        bench.now = Time(0x1_0005 * 8_000_000);
        bench.event(BusEvent::Started { own: false });
        bench.now = Time(0x1_0040 * 8_000_000);
        bench.receive(0x123);
        assert_eq!(bench.read(RI0R + 4) >> 16, stamp);
    }
}

#[test]
fn who_sends_without_a_pin_is_told() {
    for (pins, words) in [
        (Pins { rx: true, tx: false }, "has its TX"),
        (Pins { rx: false, tx: true }, "has its RX"),
        (Pins::NONE, "has its RX and TX"),
    ] {
        let mut bench = Bench::running(0x1_0000);
        bench.can.connect(pins, bench.now);
        let Unmodelled(what) = bench.can.write(0x180, 0x080 << 21 | 1, bench.now).unwrap_err();
        assert!(what.contains(words) && what.contains("alternate function"), "{what}");
        assert!(bench.can.request(bench.now).is_some(), "it is sent all the same");
    }
}

#[test]
fn what_is_not_there_says_so() {
    let mut bench = Bench::running(0x1_0000);
    for (offset, value, words) in [
        (0x20, 0, "no register"),
        (0x17C, 0, "no register"),
        (0x1D0, 0, "no register"),
        (0x3FC, 0, "no filter register"),
        (RI0R, 0, "read-only"),
        (MCR, 0x1_0100, "reserved"),
        (TI0R + 4, 0x108, "global time"),
    ] {
        let error = bench.can.write(offset, value, bench.now).unwrap_err();
        assert!(error.0.contains(words), "{offset:#x}: {error:?}");
    }
    for offset in [0x20, 0x17C, 0x1D0, 0x208, 0x3FC] {
        assert!(bench.can.read(offset, bench.now).is_err(), "{offset:#x}");
    }
}

// --- CAN2
// -----------------------------------------------------------------------------------------------------------

/// CAN2 in normal mode, CAN1 with these filters.
fn running_slave(filters: &[(u32, u32)]) -> (Bench, BxCan) {
    let mut master = Bench::new();
    for &(offset, value) in filters {
        master.write(offset, value);
    }
    let mut can = BxCan::slave();
    can.set_clock(42_000_000);
    can.resolved(Time(0));
    can.follow(&master.can, true);
    let mut bench = Bench { can, now: Time(0) };
    bench.write(MCR, 0x1_0001);
    bench.write(BTR, 0x001C_0014);
    bench.write(MCR, 0x1_0000);
    bench.event(BusEvent::Recessive { sequences: 1 });
    assert_eq!(bench.read(MSR) & 3, 0, "neither INAK nor SLAK");
    (bench, master.can)
}

/// Bank 14, CAN2's first after a reset: lets everything through, into FIFO 0.
const EVERYTHING_FOR_CAN2: [(u32, u32); 3] = [(FS1R, 1 << 14), (FA1R, 1 << 14), (FMR, 0x0E00)];

#[test]
fn can2_receives_by_its_share_of_the_filters_and_has_none_of_its_own() {
    let (mut bench, _) = running_slave(&EVERYTHING_FOR_CAN2);
    bench.receive(0x601);
    assert_eq!(bench.read(RF0R) & 3, 1);
    assert_eq!(bench.read(RI0R), 0x601 << 21);
    let (mut bench, _) = running_slave(&[(FS1R, 1), (FA1R, 1), (FMR, 0x0E00)]);
    bench.receive(0x601);
    assert_eq!(bench.read(RF0R) & 3, 0, "bank 0 is CAN1's");
    for offset in [FMR, FS1R, FA1R, 0x240, 0x31C] {
        let error = bench.can.write(offset, 0, bench.now).unwrap_err();
        assert!(error.0.contains("CAN2 has no filter registers"), "{offset:#x}: {error:?}");
        assert!(bench.can.read(offset, bench.now).is_err(), "{offset:#x}");
    }
}

/// RM0090, table 61: CAN2_TX 63, CAN2_RX0 64, CAN2_RX1 65, CAN2_SCE 66.
#[test]
fn can2_has_interrupts_of_its_own() {
    let (mut bench, _) = running_slave(&EVERYTHING_FOR_CAN2);
    bench.write(IER, 1 << 1 | 1); // FMPIE0, TMEIE
    bench.receive(1);
    assert_eq!(bench.can.active(), [64]);
    bench.write(RF0R, 0x20);
    bench.transmit(0, 0x581);
    bench.start();
    bench.event(BusEvent::Transmitted);
    assert_eq!(bench.can.active(), [63]);
    let fifo_1 = [(FS1R, 1 << 14), (FFA1R, 1 << 14), (FA1R, 1 << 14), (FMR, 0x0E00)];
    let (mut bench, _) = running_slave(&fifo_1);
    bench.write(IER, 1 << 4 | 1 << 15 | 1 << 11); // FMPIE1, ERRIE, LECIE
    bench.receive(1);
    assert_eq!(bench.can.active(), [65]);
    bench.event(BusEvent::ReceiveFailed { kind: ErrorKind::Crc, first: true });
    assert_eq!(bench.can.active(), [65, 66]);
}

/// CAN1 "manages the communication between a Slave bxCAN and the 512-byte SRAM memory" (RM0090,
/// 32.3.3): mailboxes, FIFOs and filters.
#[test]
fn can2_reaches_its_memory_only_while_can1_has_a_clock() {
    let (mut bench, master) = running_slave(&EVERYTHING_FOR_CAN2);
    bench.can.follow(&master, false);
    bench.receive(0x601);
    assert_eq!(bench.read(RF0R) & 3, 0, "nowhere to put it");
    for offset in [TI0R, TI0R + 4, RI0R] {
        let error = bench.can.write(offset, 0, bench.now).unwrap_err();
        assert!(error.0.contains("CAN1 has no clock"), "{offset:#x}: {error:?}");
    }
    bench.can.follow(&master, true);
    bench.receive(0x601);
    assert_eq!(bench.read(RF0R) & 3, 1);
}

#[test]
fn a_reset_of_can2_leaves_the_filters_alone() {
    let (mut bench, master) = running_slave(&EVERYTHING_FOR_CAN2);
    bench.can.reset();
    assert_eq!(bench.can.name(), "CAN2");
    assert!(bench.can.filters.accept(Share::Can2, &Frame::standard(1, &[]).unwrap()).is_some());
    let mut master = master;
    master.reset();
    bench.can.follow(&master, true);
    assert!(bench.can.filters.accept(Share::Can2, &Frame::standard(1, &[]).unwrap()).is_none());
}

/// The order of ST's HAL: INRQ while SLEEP is still set, INAK is waited for, then SLEEP is cleared. The
/// same to stop it.
#[test]
fn initialisation_is_entered_out_of_sleep() {
    let mut bench = Bench::new();
    bench.write(MCR, 0x1_0003);
    assert_eq!(bench.read(MSR) & 3, 1, "INAK, and no SLAK");
    bench.write(BTR, 0x001C_0014);
    assert_eq!(bench.read(BTR), 0x001C_0014, "the bit timing can be written");
    bench.write(MCR, 0x1_0001);
    assert_eq!(bench.read(MSR) & 3, 1);
    bench.write(MCR, 0x1_0000);
    bench.event(BusEvent::Recessive { sequences: 1 });
    assert_eq!(bench.read(MSR) & 3, 0, "it has joined the bus");
    bench.write(MCR, 0x1_0003);
    bench.event(BusEvent::Released);
    assert_eq!(bench.read(MSR) & 3, 1, "and stops");
    bench.write(MCR, 0x1_0002);
    assert_eq!(bench.read(MSR) & 3, 2, "without INRQ it sleeps");
}
