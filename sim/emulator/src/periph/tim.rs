//! The general-purpose and basic timers TIM2 to TIM7 and TIM9 to TIM14 (RM0090 sections 18 to 20),
//! with the functions that measure time: a counter with prescaler, auto-reload, update event,
//! one-pulse mode and output compare.
//!
//! The counter is computed from the elapsed time, so a running timer costs nothing.
//!
//! **What is missing.** The pins (PWM, input capture, encoders), counting down, triggers between
//! timers and DMA requests. Each is reported when a program sets it up.

use crate::clock::{picos_of, ticks_in};
use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::time::Time;

const CR1: u32 = 0x00;
const CR2: u32 = 0x04;
const SMCR: u32 = 0x08;
const DIER: u32 = 0x0C;
const SR: u32 = 0x10;
const EGR: u32 = 0x14;
const CCMR1: u32 = 0x18;
const CCMR2: u32 = 0x1C;
const CCER: u32 = 0x20;
const CNT: u32 = 0x24;
const PSC: u32 = 0x28;
const ARR: u32 = 0x2C;
const CCR1: u32 = 0x34;
const CCR4: u32 = 0x40;

const CR1_CEN: u32 = 1 << 0;
const CR1_UDIS: u32 = 1 << 1;
const CR1_URS: u32 = 1 << 2;
const CR1_OPM: u32 = 1 << 3;
const CR1_DIR_CMS: u32 = 0b111 << 4;
const CR1_ARPE: u32 = 1 << 7;
const CR1_CKD: u32 = 0b11 << 8;
const SR_UIF: u32 = 1 << 0;
const SR_TIF: u32 = 1 << 6;
const EGR_UG: u32 = 1 << 0;
const EGR_TG: u32 = 1 << 6;
const DIER_DMA: u32 = 0x5F00;
/// OCxPE of the first channel of a CCMR.
const CCMR_PRELOAD: u32 = 1 << 3;
/// CCxS of the two channels of a CCMR: 00 is an output.
const CCMR_INPUT: u32 = 0x0303;

/// A timer of the chip.
#[derive(Debug, PartialEq, Eq)]
pub struct Instance {
    /// Name as in the reference manual.
    pub name: &'static str,
    /// Interrupt line.
    pub line: u16,
    /// Compare channels: 0 (basic), 1, 2 or 4.
    channels: u32,
    /// The largest value of its counter: 16 or 32 bits.
    max: u32,
    /// It is clocked by APB2, not APB1.
    pub apb2: bool,
}

const fn instance(name: &'static str, line: u16, channels: u32, max: u32, apb2: bool) -> Instance {
    Instance { name, line, channels, max, apb2 }
}

const BITS_16: u32 = 0xFFFF;
const BITS_32: u32 = u32::MAX;

/// Interrupt lines: RM0090 table 62. Widths and channels: datasheet, table of the timers' features.
pub static INSTANCES: [Instance; 14] = [
    instance("TIM2", 28, 4, BITS_32, false),
    instance("TIM3", 29, 4, BITS_16, false),
    instance("TIM4", 30, 4, BITS_16, false),
    instance("TIM5", 50, 4, BITS_32, false),
    instance("TIM6", 54, 0, BITS_16, false),
    instance("TIM7", 55, 0, BITS_16, false),
    instance("TIM9", 24, 2, BITS_16, true),
    instance("TIM10", 25, 1, BITS_16, true),
    instance("TIM11", 26, 1, BITS_16, true),
    instance("TIM12", 43, 2, BITS_16, false),
    instance("TIM13", 44, 1, BITS_16, false),
    instance("TIM14", 45, 1, BITS_16, false),
    // Of the advanced ones the counter alone, with the line of the update (TIM1_UP_TIM10, TIM8_UP_TIM13).
    instance("TIM1", 25, 0, BITS_16, true),
    instance("TIM8", 44, 0, BITS_16, true),
];

/// A register with a preload: what was written, and what is in force.
#[derive(Clone, Copy, Debug, Default)]
struct Preloaded {
    written: u32,
    active: u32,
}

impl Preloaded {
    fn of(value: u32) -> Self {
        Self { written: value, active: value }
    }

    fn write(&mut self, value: u32, buffered: bool) {
        self.written = value;
        if !buffered {
            self.active = value;
        }
    }

    fn transfer(&mut self) {
        self.active = self.written;
    }
}

