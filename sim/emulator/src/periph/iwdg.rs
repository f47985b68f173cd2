//! Independent watchdog (RM0090 section 21).

use crate::clock::{picos_of, ticks_in};
use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::silicon::Silicon;
use crate::time::{Span, Time};

const KEY_RELOAD: u32 = 0xAAAA;
const KEY_ACCESS: u32 = 0x5555;
const KEY_START: u32 = 0xCCCC;
const SR_PVU: u32 = 1 << 0;
const SR_RVU: u32 = 1 << 1;

/// The down-counter's value when it starts, whatever RLR holds (section 21.3).
const FIRST: u32 = 0xFFF;

/// A register whose value is used in the LSI's clock domain: what is written gets there some periods of
/// the LSI later (section 21.4.4), and while the LSI is off it does not.
#[derive(Clone, Copy, Debug)]
struct Crossing {
    used: u32,
    written: u32,
    /// When `written` gets used; [`Crossing::NEVER`] as long as the LSI is off, `None` for no update.
    ends: Option<Time>,
}

impl Crossing {
    const NEVER: Time = Time(u64::MAX);

    fn new(value: u32) -> Self {
        Self { used: value, written: value, ends: None }
    }

    fn is_over(&self, now: Time) -> bool {
        self.ends.is_some_and(|ends| ends <= now && ends != Self::NEVER)
    }

    fn finish(&mut self) {
        self.used = self.written;
        self.ends = None;
    }
}

/// The down-counter at a time.
#[derive(Clone, Copy, Debug)]
struct Counter {
    value: u32,
    at: Time,
}

/// The watchdog. Once started only a reset stops it.
#[derive(Clone, Debug)]
pub struct Iwdg {
    silicon: Silicon,
    lsi_is_on: bool,
    prescaler: Crossing,
    reload: Crossing,
    unlocked: bool,
    /// `None` until it is started.
    counter: Option<Counter>,
    expired: bool,
    /// When the program last wrote AAAAh, or started the watchdog, since the reset.
    fed: Option<Time>,
    /// It stays in a reset.
    longest_between_feeds: Span,
}

impl Iwdg {
    /// As after a reset, on this chip.
    #[must_use]
    pub fn new(silicon: Silicon) -> Self {
        Self {
            silicon,
            lsi_is_on: false,
            prescaler: Crossing::new(0),
            reload: Crossing::new(0xFFF),
            unlocked: false,
            counter: None,
            expired: false,
            fed: None,
            longest_between_feeds: Span(0),
        }
    }

    /// Whether it was started.
    #[must_use]
    pub fn is_running(&self) -> bool {
        self.counter.is_some()
    }

    /// Whether it ran out; the machine resets the chip then.
    #[must_use]
    pub fn has_expired(&self) -> bool {
        self.expired
    }

    /// The longest time without AAAAh that ended with AAAAh; also while the watchdog does not run.
    #[must_use]
    pub fn longest_between_feeds(&self) -> Span {
        self.longest_between_feeds
    }

    /// The LSI is on or off from `now` on.
    pub fn follow_lsi(&mut self, is_on: bool, now: Time) {
        if is_on != self.lsi_is_on {
            self.settle(now);
            self.lsi_is_on = is_on;
            let ends = self.update_ends(now, 0);
            for register in [&mut self.prescaler, &mut self.reload] {
                register.ends = register.ends.map(|_| ends);
            }
        }
    }

    /// The state that a program leaves which has started the watchdog with this reload value, has waited
    /// for the update, and has reloaded the counter. The prescaler stays.
    pub fn preset(&mut self, reload: u32, now: Time) {
        self.settle(now);
        self.reload = Crossing::new(reload & 0xFFF);
        self.counter = Some(Counter { value: self.reload.used, at: now });
    }

    /// When an update that begins now ends, which may be one to this prescaler.
    fn update_ends(&self, now: Time, prescaler: u32) -> Time {
        let prescaler = prescaler.max(self.prescaler.used).max(self.prescaler.written);
        let of = if self.silicon.iwdg_update_prescaled { divider(prescaler) } else { 1 };
        let periods = u64::from(self.silicon.iwdg_update_periods) * of;
        if self.lsi_is_on {
            now + Span(picos_of(periods, self.silicon.lsi_hz.into()))
        } else {
            Crossing::NEVER
        }
    }

