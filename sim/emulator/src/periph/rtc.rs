//! Real-time clock (RM0090 section 26): the calendar, its flags and the backup registers. Alarms, wake-up, time stamps,
//! tamper detection, outputs and calibration are not modelled.

use crate::clock::ticks_in;
use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::time::Time;

const TR: u32 = 0x00;
const DR: u32 = 0x04;
const CR: u32 = 0x08;
const ISR: u32 = 0x0C;
const PRER: u32 = 0x10;
const WUTR: u32 = 0x14;
const CALIBR: u32 = 0x18;
const WPR: u32 = 0x24;
const SSR: u32 = 0x28;
const SHIFTR: u32 = 0x2C;
const TSTR: u32 = 0x30;
const TSSSR: u32 = 0x38;
const CALR: u32 = 0x3C;
const TAFCR: u32 = 0x40;
const ALRMBSSR: u32 = 0x48;
/// RTC_BKP0R and RTC_BKP19R.
const BACKUP: (u32, u32) = (0x50, 0x9C);

/// DCE, FMT and REFCKON, which only the initialization mode can change.
const CR_INIT_ONLY: u32 = 1 << 7 | CR_FMT | 1 << 4;
const CR_BYPSHAD: u32 = 1 << 5;
const CR_FMT: u32 = 1 << 6;
const CR_ALRAE: u32 = 1 << 8;
const CR_ALRBE: u32 = 1 << 9;
const CR_WUTE: u32 = 1 << 10;
/// ADD1H and SUB1H, which read 0.
const CR_HOUR: u32 = 0b11 << 16;
/// What has no model: REFCKON, DCE, ALRAE, ALRBE, WUTE, TSE, ADD1H, SUB1H, OSEL and COE.
const CR_UNMODELLED: u32 = 1 << 4 | 1 << 7 | 0xF << 8 | CR_HOUR | 0b111 << 21;

const ISR_ALRAWF: u32 = 1 << 0;
const ISR_ALRBWF: u32 = 1 << 1;
const ISR_WUTWF: u32 = 1 << 2;
const ISR_INITS: u32 = 1 << 4;
const ISR_RSF: u32 = 1 << 5;
const ISR_INITF: u32 = 1 << 6;
const ISR_INIT: u32 = 1 << 7;

/// TAMP1E, TAMP2E and TAMPTS.
const TAFCR_TAMPER: u32 = 0b1000_1001;

/// The values of the calendar registers after a backup domain reset, and of their shadows after a system reset.
const RESET: Calendar = Calendar { second: 0, weekday: 1, day: 1, month: 1, year: 0 };

/// A time and a date.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Calendar {
    /// Of the day.
    second: u32,
    /// 1 is Monday.
    weekday: u32,
    day: u32,
    month: u32,
    /// Since 2000.
    year: u32,
}

fn bcd(value: u32) -> u32 {
    ((value / 10) << 4) + value % 10
}

/// A value of two digits, if these are digits.
fn from_bcd(value: u32) -> Option<u32> {
    (value & 0xF < 10 && value >> 4 < 10).then_some((value >> 4) * 10 + (value & 0xF))
}

impl Calendar {
    /// So many seconds later. A year that can be divided by four has a day more; 2100 is 2000 again.
    fn after(mut self, seconds: u64) -> Self {
        const DAY: u64 = 86_400;
        /// Days of a hundred years.
        const CENTURY: u64 = 36_525;
        let seconds = u64::from(self.second) + seconds;
        let days = seconds / DAY;
        self.second = (seconds % DAY) as u32;
        self.weekday = ((u64::from(self.weekday) + 6 + days) % 7 + 1) as u32;
        for _ in 0..days % CENTURY {
            let last = match self.month {
                4 | 6 | 9 | 11 => 30,
                2 if self.year.is_multiple_of(4) => 29,
                2 => 28,
                _ => 31,
            };
            self.day += 1;
            if self.day > last {
                (self.day, self.month) = (1, self.month + 1);
            }
            if self.month > 12 {
                (self.month, self.year) = (1, (self.year + 1) % 100);
            }
        }
        self
    }