/// A timer.
#[derive(Clone, Debug)]
pub struct Tim {
    instance: &'static Instance,
    /// The clock CK_INT in Hz; 0 while it is off.
    hz: u32,
    cr1: u32,
    cr2: u32,
    smcr: u32,
    dier: u32,
    sr: u32,
    ccmr: [u32; 2],
    ccer: u32,
    psc: Preloaded,
    arr: Preloaded,
    ccr: [Preloaded; 4],
    /// The counter, and ticks of CK_INT since it changed, as of `seen` ticks after the anchor.
    count: u32,
    prescaled: u64,
    anchor: Time,
    seen: u64,
}

impl Tim {
    /// The timer without a clock.
    #[must_use]
    pub fn new(instance: &'static Instance) -> Self {
        Self {
            instance,
            hz: 0,
            cr1: 0,
            cr2: 0,
            smcr: 0,
            dier: 0,
            sr: 0,
            ccmr: [0; 2],
            ccer: 0,
            psc: Preloaded::default(),
            arr: Preloaded::of(instance.max),
            ccr: [Preloaded::default(); 4],
            count: 0,
            prescaled: 0,
            anchor: Time(0),
            seen: 0,
        }
    }

    /// Which one it is.
    #[must_use]
    pub fn instance(&self) -> &'static Instance {
        self.instance
    }

    /// From `now` on CK_INT has `hz`; 0 stops it.
    pub fn set_clock(&mut self, hz: u32, now: Time) {
        if hz != self.hz {
            self.advance(now);
            self.hz = hz;
            self.anchor_at(now);
        }
    }

    fn anchor_at(&mut self, now: Time) {
        self.anchor = now;
        self.seen = 0;
    }

    /// An auto-reload value of 0 blocks the counter (section 18.3.2).
    fn counts(&self) -> bool {
        self.cr1 & CR1_CEN != 0 && self.hz > 0 && self.arr.active > 0
    }

    fn divider(&self) -> u64 {
        u64::from(self.psc.active) + 1
    }

    /// Counts up to the next 0, and whether that is an overflow: a counter beyond the auto-reload
    /// value goes on to the end of its range.
    fn to_zero(&self) -> (u64, bool) {
        let overflows = self.count <= self.arr.active;
        let last = if overflows { self.arr.active } else { self.instance.max };
        (u64::from(last - self.count) + 1, overflows)
    }

    fn compare_flag(channel: usize) -> u32 {
        SR_UIF << (channel + 1)
    }

    /// The channels that compare: those that exist and are no inputs.
    fn comparing(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        let exist = self.ccr.iter().enumerate().take(self.instance.channels as usize);
        exist
            .filter(|(n, _)| self.ccmr[n / 2] >> (8 * (n % 2)) & 3 == 0)
            .map(|(n, ccr)| (Self::compare_flag(n), ccr.active))
    }

    /// The flags of the channels whose value the counter takes on its way, both ends included.
    fn matches(&self, from: u32, to: u32) -> u32 {
        let hit = |&(_, value): &(u32, u32)| (from..=to).contains(&value);
        self.comparing().filter(hit).fold(0, |flags, (flag, _)| flags | flag)
    }

    /// A compare value beyond the auto-reload value matches at the overflow (section 18.4.5, CC1IF).
    fn matches_at_overflow(&self) -> u32 {
        let beyond = |&(_, value): &(u32, u32)| value > self.arr.active;
        self.comparing().filter(beyond).fold(0, |flags, (flag, _)| flags | flag)
    }

    /// The update event: preloaded values come into force, and one-pulse mode ends (sections 18.3.1
    /// and 18.3.10).
    fn update(&mut self) {
        if self.cr1 & CR1_UDIS != 0 {
            return;
        }
        self.psc.transfer();
        self.arr.transfer();
        for ccr in &mut self.ccr {
            ccr.transfer();
        }
        if self.cr1 & CR1_OPM != 0 {
            self.cr1 &= !CR1_CEN;
        }
    }

    /// Lets `ticks` of CK_INT go by.
    fn count_on(&mut self, mut ticks: u64) {
        while ticks > 0 && self.counts() {
            let (to_zero, overflows) = self.to_zero();
            let wanted = to_zero.saturating_mul(self.divider()) - self.prescaled;
            if ticks < wanted {
                let passed = self.prescaled + ticks;
                let counted = passed / self.divider();
                self.prescaled = passed % self.divider();
                if counted > 0 {
                    let from = self.count + 1;
                    // Less than what is missing to the end of its range.
                    self.count += counted as u32;
                    self.sr |= self.matches(from, self.count);
                }
                return;
            }
            ticks -= wanted;
            self.prescaled = 0;
            self.sr |= self.count.checked_add(1).map_or(0, |from| self.matches(from, self.instance.max));
            self.count = 0;
            if overflows {
                self.overflow();
            }
            self.sr |= self.matches(0, 0);
            // Whole periods that follow are all alike.
            let period = (u64::from(self.arr.active) + 1).saturating_mul(self.divider());
            if overflows && self.counts() && ticks >= period {
                ticks %= period;
                self.sr |= self.matches(0, self.arr.active);
                self.overflow();
            }
        }
    }

    fn overflow(&mut self) {
        self.sr |= self.matches_at_overflow();
        if self.cr1 & CR1_UDIS == 0 {
            self.sr |= SR_UIF;
        }
        self.update();
    }

    /// EGR: events made by software (section 18.4.6).
    fn generate(&mut self, value: u32) {
        if value & EGR_UG != 0 {
            self.count = 0;
            self.prescaled = 0;
            if self.cr1 & (CR1_UDIS | CR1_URS) == 0 {
                self.sr |= SR_UIF;
            }
            self.update();
        }
        for n in 0..self.instance.channels as usize {
            self.sr |= value & Self::compare_flag(n);
        }
        if self.instance.channels >= 2 && value & EGR_TG != 0 {
            self.sr |= SR_TIF;
        }
    }

    /// The flags that the timer has.
    fn flags(&self) -> u32 {
        let compares = (0..self.instance.channels as usize).fold(0, |all, n| all | Self::compare_flag(n));
        let captures_again = compares << 8;
        SR_UIF | compares | captures_again | if self.instance.channels >= 2 { SR_TIF } else { 0 }
    }

    fn unknown(&self) -> Unmodelled {
        Unmodelled(format!("{} has no such register, or it is not modelled", self.instance.name))
    }

    fn unmodelled<T>(&self, what: &str) -> Result<T, Unmodelled> {
        unmodelled(format!("{}: {what}", self.instance.name))
    }

    /// The register of a channel, by its offset.
    fn channel(&self, offset: u32) -> Option<usize> {
        let is_one = (CCR1..=CCR4).contains(&offset);
        let n = offset.wrapping_sub(CCR1) / 4;
        (is_one && n < self.instance.channels).then_some(n as usize)
    }

    /// CCMR1 or CCMR2, by its offset.
    fn modes(&self, offset: u32) -> Option<usize> {
        match offset {
            CCMR1 if self.instance.channels > 0 => Some(0),
            CCMR2 if self.instance.channels > 2 => Some(1),
            _ => None,
        }
    }

    fn write_cr1(&mut self, value: u32, now: Time) -> Result<(), Unmodelled> {
        let started = value & !self.cr1 & CR1_CEN != 0;
        let exist = CR1_CEN | CR1_UDIS | CR1_URS | CR1_OPM | CR1_ARPE | CR1_CKD;
        let directions = if self.instance.channels == 4 { CR1_DIR_CMS } else { 0 };
        self.cr1 = value & (exist | directions);
        if self.cr1 & CR1_ARPE == 0 {
            self.arr.transfer();
        }
        if started {
            self.anchor_at(now);
        }
        if self.cr1 & CR1_DIR_CMS != 0 {
            return self.unmodelled("counting down and centre-aligned is not modelled: it counts up");
        }
        Ok(())
    }

    fn write_modes(&mut self, half: usize, value: u32) -> Result<(), Unmodelled> {
        self.ccmr[half] = value & 0xFFFF;
        for n in 0..2 {
            if value >> (8 * n) & CCMR_PRELOAD == 0 {
                self.ccr[2 * half + n].transfer();
            }
        }
        if value & CCMR_INPUT != 0 {
            return self.unmodelled("input capture is not modelled: nothing is ever captured");
        }
        Ok(())
    }
}