    /// How long so many counts take. The prescaler divides by 4 << PR, at most 256.
    fn counts(&self, count: u32, prescaler: u32) -> Span {
        Span(picos_of(u64::from(count) * divider(prescaler), self.silicon.lsi_hz.into()))
    }

    /// The counts that are left at the end of the prescaler's update, if it ends before they are over.
    fn left_at(&self, Counter { value, at }: Counter, ends: Time) -> Option<u32> {
        let ticks = ticks_in((ends - at).0, self.silicon.lsi_hz.into());
        let passed = u32::try_from(ticks / divider(self.prescaler.used)).ok()?;
        (value + 1).checked_sub(passed).filter(|left| *left > 0)
    }

    fn expires(&self) -> Option<Time> {
        let counter = self.counter?;
        let left = self.prescaler.ends.and_then(|ends| Some((ends, self.left_at(counter, ends)?)));
        Some(match left {
            Some((ends, left)) => ends + self.counts(left, self.prescaler.written),
            None => counter.at + self.counts(counter.value + 1, self.prescaler.used),
        })
    }

    /// Carries out the updates that are over.
    fn settle(&mut self, now: Time) {
        self.expired |= self.expires().is_some_and(|expires| now >= expires);
        if self.reload.is_over(now) {
            self.reload.finish();
        }
        if let Some(ends) = self.prescaler.ends.filter(|_| self.prescaler.is_over(now)) {
            let left = self.counter.and_then(|counter| self.left_at(counter, ends));
            if let Some(left) = left {
                self.counter = Some(Counter { value: left - 1, at: ends });
            }
            self.prescaler.finish();
        }
    }

    fn write_key(&mut self, key: u32, now: Time) -> Result<(), Unmodelled> {
        self.unlocked = key == KEY_ACCESS;
        if let (KEY_RELOAD, Some(fed)) = (key, self.fed) {
            self.longest_between_feeds = self.longest_between_feeds.max(now - fed);
        }
        if key == KEY_RELOAD || key == KEY_START && !self.is_running() {
            self.fed = Some(now);
        }
        match key {
            KEY_RELOAD if self.is_running() => {
                self.counter = Some(Counter { value: self.reload.used, at: now });
            }
            KEY_START if !self.is_running() => self.counter = Some(Counter { value: FIRST, at: now }),
            KEY_RELOAD | KEY_START | KEY_ACCESS | 0 => {}
            _ => return unmodelled("the IWDG knows no such key"),
        }
        Ok(())
    }
}

fn divider(prescaler: u32) -> u64 {
    4 << prescaler.min(6)
}