    /// RTC_TR, in the format of FMT.
    fn tr(self, am_pm: bool) -> u32 {
        let (hour, minute, second) = (self.second / 3_600, self.second / 60 % 60, self.second % 60);
        let (pm, hour) = match am_pm {
            true => (u32::from(hour >= 12), (hour + 11) % 12 + 1),
            false => (0, hour),
        };
        pm << 22 | bcd(hour) << 16 | bcd(minute) << 8 | bcd(second)
    }

    /// The same with the time of RTC_TR, if it is one.
    fn with_tr(self, tr: u32, am_pm: bool) -> Option<Self> {
        let [hour, minute, second] = [tr >> 16 & 0x3F, tr >> 8 & 0x7F, tr & 0x7F].map(from_bcd);
        let hour = match (hour?, am_pm) {
            (hour @ 1..=12, true) => hour % 12 + 12 * (tr >> 22 & 1),
            (hour @ 0..=23, false) => hour,
            _ => return None,
        };
        let (minute, second) = (minute.filter(|&it| it < 60)?, second.filter(|&it| it < 60)?);
        Some(Self { second: (hour * 60 + minute) * 60 + second, ..self })
    }

    /// RTC_DR.
    fn dr(self) -> u32 {
        bcd(self.year) << 16 | self.weekday << 13 | bcd(self.month) << 8 | bcd(self.day)
    }

    /// The same with the date of RTC_DR, if it is one.
    fn with_dr(self, dr: u32) -> Option<Self> {
        let [year, month, day] = [dr >> 16 & 0xFF, dr >> 8 & 0x1F, dr & 0x3F].map(from_bcd);
        let (month, day) =
            (month.filter(|it| (1..=12).contains(it))?, day.filter(|it| (1..=31).contains(it))?);
        let weekday = Some(dr >> 13 & 7).filter(|&it| it > 0)?;
        Some(Self { second: self.second, weekday, day, month, year: year? })
    }
}

/// How far the keys of RTC_WPR have come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Keys {
    Locked,
    First,
    Open,
}

/// The calendar and the backup registers. Times are counted in edges of RTCCLK.
#[derive(Clone, Debug)]
pub struct Rtc {
    /// RTCCLK in Hz, 0 for none; it has edges from `since` on.
    hz: u32,
    since: Time,
    /// The edges before `since`.
    edges: u64,
    keys: Keys,
    cr: u32,
    prer: u32,
    /// The calendar at the edge `counts_from`; nothing: it stands still.
    calendar: Calendar,
    counts_from: Option<u64>,
    /// ISR.INIT, and the edge at which INITF follows.
    init: Option<u64>,
    /// The edge at which RSF is set; nothing: to be found, after a system reset.
    copied: Option<u64>,
    /// Whether the shadow registers have their reset values until then.
    shadow_is_reset: bool,
    /// The edges at which RTC_TR and RTC_DR were locked by a load.
    locks: [Option<u64>; 2],
    /// The edge from which WUTWF, ALRBWF and ALRAWF follow RTC_CR, and their values until then.
    followed: (u64, u32),
    /// The other registers, as written.
    words: [u32; 40],
}

impl Default for Rtc {
    /// As after a backup domain reset.
    fn default() -> Self {
        let mut words = [0; 40];
        words[(WUTR / 4) as usize] = 0xFFFF;
        Self {
            hz: 0,
            since: Time(0),
            edges: 0,
            keys: Keys::Locked,
            cr: 0,
            prer: 0x007F_00FF,
            calendar: RESET,
            counts_from: Some(0),
            init: None,
            copied: None,
            shadow_is_reset: false,
            locks: [None; 2],
            followed: (0, 0),
            words,
        }
    }
}

impl Rtc {
    /// RTCCLK is this one from `now` on: its frequency, and the time of its first edge. Call it after a reset, too.
    pub fn follow(&mut self, clock: Option<(u32, Time)>, now: Time) {
        let (hz, from) = clock.unwrap_or((0, now));
        if hz != self.hz {
            (self.edges, self.hz, self.since) = (self.edge(now), hz, from.max(now));
        }
        let edge = self.edge(now);
        if self.init.is_none() && self.counts_from.is_none() {
            self.counts_from = Some(edge + 4);
        }
        self.copied = self.copied.or(Some(Self::next_copy(edge)));
    }