impl Peripheral for Tim {
    fn name(&self) -> &'static str {
        self.instance.name
    }

    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        self.advance(now);
        Ok(match offset {
            CR1 => self.cr1,
            CR2 => self.cr2,
            SMCR if self.instance.channels >= 2 => self.smcr,
            DIER => self.dier,
            SR => self.sr,
            EGR => 0,
            CCER if self.instance.channels > 0 => self.ccer,
            CNT => self.count,
            PSC => self.psc.written,
            ARR => self.arr.written,
            _ => match (self.modes(offset), self.channel(offset)) {
                (Some(half), _) => self.ccmr[half],
                (_, Some(n)) => self.ccr[n].written,
                _ => return Err(self.unknown()),
            },
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        self.advance(now);
        match offset {
            CR1 => return self.write_cr1(value, now),
            CR2 => {
                self.cr2 = value & 0xF8;
                if self.cr2 != 0 {
                    return self.unmodelled("CR2 (trigger output, XOR of the inputs) is not modelled");
                }
            }
            SMCR if self.instance.channels >= 2 => {
                self.smcr = value & 0xFFFF;
                if self.smcr != 0 {
                    return self.unmodelled("slave modes are not modelled: it counts its own clock");
                }
            }
            DIER => {
                self.dier = value & (DIER_DMA | self.flags() & 0x5F);
                if self.dier & DIER_DMA != 0 {
                    return self.unmodelled("DMA requests are not modelled");
                }
            }
            // Writing 0 clears, writing 1 changes nothing.
            SR => self.sr &= value | !self.flags(),
            EGR => self.generate(value),
            CCER if self.instance.channels > 0 => {
                self.ccer = value & 0xFFFF;
                if self.ccer & 0x1111 != 0 {
                    return self.unmodelled("the pins of the channels are not modelled");
                }
            }
            CNT => self.count = value & self.instance.max,
            PSC => self.psc.write(value & BITS_16, true),
            ARR => self.arr.write(value & self.instance.max, self.cr1 & CR1_ARPE != 0),
            _ => match (self.modes(offset), self.channel(offset)) {
                (Some(half), _) => return self.write_modes(half, value),
                (_, Some(n)) => {
                    let buffered = self.ccmr[n / 2] >> (8 * (n % 2)) & CCMR_PRELOAD != 0;
                    self.ccr[n].write(value & self.instance.max, buffered);
                }
                _ => return Err(self.unknown()),
            },
        }
        Ok(())
    }

    fn advance(&mut self, now: Time) {
        if !self.counts() {
            // It is stopped; when it goes on, it counts from there.
            self.anchor_at(now);
            return;
        }
        let ticks = ticks_in((now - self.anchor).0, self.hz.into());
        self.count_on(ticks.saturating_sub(self.seen));
        self.seen = self.seen.max(ticks);
    }

    fn next_event(&self) -> Option<Time> {
        let wanted = self.dier & !self.sr & self.flags();
        if wanted == 0 || !self.counts() {
            return None;
        }
        let (to_zero, _) = self.to_zero();
        // What is not due on this side of the next 0 is looked for from there.
        let mut due = |(flag, value): (u32, u32)| {
            let ahead = value > self.count && u64::from(value - self.count) < to_zero;
            (wanted & flag != 0).then(|| if ahead { u64::from(value - self.count) } else { to_zero })
        };
        let compare = self.comparing().filter_map(&mut due).min();
        let update = (wanted & SR_UIF != 0 && self.cr1 & CR1_UDIS == 0).then_some(to_zero);
        let counts = compare.into_iter().chain(update).min()?;
        let ticks = counts.saturating_mul(self.divider()) - self.prescaled;
        Some(Time(self.anchor.0.saturating_add(picos_of(self.seen.saturating_add(ticks), self.hz.into()))))
    }

    fn interrupts(&self, active: &mut Vec<u16>) {
        if self.sr & self.dier & 0x5F != 0 {
            active.push(self.instance.line);
        }
    }

    fn reset(&mut self) {
        *self = Self { hz: self.hz, ..Self::new(self.instance) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const US: u64 = 1_000_000;

    fn at(micros: u64) -> Time {
        Time(micros * US)
    }

    fn named(name: &str) -> Tim {
        let instance = INSTANCES.iter().find(|instance| instance.name == name).unwrap();
        let mut tim = Tim::new(instance);
        tim.set_clock(1_000_000, Time(0));
        tim
    }

    /// A timer whose registers were written so at time 0; it counts microseconds.
    fn with(name: &str, writes: &[(u32, u32)]) -> Tim {
        let mut tim = named(name);
        for &(offset, value) in writes {
            tim.write(offset, value, Time(0)).unwrap();
        }
        tim
    }

    fn line(tim: &Tim) -> bool {
        let active = tim.active();
        assert!(active.is_empty() || active == [tim.instance.line]);
        !active.is_empty()
    }

    /// Section 18.3.2: the counter goes from 0 to the auto-reload value and restarts, so the period
    /// is ARR + 1 counts.
    #[test]
    fn the_period_is_the_auto_reload_value_plus_one() {
        let mut tim = with("TIM3", &[(ARR, 9), (DIER, 1), (CR1, 1)]);
        assert_eq!(tim.next_event(), Some(at(10)));
        assert_eq!(tim.read(CNT, at(9)), Ok(9));
        assert_eq!(tim.read(SR, at(9)), Ok(0));
        assert_eq!(tim.read(CNT, at(10)), Ok(0));
        assert_eq!(tim.read(SR, at(10)).unwrap() & 1, 1);
        assert!(line(&tim));
        assert_eq!(tim.next_event(), None, "the flag is up already");
        tim.write(SR, !1, at(12)).unwrap();
        assert!(!line(&tim));
        assert_eq!(tim.next_event(), Some(at(20)));
        assert_eq!(tim.read(CNT, at(1_234_567)), Ok(7));
        assert_eq!(tim.read(SR, at(1_234_567)).unwrap() & 1, 1);
    }

    /// Section 18.3.1: a new prescaler value is taken at the next update event; UG makes one.
    #[test]
    fn the_prescaler_is_taken_at_an_update_event() {
        let mut tim = with("TIM4", &[(PSC, 4), (ARR, 9), (CR1, 1)]);
        assert_eq!(tim.read(CNT, at(9)), Ok(9), "not yet");
        assert_eq!(tim.read(CNT, at(10 + 4)), Ok(0), "from the overflow on");
        assert_eq!(tim.read(CNT, at(10 + 5)), Ok(1));
        let mut tim = with("TIM4", &[(PSC, 4), (EGR, 1), (CR1, 1)]);
        assert_eq!(tim.read(CNT, at(5)), Ok(1));
        assert_eq!(tim.read(CNT, at(49)), Ok(9));
    }

    /// Section 18.4.1, URS, and section 18.4.6, UG.
    #[test]
    fn ug_sets_the_flag_unless_urs_or_udis_says_no() {
        for (cr1, flag) in [(0, 1), (CR1_URS, 0), (CR1_UDIS, 0)] {
            let mut tim = with("TIM2", &[(CR1, cr1), (PSC, 3), (CNT, 77), (EGR, 1)]);
            assert_eq!(tim.read(SR, Time(0)), Ok(flag), "CR1 {cr1:X}h");
            assert_eq!(tim.read(CNT, Time(0)), Ok(0));
            tim.write(CR1, cr1 | 1, Time(0)).unwrap();
            let counted = if cr1 == CR1_UDIS { 8 } else { 2 };
            assert_eq!(tim.read(CNT, at(8)), Ok(counted), "UDIS keeps the prescaler as it was");
        }
    }

    /// Section 18.3.10: one-pulse mode stops at the next update event.
    #[test]
    fn one_pulse_stops_at_the_update() {
        let mut tim = with("TIM14", &[(ARR, 4), (DIER, 1), (CR1, CR1_OPM | CR1_CEN)]);
        assert_eq!(tim.next_event(), Some(at(5)));
        assert_eq!(tim.read(CR1, at(1_000)), Ok(CR1_OPM));
        assert_eq!(tim.read(CNT, at(1_000)), Ok(0));
        assert!(line(&tim));
        assert_eq!(tim.next_event(), None);
    }

    /// The use of a timer as the clock of an operating system: an interrupt in the middle and at
    /// the end of the 16-bit range, and an alarm. Section 18.4.5: CCxIF is set when the counter
    /// matches.
    #[test]
    fn two_halves_and_an_alarm() {
        let set_up =
            [(ARR, 0xFFFF), (CR1, CR1_URS), (EGR, 1), (CR1, 0), (CCR1, 0x8000), (DIER, 0b11), (CR1, 1)];
        for name in ["TIM2", "TIM3", "TIM4", "TIM5", "TIM9", "TIM12"] {
            let mut tim = with(name, &set_up);
            assert_eq!(tim.next_event(), Some(at(0x8000)), "{name}");
            tim.write(CCR1 + 4, 0x1000, at(0x0FF0)).unwrap();
            tim.write(DIER, 0b111, at(0x0FF0)).unwrap();
            assert_eq!(tim.next_event(), Some(at(0x1000)), "{name}");
            assert_eq!(tim.read(SR, at(0x0FFF)).unwrap() & 0b111, 0);
            assert_eq!(tim.read(SR, at(0x1000)).unwrap() & 0b111, 0b100);
            tim.write(SR, !0b100, at(0x1001)).unwrap();
            assert_eq!(tim.next_event(), Some(at(0x8000)));
            assert_eq!(tim.read(SR, at(0x8000)).unwrap() & 0b111, 0b10);
            tim.write(SR, !0b10, at(0x8001)).unwrap();
            assert_eq!(tim.next_event(), Some(at(0x1_0000)));
            assert_eq!(tim.read(SR, at(0x1_0000)).unwrap() & 0b111, 0b1);
            assert_eq!(tim.read(CNT, at(0x1_0002)), Ok(2));
        }
    }

    /// Section 18.4.5, CC1IF: a value beyond ARR matches at the overflow.
    #[test]
    fn a_compare_value_beyond_the_period_matches_at_the_overflow() {
        let mut tim = with("TIM3", &[(ARR, 99), (CCR1, 500), (DIER, 2), (CR1, 1)]);
        assert_eq!(tim.next_event(), Some(at(100)));
        assert_eq!(tim.read(SR, at(99)).unwrap() & 2, 0);
        assert_eq!(tim.read(SR, at(100)).unwrap() & 2, 2);
    }

    /// Sections 18.3.2 and 18.3.9: with ARPE and OCxPE a value waits for the update event.
    #[test]
    fn preloaded_values_wait_for_the_update() {
        let mut tim = with("TIM5", &[(ARR, 9), (CR1, CR1_ARPE), (EGR, 1), (SR, 0), (CCMR1, CCMR_PRELOAD)]);
        tim.write(CCR1, 3, Time(0)).unwrap();
        tim.write(CR1, CR1_ARPE | 1, Time(0)).unwrap();
        tim.write(ARR, 19, at(1)).unwrap();
        assert_eq!(tim.read(ARR, at(1)), Ok(19));
        assert_eq!(tim.read(SR, at(9)).unwrap() & 2, 0, "CCR1 is still 0");
        assert_eq!(tim.read(CNT, at(11)), Ok(1), "the old period");
        tim.write(SR, 0, at(11)).unwrap();
        assert_eq!(tim.read(SR, at(12)), Ok(0));
        assert_eq!(tim.read(SR, at(13)), Ok(2));
        assert_eq!(tim.read(CNT, at(29)), Ok(19), "the new one");
    }

    #[test]
    fn a_counter_of_32_bits_counts_on_where_one_of_16_wraps() {
        for (name, count) in [("TIM2", 100_000), ("TIM5", 100_000), ("TIM3", 34_464), ("TIM9", 34_464)] {
            assert_eq!(with(name, &[(CR1, 1)]).read(CNT, at(100_000)), Ok(count), "{name}");
        }
    }

    /// The clock may change, and stop, in the middle of a count: nothing is lost nor gained.
    #[test]
    fn it_counts_on_with_a_new_clock() {
        let mut tim = with("TIM2", &[(PSC, 9), (EGR, 1), (CR1, 1)]);
        tim.set_clock(2_000_000, at(105));
        assert_eq!(tim.read(CNT, at(107)), Ok(10));
        assert_eq!(tim.read(CNT, Time(107 * US + US / 2)), Ok(11));
        tim.set_clock(0, at(110));
        assert_eq!((tim.read(CNT, at(500)), tim.next_event()), (Ok(11), None));
        tim.set_clock(1_000_000, at(500));
        assert_eq!(tim.read(CNT, at(505)), Ok(12));
    }

    #[test]
    fn looking_often_does_not_slow_it_down() {
        let mut tim = named("TIM2");
        tim.set_clock(84_000_000, Time(0));
        tim.write(CR1, 1, Time(0)).unwrap();
        for nanos in (0..1_000_000).step_by(7) {
            tim.read(CNT, Time(nanos * 1_000)).unwrap();
        }
        assert_eq!(tim.read(CNT, at(1_000)), Ok(84_000));
    }

    #[test]
    fn what_is_not_modelled_is_said() {
        for (name, offset, value) in [
            ("TIM2", CR1, 0x10),
            ("TIM2", CR2, 0x20),
            ("TIM3", SMCR, 7),
            ("TIM3", DIER, 0x100),
            ("TIM4", CCMR1, 1),
            ("TIM4", CCER, 1),
            ("TIM6", CCMR1, 0),
            ("TIM9", CCR1 + 8, 0),
            ("TIM10", SMCR, 0),
            ("TIM11", CCMR2, 0),
        ] {
            assert!(named(name).write(offset, value, Time(0)).is_err(), "{name}, offset {offset:X}h");
        }
    }
}