impl Peripheral for Iwdg {
    fn name(&self) -> &'static str {
        "IWDG"
    }

    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        self.settle(now);
        Ok(match offset {
            0x00 => 0,
            0x04 => self.prescaler.used,
            0x08 => self.reload.used,
            0x0C => {
                let flag = |register: &Crossing, bit| register.ends.map_or(0, |_| bit);
                flag(&self.prescaler, SR_PVU) | flag(&self.reload, SR_RVU)
            }
            _ => return unmodelled("the IWDG has no such register"),
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        self.settle(now);
        let ends = self.update_ends(now, if offset == 0x04 { value & 7 } else { 0 });
        let (register, mask) = match offset {
            0x00 => return self.write_key(value & 0xFFFF, now),
            0x04 => (&mut self.prescaler, 7),
            0x08 => (&mut self.reload, 0xFFF),
            0x0C => return Ok(()),
            _ => return unmodelled("the IWDG has no such register"),
        };
        if !self.unlocked {
            return unmodelled("IWDG_PR and IWDG_RLR are write protected: write 5555h to KR first");
        }
        if register.ends.is_some() {
            return unmodelled(
                "the value before is still on its way to the counter, this one is lost: wait until IWDG_SR is 0",
            );
        }
        register.written = value & mask;
        register.ends = Some(ends);
        Ok(())
    }

    fn advance(&mut self, now: Time) {
        self.settle(now);
    }

    fn next_event(&self) -> Option<Time> {
        if self.expired {
            return None;
        }
        // A program waits for the updates, too.
        let updates = [self.prescaler.ends, self.reload.ends];
        updates.into_iter().flatten().filter(|ends| *ends != Crossing::NEVER).chain(self.expires()).min()
    }

    fn reset(&mut self) {
        let longest_between_feeds = self.longest_between_feeds;
        *self = Self { longest_between_feeds, ..Self::new(self.silicon) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::silicon::TYPICAL;

    const MS: u64 = 1_000_000_000;
    /// A period of the LSI's 32 kHz.
    const PERIOD: u64 = MS / 32;
    const KR: u32 = 0x00;
    const PR: u32 = 0x04;
    const RLR: u32 = 0x08;
    const SR: u32 = 0x0C;

    fn dog() -> Iwdg {
        Iwdg::new(TYPICAL)
    }

    /// Writes in order, all at one time.
    fn write(dog: &mut Iwdg, now: Time, stores: &[(u32, u32)]) {
        for &(register, value) in stores {
            dog.write(register, value, now).unwrap();
        }
    }

    /// A watchdog that was started at 0; the key turns the LSI on (section 21.3).
    fn started() -> Iwdg {
        let mut dog = dog();
        write(&mut dog, Time(0), &[(KR, 0xCCCC)]);
        dog.follow_lsi(true, Time(0));
        dog
    }

    /// RM0090 table 107: with the prescaler at /4 and RL = FFFh the time-out is 512 ms.
    #[test]
    fn runs_out_after_the_time_of_the_manual() {
        let mut dog = started();
        assert_eq!(dog.next_event(), Some(Time(512 * MS)));
        dog.advance(Time(512 * MS - 1));
        assert!(!dog.has_expired());
        dog.write(KR, 0xAAAA, Time(100 * MS)).unwrap();
        dog.advance(Time(512 * MS));
        assert!(!dog.has_expired());
        dog.advance(Time(612 * MS));
        assert!(dog.has_expired());
    }

    /// Section 21.4.1: AAAAh reloads the counter. A time that ends in a reset is none.
    #[test]
    fn the_longest_time_between_two_feeds_stays_in_a_reset() {
        let mut dog = started();
        for ms in [100, 110, 370, 380] {
            write(&mut dog, Time(ms * MS), &[(KR, 0xAAAA)]);
        }
        assert_eq!(dog.longest_between_feeds(), Span(260 * MS));
        dog.advance(Time(800 * MS));
        dog.reset();
        write(&mut dog, Time(1_000 * MS), &[(KR, 0xCCCC), (KR, 0xAAAA)]);
        assert_eq!(dog.longest_between_feeds(), Span(260 * MS));
        write(&mut dog, Time(1_261 * MS), &[(KR, 0xAAAA)]);
        assert_eq!(dog.longest_between_feeds(), Span(261 * MS));
    }

    /// RM0090 table 107: the times for RL = 0 and RL = FFFh at 32 kHz, by prescaler; section 21.3: AAAAh
    /// loads RLR.
    #[test]
    fn the_times_of_the_manual_begin_with_the_reload() {
        for (prescaler, shortest, longest) in [
            (0, MS / 8, 512 * MS),
            (1, MS / 4, 1_024 * MS),
            (2, MS / 2, 2_048 * MS),
            (3, MS, 4_096 * MS),
            (4, 2 * MS, 8_192 * MS),
            (5, 4 * MS, 16_384 * MS),
            (6, 8 * MS, 32_768 * MS),
            (7, 8 * MS, 32_768 * MS),
        ] {
            for (reload, expected) in [(0, shortest), (0xFFF, longest)] {
                let mut dog = started();
                write(&mut dog, Time(0), &[(KR, 0x5555), (PR, prescaler), (RLR, reload)]);
                let later = Time(MS);
                assert_eq!(dog.read(SR, later), Ok(0));
                assert_eq!((dog.read(PR, later), dog.read(RLR, later)), (Ok(prescaler), Ok(reload)));
                write(&mut dog, later, &[(KR, 0xAAAA)]);
                assert_eq!(dog.next_event(), Some(later + Span(expected)), "{prescaler}, {reload}");
            }
        }
    }

    /// Section 21.3: CCCCh starts the counter at FFFh, and RLR is loaded by AAAAh alone. So a program that
    /// never writes AAAAh, or writes it before the value has got across, has 4096 counts.
    #[test]
    fn the_first_period_is_4096_counts_whatever_rlr_holds() {
        let mut dog = started();
        write(&mut dog, Time(0), &[(KR, 0x5555), (RLR, 1)]);
        assert_eq!(dog.expires(), Some(Time(512 * MS)));
        // Too early: the counter takes the old value.
        write(&mut dog, Time(MS / 10), &[(KR, 0xAAAA)]);
        assert_eq!(dog.expires(), Some(Time(512 * MS + MS / 10)));
        write(&mut dog, Time(MS), &[(KR, 0xAAAA)]);
        assert_eq!(dog.expires(), Some(Time(MS + 8 * PERIOD)));
        // AAAAh before CCCCh loads nothing.
        let mut dog = super::tests::dog();
        dog.follow_lsi(true, Time(0));
        write(&mut dog, Time(0), &[(KR, 0x5555), (RLR, 1)]);
        write(&mut dog, Time(MS), &[(KR, 0xAAAA), (KR, 0xCCCC)]);
        assert_eq!(dog.expires(), Some(Time(513 * MS)));
    }

    /// Section 21.4.4: PVU and RVU are set for up to five periods of the LSI, and a value may be changed
    /// only when they are 0. With the LSI off nothing gets across.
    #[test]
    fn a_value_takes_five_periods_and_the_next_one_must_wait() {
        let mut dog = started();
        assert!(dog.write(PR, 3, Time(0)).is_err(), "locked");
        write(&mut dog, Time(0), &[(KR, 0x5555), (PR, 3), (RLR, 7)]);
        assert_eq!((dog.read(SR, Time(0)), dog.read(PR, Time(0))), (Ok(3), Ok(0)));
        let before = Time(5 * PERIOD - 1);
        assert!(dog.write(PR, 4, before).is_err() && dog.write(RLR, 8, before).is_err());
        assert_eq!(dog.read(SR, before), Ok(3));
        let after = Time(5 * PERIOD);
        assert_eq!(dog.read(SR, after), Ok(0));
        assert_eq!((dog.read(PR, after), dog.read(RLR, after)), (Ok(3), Ok(7)));
        write(&mut dog, after, &[(KR, 0xAAAA)]);
        assert!(dog.write(RLR, 5, after).is_err(), "any other key locks again");

        let mut dog = super::tests::dog();
        write(&mut dog, Time(0), &[(KR, 0x5555), (PR, 3)]);
        assert_eq!(dog.read(SR, Time(1_000 * MS)), Ok(1), "the LSI is off");
        write(&mut dog, Time(1_000 * MS), &[(KR, 0xCCCC)]);
        dog.follow_lsi(true, Time(1_000 * MS));
        assert_eq!(dog.read(SR, Time(1_000 * MS + 5 * PERIOD)), Ok(0));
    }

    /// The counter keeps its value when the prescaler changes: what is left is counted at the new rate.
    #[test]
    fn a_new_prescaler_stretches_the_counts_that_are_left() {
        let mut dog = started();
        // 256 ms: half of the 4096 counts.
        let half = Time(256 * MS - 5 * PERIOD);
        write(&mut dog, half, &[(KR, 0x5555), (PR, 6)]);
        // 2048 counts of 8 ms.
        assert_eq!(dog.expires(), Some(Time(256 * MS + 2048 * 8 * MS)));
        dog.advance(Time(300 * MS));
        assert_eq!(dog.expires(), Some(Time(256 * MS + 2048 * 8 * MS)));
        // It has run out before the new prescaler gets across.
        let mut dog = started();
        write(&mut dog, Time(512 * MS - PERIOD), &[(KR, 0x5555), (PR, 6)]);
        assert_eq!(dog.expires(), Some(Time(512 * MS)));
        dog.advance(Time(600 * MS));
        assert!(dog.has_expired());
    }

    /// Datasheet DocID022152: LSI 17 to 47 kHz.
    #[test]
    fn the_lsi_is_that_of_the_chip() {
        for (lsi_hz, ms) in [(17_000, 963), (32_000, 512), (47_000, 348)] {
            let mut dog = Iwdg::new(Silicon { lsi_hz, ..TYPICAL });
            write(&mut dog, Time(0), &[(KR, 0xCCCC)]);
            assert_eq!(dog.next_event().unwrap().0 / MS, ms, "{lsi_hz} Hz");
        }
    }
}