    /// The edges of RTCCLK so far.
    fn edge(&self, now: Time) -> u64 {
        self.edges + ticks_in((now - self.since).0, self.hz.into())
    }

    /// The shadow registers are copied every two edges (section 26.3.6).
    fn next_copy(edge: u64) -> u64 {
        edge / 2 * 2 + 2
    }

    /// The calendar, and RTC_SSR, at an edge.
    fn at(&self, edge: u64) -> (Calendar, u32) {
        let (asynchronous, synchronous) = (u64::from(self.prer >> 16) + 1, u64::from(self.prer & 0x7FFF) + 1);
        let end = self.init.map_or(edge, |init| init.min(edge));
        let ticks = self.counts_from.map_or(0, |from| end.saturating_sub(from)) / asynchronous;
        // Less than `synchronous`, which has 16 bits.
        let ssr = (synchronous - 1 - ticks % synchronous) as u32;
        (self.calendar.after(ticks / synchronous), ssr)
    }

    fn is_in_init(&self, edge: u64) -> bool {
        self.init.is_some_and(|from| from <= edge)
    }

    fn rsf(&self, edge: u64) -> bool {
        self.cr & CR_BYPSHAD == 0 && self.init.is_none() && self.copied.is_some_and(|copied| copied <= edge)
    }

    /// The flags that allow writes of alarms and wake-up timer, by RTC_CR.
    fn write_flags(&self) -> u32 {
        [(CR_ALRAE, ISR_ALRAWF), (CR_ALRBE, ISR_ALRBWF), (CR_WUTE, ISR_WUTWF)]
            .into_iter()
            .fold(0, |flags, (enable, flag)| flags | if self.cr & enable == 0 { flag } else { 0 })
    }

    fn isr(&self, edge: u64) -> u32 {
        let (from, before) = self.followed;
        let flags = if edge >= from { self.write_flags() } else { before };
        let is_in_init = self.is_in_init(edge);
        let alarms = if is_in_init { 0 } else { ISR_ALRAWF | ISR_ALRBWF };
        flags & (alarms | ISR_WUTWF)
            | if self.at(edge).0.year != 0 { ISR_INITS } else { 0 }
            | if self.rsf(edge) { ISR_RSF } else { 0 }
            | if is_in_init { ISR_INITF } else { 0 }
            | if self.init.is_some() { ISR_INIT } else { 0 }
    }

    fn load_calendar(&mut self, offset: u32, edge: u64) -> u32 {
        let shadows = self.cr & CR_BYPSHAD == 0 && self.init.is_none();
        let copied = edge / 2 * 2;
        let lock = match offset {
            TR => self.locks[0],
            DR => self.locks[1],
            _ => None,
        };
        let (calendar, ssr) = match shadows {
            true if self.shadow_is_reset && !self.rsf(edge) => (RESET, 0),
            true => self.at(lock.unwrap_or(copied)),
            false => self.at(edge),
        };
        self.shadow_is_reset &= !self.rsf(edge);
        // SSR locks TR and DR, TR locks DR, until DR is read (section 26.3.6).
        match offset {
            _ if !shadows => {}
            DR => self.locks = [None; 2],
            TR => self.locks[1] = self.locks[1].or(Some(copied)),
            _ => self.locks = self.locks.map(|lock| lock.or(Some(copied))),
        }
        match offset {
            TR => calendar.tr(self.cr & CR_FMT != 0),
            DR => calendar.dr(),
            _ => ssr,
        }
    }

    fn write_isr(&mut self, value: u32, edge: u64) {
        match (value & ISR_INIT != 0, self.init) {
            (true, None) => (self.init, self.locks) = (Some(edge + 2), [None; 2]),
            (false, Some(from)) => {
                if from <= edge {
                    (self.calendar, _) = self.at(edge);
                    // "The counting restarts after 4 RTCCLK clock cycles."
                    self.counts_from = Some(edge + 4);
                    self.copied = Some(Self::next_copy(edge + 3));
                }
                self.init = None;
            }
            _ => {}
        }
        if value & ISR_RSF == 0 && self.rsf(edge) {
            self.copied = Some(Self::next_copy(edge));
        }
    }

    /// A write to the calendar or its prescalers, which stand still in initialization mode.
    fn write_in_init(&mut self, offset: u32, value: u32, edge: u64) -> Result<(), Unmodelled> {
        if !self.is_in_init(edge) {
            return unmodelled(
                "only the initialization mode (INITF in RTC_ISR) allows it: the write is lost",
            );
        }
        (self.calendar, _) = self.at(edge);
        self.counts_from = None;
        let set = match offset {
            TR => self.calendar.with_tr(value, self.cr & CR_FMT != 0),
            DR => self.calendar.with_dr(value),
            _ => {
                self.prer = value & 0x007F_7FFF;
                Some(self.calendar)
            }
        };
        self.calendar = match set {
            Some(calendar) => calendar,
            None => {
                return unmodelled("this is no time or date in BCD, and is not modelled: the write is lost")
            }
        };
        Ok(())
    }

    fn write_cr(&mut self, value: u32, edge: u64) -> Result<(), Unmodelled> {
        let (before, flags) = (self.cr, self.isr(edge));
        let frozen = if self.is_in_init(edge) { 0 } else { CR_INIT_ONLY };
        self.cr = (value & 0x00FF_FFFF & !CR_HOUR & !frozen) | before & frozen;
        if self.write_flags() != flags & (ISR_ALRAWF | ISR_ALRBWF | ISR_WUTWF) {
            self.followed = (edge + 2, flags);
        }
        if before & CR_BYPSHAD != 0 {
            self.copied = Some(Self::next_copy(edge));
        }
        if (value ^ before) & frozen != 0 {
            return unmodelled(
                "DCE, FMT and REFCKON change in initialization mode only: these bits are lost",
            );
        }
        if value & !before & CR_UNMODELLED != 0 {
            return unmodelled(
                "RTC has a model of its calendar alone: no alarm, wake-up, time stamp, output, calibration",
            );
        }
        Ok(())
    }
}

impl Peripheral for Rtc {
    fn name(&self) -> &'static str {
        "RTC"
    }

    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        let edge = self.edge(now);
        match offset {
            TR | DR | SSR => Ok(self.load_calendar(offset, edge)),
            CR => Ok(self.cr),
            ISR => Ok(self.isr(edge)),
            PRER => Ok(self.prer),
            WPR => Ok(0),
            _ => match self.words.get((offset / 4) as usize) {
                Some(word) => Ok(*word),
                None => unmodelled("RTC has no such register"),
            },
        }
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        let edge = self.edge(now);
        let is_backup = (BACKUP.0..=BACKUP.1).contains(&offset);
        if !matches!(offset, WPR | TAFCR) && !is_backup && self.keys != Keys::Open {
            // The flags of ISR that software may clear then are not modelled.
            return match offset {
                ISR if value & ISR_INIT == 0 => Ok(()),
                _ => unmodelled("RTC_WPR protects the registers of RTC (keys CAh, 53h): the write is lost"),
            };
        }
        match offset {
            TR | DR | PRER => return self.write_in_init(offset, value, edge),
            CR => return self.write_cr(value, edge),
            ISR => self.write_isr(value, edge),
            WPR => {
                self.keys = match (self.keys, value & 0xFF) {
                    (_, 0xCA) => Keys::First,
                    (Keys::First, 0x53) => Keys::Open,
                    _ => Keys::Locked,
                }
            }
            SSR | TSTR..=TSSSR => return unmodelled("this register of RTC is read-only"),
            _ if offset > BACKUP.1 || offset > ALRMBSSR && !is_backup => {
                return unmodelled("RTC has no such register");
            }
            _ => {
                self.words[(offset / 4) as usize] = value;
                match offset {
                    CALIBR | CALR | SHIFTR if value != 0 => {
                        return unmodelled("calibration and shifts of RTC are not modelled");
                    }
                    TAFCR if value & TAFCR_TAMPER != 0 => {
                        return unmodelled("tamper detection of RTC is not modelled");
                    }
                    _ => {}
                }
            }
        }
        Ok(())
    }

    /// A system reset: only the shadow registers and INIT, INITF and RSF (section 26.3.7).
    fn reset(&mut self) {
        self.init = None;
        self.copied = None;
        self.shadow_is_reset = true;
        self.locks = [None; 2];
    }
}

#[cfg(test)]
mod tests;
